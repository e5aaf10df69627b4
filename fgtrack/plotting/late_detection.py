"""Close-ups of runs: which late detection to look at, and their recordings replayed up to it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import tee
from pathlib import Path
from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, Message
from fgtrack.evaluation.recordings import by_recording
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.io.run import Run, Table, load_run
from fgtrack.io.source import open_input
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import validate
from fgtrack.pipeline.replay import delivered
from fgtrack.plotting.close_up import close_up as figure_of
from fgtrack.plotting.paper import Paper
from fgtrack.plotting.slow_motion import Arrival, CloseUp, close_up

_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
_SETTLED = 20  # measurements of a track before which it moves for want of a good start


def close_ups(
    runs: Sequence[Run | Path | str], track_id: int | None = None, stamp_ns: int | None = None
) -> list[CloseUp]:
    """One late detection in slow motion, in each of `runs`: its track before and after it was fused.

    The detection is a typical one of those that lower the error of the first run's present, see `chosen`; `rule` of
    the result says by what rule. The recording is replayed up to there for every run; `fgtrack.plot.close_up` draws
    the result.

    Parameters
    ----------
    runs
        Runs of one recording, or their folders.
    track_id, stamp_ns
        Choose among the detections of one track of the first run, or the one with the nearest stamp.

    Raises
    ------
    CallError
        A folder holds no run.
    DataError
        The first run fused no such detection, a run did not fuse it, or a recording is not there any more.
    """
    read = [run if isinstance(run, Run) else load_run(Path(run)) for run in runs]
    arrival, rule = chosen(read, track_id, stamp_ns)
    recordings = [(run.recording, run.config.get("input")) for run in read]
    same = recordings.count(recordings[0]) == len(read)
    recorded = tee(_recorded(read[0]), len(read)) if same else map(_recorded, read)  # a recording is read once
    return [replace(close_up_of(run, arrival, one), rule=rule) for run, one in zip(read, recorded, strict=True)]


def drawn_close_up(
    runs: Sequence[JudgedRun], track_id: int | None = None, stamp_ns: int | None = None, **paper: Unpack[Paper]
) -> tuple[list[tuple[str, Figure]], CloseUp | DataError]:
    """Return the named figure of `close_ups` and the first of these; no figure and the error where there is none.

    It is that of the runs of the first one's recording.
    """
    same = by_recording(runs)[0]
    try:
        found = close_ups([one.run for one in same], track_id, stamp_ns)
    except DataError as error:
        return [], error
    return [("close_up", figure_of(same, found, **paper))], found[0]


def _recorded(run: Run) -> Iterator[Message]:
    """Return the messages of its recording. Raises `DataError` where that is not there any more."""
    recording = run.recording
    if recording is None:
        given = (run.meta.get("input") or {}).get("path") or "messages in memory"
        raise DataError(f"{given}: the recording of the run is not there, so no close-up")
    try:
        return open_input(recording, validate(Config, run.config, str(run.config_path)).input).messages()
    except CallError as error:  # nobody has called with it: it is what the run says
        raise DataError(f"{error}, so no close-up") from error


def close_up_of(run: Run, arrival: Arrival, messages: Iterable[Message] | None = None) -> CloseUp:
    """Return the track of `run` that fused `arrival`, before and after: its recording is replayed up to there.

    Parameters
    ----------
    messages
        Those of the recording, where they have been read; None to read them.

    Raises
    ------
    DataError
        The recording, or a file that the configuration names, is not there any more; or it does not hold the
        detection; or no track fused it.
    """
    try:
        config = validate(Config, run.config, str(run.config_path))
        ticks = delivered(_recorded(run) if messages is None else messages, config)
        return close_up(lambda observed: build_tracker(config, observed), ticks, arrival)
    except CallError as error:  # as above
        raise DataError(f"{error}, so no close-up") from error


@dataclass(frozen=True)
class _Late:
    """A late detection that its track fused by itself: what it did to the present of one run."""

    stamp_ns: int
    track_id: int
    moved_m: float
    """From where the tick before it expected the present."""
    errors_m: tuple[float, float]
    """Of the present before and after it; NaN without truth."""


def chosen(runs: Sequence[Run], track_id: int | None = None, stamp_ns: int | None = None) -> tuple[Arrival, str]:
    """Return a typical out-of-sequence detection that every run fused, and a sentence with the rule of the choice.

    Of those that lower the error of the first run's present, it is the one with errors nearest to their root mean
    squares: before it in the first run, after it in all of them; nearest is the largest of the ratios. Without truth
    it is the one that moves the present by the median. Ticks at which a track fused several detections, and tracks
    with fewer than twenty, are left out.

    Parameters
    ----------
    runs
        Runs of one recording.
    track_id
        Only detections that this track of the first run fused; None for any.
    stamp_ns
        Choose the detection with the stamp nearest to this one instead.

    Raises
    ------
    DataError
        The runs have no such detection.
    """
    first, *others = (_late_detections(run) for run in runs)
    common = [one for one in first if all(one in other for other in others)]
    common = [one for one in common if track_id is None or first[one].track_id == track_id]
    if not common:
        where, of = runs[0].path or "the run", "" if track_id is None else f" of track {track_id}"
        if track_id is not None and track_id not in runs[0].tables["tracks"]["track_id"]:
            raise DataError(f"{where}: has no track {track_id}")
        raise DataError(
            f"{where}: no late detection{of} was fused by itself after {_SETTLED} others, so there is no close-up"
        )
    if stamp_ns is not None:
        return min(common, key=lambda one: abs(one.stamp_ns - stamp_ns)), "Chosen by its stamp."
    errors_m = np.array([[*first[one].errors_m, *(late[one].errors_m[1] for late in others)] for one in common])
    lowered = errors_m[:, 1] < errors_m[:, 0]
    if not lowered.any():
        moved_m = np.array([first[one].moved_m for one in common])
        row = int(np.abs(moved_m - np.median(moved_m)).argmin())
        return common[row], f"Of {len(common)} late detections, the one that moves the present by the median."
    rms_m = np.sqrt(np.nanmean(errors_m[lowered] ** 2, axis=0))
    with np.errstate(divide="ignore"):
        apart = np.abs(np.log(errors_m / rms_m)).max(axis=1)
    row = int(np.where(lowered & np.isfinite(apart), apart, np.inf).argmin())
    share = 100.0 * float(lowered.mean())
    rms_all_m = np.sqrt(np.nanmean(errors_m[:, :2] ** 2, axis=0))
    return common[row], (
        f"{share:.0f} % of {len(common)} late detections lower the error of the present; this one is nearest to their "
        f"root mean square ({rms_m[0]:.2f} to {rms_m[1]:.2f} m; of all {rms_all_m[0]:.2f} to {rms_all_m[1]:.2f} m)."
    )


def _late_detections(run: Run) -> dict[Arrival, _Late]:
    updates, tracks = run.tables["updates"], run.tables["tracks"]
    used = np.isin(updates["disposition"], ("in_sequence", "out_of_sequence", "beyond_window"))
    pairs = np.stack([updates["tick"], updates["track_id"]], axis=-1)
    _, group, sizes = np.unique(pairs[used], axis=0, return_inverse=True, return_counts=True)
    alone = np.zeros(len(used), dtype=bool)
    alone[used] = sizes[group.reshape(-1)] == 1
    index = {key: row for row, key in enumerate(zip(tracks["track_id"].tolist(), tracks["tick"].tolist(), strict=True))}
    states, motion = np.stack([tracks[name] for name in _STATE], axis=-1), CTRV()
    found: dict[Arrival, _Late] = {}
    for update in np.flatnonzero(alone & (updates["disposition"] == "out_of_sequence")).tolist():
        tick, track_id = pairs[update].tolist()
        row, before = index.get((track_id, tick)), index.get((track_id, tick - 1))
        if row is None or before is None or tracks["num_measured"][row] < _SETTLED:
            continue
        now_ns = int(tracks["now_ns"][row])
        expected_m = motion.predict(states[before], seconds(now_ns - int(tracks["now_ns"][before])))[:2]
        true_m = _true_m(run.tables["truth"], now_ns, states[row, :2])
        errors_m = tuple(float(np.hypot(*(at_m - true_m))) for at_m in (expected_m, states[row, :2]))
        stamp_ns, receipt_ns, place = (int(updates[name][update]) for name in ("stamp_ns", "receipt_ns", "index"))
        arrival = Arrival(str(updates["sensor"][update]), stamp_ns, receipt_ns, place)
        moved_m = float(np.hypot(*(states[row, :2] - expected_m)))
        found[arrival] = _Late(stamp_ns, track_id, moved_m, (errors_m[0], errors_m[1]))
    return found


def _true_m(truth: Table, now_ns: int, near_m: FloatArray) -> FloatArray:
    """Position of the true object nearest to `near_m`, shape (2,); NaN where none is known."""
    found = [np.full(2, np.nan)]
    for object_id in np.unique(truth["object_id"]).tolist():
        own = truth.where(truth["object_id"] == object_id)
        since_ns = (own["stamp_ns"] - now_ns).astype(np.float64)  # differences are exact as floats
        found.append(np.array([np.interp(0.0, since_ns, own[name], np.nan, np.nan) for name in ("x_m", "y_m")]))
    return min(found, key=lambda at_m: float(np.nan_to_num(np.hypot(*(at_m - near_m)), nan=np.inf)))
