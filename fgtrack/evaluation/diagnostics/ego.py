"""Diagnostics of the ego and of the map of a run."""

from collections.abc import Iterator

import numpy as np

from fgtrack.core.diagnostic import EGO, Diagnostic, late_ego
from fgtrack.evaluation.diagnostics.outcomes import delay_s, failed_shares, section
from fgtrack.evaluation.scores.innovations import by_sensor
from fgtrack.models.road import OPEN_SPACE
from fgtrack.runs import Run

_STANDING = {"birth.ego_speed_factor": 0.0}
_NAME_EGO = "set its topic in the configuration (`fgtrack info` lists the topics)"


def ego_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield a missing ego, a late ego, jumps, and reasons for which most ego states were refused."""
    num_states = run.tables["ego"].num_rows
    if not num_states and failed_shares(run) and not run.meta.get("first_failure"):
        yield Diagnostic(
            EGO,
            f"no state was received, so detections in its frame cannot be transformed: {_NAME_EGO}",
        )
    elif not num_states and _ego_speeds_births(run):
        text = f"no state was received, so new objects are assumed to stand still: {_NAME_EGO}"
        yield Diagnostic(EGO, f"{text}, or set birth.ego_speed_factor to 0", _STANDING)
    if num_states and (
        late := late_ego(delay_s(run.tables["ego"]), _placed_delays_s(run))
    ):
        yield late
    if jumps := run.meta.get("ego_jumps"):
        times = "once" if jumps == 1 else f"{jumps} times"
        yield Diagnostic(
            EGO,
            f"its position jumps {times}: detections are misplaced there, split the recording at the jumps",
        )
    for reason, count in dict(run.meta.get("ego_refused") or {}).items():
        if 0 < num_states < 2 * count:
            text = f"{count} of {num_states} states not used, {reason}: check the clock of its driver"
            yield Diagnostic(EGO, text)


def _placed_delays_s(run: Run) -> dict[str, float]:
    """Median delay [s] of the lists of each sensor with detections in a moving frame."""
    detections = run.tables["detections"]
    moving = detections.where(detections["frame"] != "map")
    return {name: delay_s(mine) for name, mine in by_sensor(moving)}


def map_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield a missing map if new objects are assumed to be as fast as the ego, in its direction."""
    if not _ego_speeds_births(run) or section(run, "map").get("track") not in (
        None,
        OPEN_SPACE,
    ):
        return
    detections = run.tables["detections"]
    blind = [
        name
        for name, mine in by_sensor(detections)
        if not np.isfinite(mine["yaw_rad"]).any()
    ]
    if blind:
        text = f"no map, and {', '.join(blind)} reports no heading: new objects may move in any direction"
        remedy = "give a map with --map (`oval` for the simulated races); in open space set birth.ego_speed_factor: 0"
        yield Diagnostic("map", f"{text}; {remedy}", _STANDING)


def _ego_speeds_births(run: Run) -> bool:
    """True if the run has updates and assumes a speed relative to the ego for new objects."""
    return bool(
        run.tables["updates"].num_rows and section(run, "birth").get("ego_speed_factor")
    )
