"""Diagnostics of a run: unused detections with the reason, inconsistent noise, broken tracks."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fgtrack.core.diagnostic import (
    EGO,
    Diagnostic,
    in_degrees,
    late_ego,
    reasons,
    too_late,
)
from fgtrack.core.geometry import cartesian
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.scores.innovations import by_sensor, num_measured
from fgtrack.evaluation.scores.statistics import ChiSquareMean
from fgtrack.models.measurement import ANGULAR
from fgtrack.models.road import OPEN_SPACE
from fgtrack.runs import Columns, Run

USED = ("birth", "in_sequence", "out_of_sequence", "beyond_window", "merged")
"""Dispositions of detections that were used."""
FAR_OFF = 1.5
"""A mean NIS that differs from its expected value by more than this factor is inconsistent."""
FEWEST = 30
"""Least number of updates of a sensor for a statement on its NIS."""
CORRELATED = 0.3
"""Autocorrelation of innovations at lag 1 above which errors are correlated in time."""
MOST_BREAKS_PER_MINUTE = 2.0
"""Number of breaks per object and minute above which tracking is fragmented."""
# Least number of breaks, and least share of the confirmed tracks. Fewer breaks are due to occlusion or chance.
_FEWEST_BREAKS = 3
_BREAKS_SHARE = 0.25
# Share of the used detections that start a track which is never confirmed. Clutter alone stays below it.
_DEAD_SHARE = 0.5
# A track continues an earlier track if it begins at most this time after, or before, the earlier track ends.
_GAP_S = 5.0
_OVERLAP_S = 2.0
# Largest distance from the predicted position: noise, and a share of the predicted way for turns and changes of speed.
_NEAR_M = 3.0
_DEPARTURE = 0.3
# Share of a sensor's yaws that are flipped, or rejected, above which it is reported. Fewer are outliers.
_YAWS_SHARE = 0.05
# A damped step is no failure: it is usual with bearings.
_NO_FAILURE = "step damped"
#: Cause and remedy by disposition, for a sensor with most detections in this disposition.
_REMEDIES = {
    "gated": "no track was near and no track was started: check the gate of `association`, the clock, and "
    "ego.detection_origin_x_m",
    "out_of_bounds": "{reasons}: check these settings, the map (--map), and the frame of the detections",
    "duplicate": "the same list is repeated: check the recording, a sensor or a bridge may send lists twice",
    "superseded": "another list of the sensor arrived in the same tick, and the inbox keeps one: raise clock.node_hz",
    "invalid": "no position, a value that is not finite, an invalid covariance, or a stamp after the receipt: compare "
    "the keys of sensors.{sensor}.std with the fields in `fgtrack info`",
    "failed": "no ego state near the stamp, or a numerical failure: check the clock of the ego",
}
_STANDING = {"birth.ego_speed_factor": 0.0}
_NAME_EGO = "set its topic in the configuration (`fgtrack info` lists the topics)"


def diagnostics(run: Run) -> list[Diagnostic]:
    """Return the defects of `run` that its files show."""
    kinds = (
        _angles,
        _ego,
        _map,
        _sensors,
        _latency,
        _failures,
        _fragmentation,
        _identities,
        _yaws,
    )
    return [diagnostic for kind in kinds for diagnostic in kind(run)]


def _identities(run: Run) -> Iterator[Diagnostic]:
    """Yield identities that belong to several objects, and conflicting identities."""
    counts = run.meta.get("id_conflicts") or {}
    texts = {
        "reused": "started with the identity of another track: two objects use it, or its stamps or noise are wrong",
        "changed": "detections have another identity than their track: lower the sensor's wrong_id_probability",
    }
    for name, text in texts.items():
        if counts.get(name):
            yield Diagnostic(
                "identities",
                f"{counts[name]} {'tracks ' if name == 'reused' else ''}{text}",
            )


def _yaws(run: Run) -> Iterator[Diagnostic]:
    """Yield sensors with many yaws that are half a turn off, or that are inconsistent otherwise."""
    for sensor, counts in dict(run.meta.get("yaws") or {}).items():
        total = counts.get("yaws", 0)
        flipped = counts.get("flipped", 0)
        rejected = counts.get("unused", 0)
        if total >= FEWEST and flipped > _YAWS_SHARE * total:
            text = f"{flipped} of {total} yaws are half a turn off and were turned; the front follows from all yaws"
            yield Diagnostic(sensor, text)
        if total >= FEWEST and rejected > _YAWS_SHARE * total:
            text = (
                f"{rejected} of {total} yaws are inconsistent, only their positions were used: its yaw errors are "
                f"larger than configured (sensors.{sensor}.std), or some yaws belong to another side of the object"
            )
            yield Diagnostic(sensor, text)


def noise_diagnostics(run: Run) -> Iterator[Diagnostic]:
    """Yield sensors whose innovations are inconsistent with the noise.

    The verdict of `compare` uses the same check.
    """
    source = (run.meta.get("input") or {}).get("path")
    of_run = (
        f" {source} -c {run.path / 'config.yaml'}"
        if run.path is not None and source
        else ""
    )
    for sensor, nis in inconsistent_sensors(run):
        size = "small" if nis.mean > nis.dof else "large"
        # The mean may be negative by rounding, if two standard deviations differ by a factor of 1e9.
        factor = math.sqrt(max(nis.mean, 0.0) / nis.dof)
        text = (
            f"mean NIS {nis.mean:.3g}, expected {nis.dof:.3g}: the configured noise is too {size}, errors are "
            f"{factor:.2g} times as large as configured; `fgtrack advise{of_run} --tune -o advised.yaml` fits the "
            "noise, or reports the problem to solve first"
        )
        yield Diagnostic(sensor, text)


def inconsistent_sensors(run: Run) -> Iterator[tuple[str, ChiSquareMean]]:
    """Yield the sensors with inconsistent NIS, and their NIS.

    Mean and median must both deviate in the same direction, so that a few outliers do
    not count.
    """
    for sensor, mine in by_sensor(run.tables["updates"]):
        nis = ChiSquareMean.without_band(mine["nis"], num_measured(mine))
        if nis.count >= FEWEST and is_far_off(nis):
            # This import takes a quarter of a second; a consistent run does not need it.
            from scipy.special import chdtri

            ratio = float(np.nanmedian(mine["nis"])) / float(chdtri(nis.dof, 0.5))
            if ratio > FAR_OFF if nis.mean > nis.dof else ratio < 1.0 / FAR_OFF:
                yield sensor, nis


def is_far_off(square: ChiSquareMean) -> bool:
    """True if a mean NEES or NIS differs from its expected value by more than `FAR_OFF`."""
    return not square.dof / FAR_OFF <= square.mean <= square.dof * FAR_OFF


def unused(run: Run) -> str | None:
    """Line on the dispositions of a run that used no detection.

    None if a detection was used, or none was received.
    """
    counts = Counter(run.tables["updates"]["disposition"].tolist())
    if not counts or counts.keys() & set(USED):
        return None
    names = ", ".join(f"{count} {name}" for name, count in sorted(counts.items()))
    return f"none of the {counts.total()} detections was used ({names})"


def excluded_lines(meta: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each sensor on the detections that settings excluded; `meta` is the run's meta.json."""
    for sensor, counts in sorted(dict(meta.get("out_of_bounds") or {}).items()):
        total = sum(meta["counts"][sensor].values())
        yield f"{sensor}: {sum(counts.values())} of {total} detections out of bounds ({reasons(counts)})"
    for sensor, counts in sorted(dict(meta.get("left_out") or {}).items()):
        yield f"{sensor}: {sum(counts.values())} left out by the reader ({reasons(counts)})"


def _angles(run: Run) -> Iterator[Diagnostic]:
    """Yield angles that are degrees in the recording but were read as radians."""
    for about, table in [
        (EGO, run.tables["ego"]),
        *by_sensor(run.tables["detections"]),
    ]:
        for name in ANGULAR:
            finite = [
                value
                for value in table.get(name, np.empty(0)).tolist()
                if math.isfinite(value)
            ]
            if wrong := in_degrees(
                about, name, min(finite, default=0.0), max(finite, default=0.0)
            ):
                yield wrong


def _ego(run: Run) -> Iterator[Diagnostic]:
    """Yield a missing ego, a late ego, jumps, and reasons for which most ego states were refused."""
    num_states = run.tables["ego"].num_rows
    if not num_states and any(
        name == "failed" for _, _, name, _ in _mostly_unused(run)
    ):
        yield Diagnostic(
            EGO,
            f"no state was received, so detections in its frame cannot be transformed: {_NAME_EGO}",
        )
    elif not num_states and _ego_speeds_births(run):
        text = f"no state was received, so new objects are assumed to stand still: {_NAME_EGO}"
        yield Diagnostic(EGO, f"{text}, or set birth.ego_speed_factor to 0", _STANDING)
    if num_states and (
        late := late_ego(_delay_s(run.tables["ego"]), _placed_delays_s(run))
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
    return {name: _delay_s(mine) for name, mine in by_sensor(moving)}


def _delay_s(table: Columns) -> float:
    """Median delay [s] from stamp to receipt of the rows of a table."""
    return float(np.median(table["receipt_ns"] - table["stamp_ns"])) / NS_PER_S


def _map(run: Run) -> Iterator[Diagnostic]:
    """Yield a missing map if new objects are assumed to be as fast as the ego, in its direction."""
    if not _ego_speeds_births(run) or _section(run, "map").get("track") not in (
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
        run.tables["updates"].num_rows
        and _section(run, "birth").get("ego_speed_factor")
    )


def _mostly_unused(run: Run) -> Iterator[tuple[str, Columns, str, int]]:
    """Yield sensors with more than half of their updates unused for one disposition.

    Yields the sensor, its updates, the disposition, and its count.
    """
    for sensor, mine in by_sensor(run.tables["updates"]):
        name, count = Counter(mine["disposition"].tolist()).most_common(1)[0]
        if name not in USED and 2 * count > mine.num_rows:
            yield sensor, mine, name, count


def _sensors(run: Run) -> Iterator[Diagnostic]:
    """Yield sensors without stamps, and the disposition of most detections if no other diagnostic explains it."""
    unset = [
        name
        for name, mine in by_sensor(run.tables["updates"])
        if not mine["stamp_ns"].any()
    ]
    for sensor in unset:
        text = "all stamps are 0: its driver does not set them; `stamp_from: receipt` uses the receipt as the stamp"
        yield Diagnostic(sensor, text, {f"sensors.{sensor}.stamp_from": "receipt"})
    for sensor, mine, name, count in _mostly_unused(run):
        if (name == "too_old" and sensor in unset) or (
            name == "failed" and not run.tables["ego"].num_rows
        ):
            continue
        if name == "duplicate" and (_section(run, "sensors").get(sensor) or {}).get(
            "copies_s"
        ):
            continue  # copies from several receivers are expected
        by = reasons((run.meta.get("out_of_bounds") or {}).get(sensor, {}))
        remedy = (
            _too_old(run, sensor, mine)
            if name == "too_old"
            else _REMEDIES[name].format(sensor=sensor, reasons=by)
        )
        yield Diagnostic(sensor, f"{count} of {mine.num_rows} {name}: {remedy}")


def _latency(run: Run) -> Iterator[Diagnostic]:
    """Yield delays beyond the limits of the estimator or the inbox, unless most detections already have a reason."""
    explained = {sensor for sensor, _, _, _ in _mostly_unused(run)}
    for sensor, mine in by_sensor(run.tables["updates"]):
        if sensor not in explained and mine["stamp_ns"].any():
            delays_s = (mine["receipt_ns"] - mine["stamp_ns"]) / NS_PER_S
            refused = mine["disposition"] == "too_old"
            if late := too_late(
                sensor, delays_s, _limits(run, sensor, "reach_s"), refused
            ):
                yield late


def _limits(run: Run, sensor: str, window_s: str) -> list[tuple[str, float | None]]:
    """Return the configuration keys and values of a sensor's largest delay and of the window.

    `window_s` is the name of the time in the window's record.
    """
    window = run.meta.get("effective") or {}
    own = _section(run, "sensors").get(sensor) or {}
    return [
        (f"sensors.{sensor}.max_delay_s", own.get("max_delay_s")),
        (str(window.get("lag_key")), window.get(window_s, window.get("lag_s"))),
    ]


def _too_old(run: Run, sensor: str, updates: Columns) -> str:
    delay_s = _delay_s(updates)
    for key, limit_s in _limits(run, sensor, "lag_s"):
        if limit_s is not None and delay_s > limit_s:
            return f"median delay {delay_s:.3g} s, allowed {limit_s:g} s: raise {key}, or correct the clock"
    return f"median delay {delay_s:.3g} s, but no track is as old as these detections: check births, gate and clock"


def _failures(run: Run) -> Iterator[Diagnostic]:
    """Yield failures inside the estimator."""
    counts = {
        kind: n
        for kind, n in dict(run.meta.get("failures") or {}).items()
        if n and kind != _NO_FAILURE
    }
    if counts:
        first = (
            f" (the first failure: {run.meta['first_failure']})"
            if run.meta.get("first_failure")
            else ""
        )
        remedy = "these tracks are less accurate; check NIS by sensor, noise, clocks and first states"
        text = f"failures: {', '.join(f'{n} {kind}' for kind, n in counts.items())}{first}: {remedy}"
        yield Diagnostic("estimator", text)


def _fragmentation(run: Run) -> Iterator[Diagnostic]:
    """Yield tracks that break off and restart, and births that are never confirmed; both need no truth."""
    lifetimes_s, num_breaks = lifetimes_and_breaks(run)
    now_ns = run.tables["timing"]["now_ns"]
    total = len(lifetimes_s)
    minutes = float(lifetimes_s.sum()) / 60.0
    if (
        num_breaks >= max(_FEWEST_BREAKS, _BREAKS_SHARE * total)
        and num_breaks > MOST_BREAKS_PER_MINUTE * minutes
    ):
        text = (
            f"{num_breaks} of {total} confirmed tracks begin where another track has just ended: "
            f"{num_breaks / minutes:.2g} breaks per object and minute, median life {np.median(lifetimes_s):.2g} of "
            f"{float(np.ptp(now_ns)) / NS_PER_S:.3g} s; likely causes: a configured field of view or range that the "
            "sensor does not cover, detection_probability, lifecycle.lifetime_s, noise; `fgtrack advise` checks these"
        )
        yield Diagnostic("tracks", text)
    dispositions = run.tables["updates"]["disposition"]
    used = int(np.isin(dispositions, USED).sum())
    dead = int(np.count_nonzero(dispositions == "birth")) - total
    if used >= FEWEST and dead > _DEAD_SHARE * used:
        text = (
            f"{dead} of {used} used detections started a track that was never confirmed; likely causes: clutter, "
            "errors or motion larger than configured, a wrong ego or clock; `fgtrack advise` checks these"
        )
        yield Diagnostic("tracks", text)


def lifetimes_and_breaks(run: Run) -> tuple[FloatArray, int]:
    """Return the lifetimes [s] of the confirmed tracks, shape (tracks,), and the number of breaks.

    A break is a track that begins near the end of another track, in time and position.
    """
    tracks = run.tables["tracks"]
    tracks = tracks.where(
        np.isin(tracks["track_id"], tracks["track_id"][confirmed(tracks)])
    )
    births = np.unique(tracks["track_id"], return_index=True)[1]
    ends = (
        tracks.num_rows - 1 - np.unique(tracks["track_id"][::-1], return_index=True)[1]
    )
    born_s, ended_s = (
        (tracks["now_ns"][each] - tracks["now_ns"][:1]) / NS_PER_S
        for each in (births, ends)
    )
    positions_m = np.stack([tracks["x_m"], tracks["y_m"]], axis=-1)
    speed_mps = tracks["speed_mps"][ends]
    velocities_mps = cartesian(np.stack([tracks["yaw_rad"][ends], speed_mps], axis=-1))
    free = np.ones(len(births), dtype=bool)  # tracks without a continuation
    num_breaks = 0
    for k in np.argsort(born_s, kind="stable").tolist():
        gap_s = born_s[k] - ended_s
        late = (
            (born_s < born_s[k])
            & (ended_s < ended_s[k])
            & (gap_s >= -_OVERLAP_S)
            & (gap_s <= _GAP_S)
        )
        before = np.flatnonzero(free & late)
        expected_m = (
            positions_m[ends[before]] + velocities_mps[before] * gap_s[before, None]
        )
        distance_m = np.linalg.norm(positions_m[births[k]] - expected_m, axis=-1)
        way_m = np.abs(speed_mps[before] * gap_s[before])
        near = distance_m <= _NEAR_M + _DEPARTURE * way_m
        if near.any():
            free[before[near][distance_m[near].argmin()]] = False
            num_breaks += 1
    return ended_s - born_s, num_breaks


def _section(run: Run, name: str) -> Mapping[str, Any]:
    return run.config.get(name) or {}
