"""Close-ups of runs: which late detection to look at, and its track just before and just after it was fused."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import tee
from pathlib import Path
from typing import NamedTuple, Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import FUSED, DetectionList, Disposition, Message
from fgtrack.evaluation.matching import published_rows
from fgtrack.evaluation.runs import EvaluatedRun, by_recording
from fgtrack.evaluation.truth import true_paths
from fgtrack.io.run import Run, load_run
from fgtrack.io.source import open_input
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import validate
from fgtrack.pipeline.replay import delivered
from fgtrack.plotting.close_up import STEP_S, Arrival, CloseUp, Estimates
from fgtrack.plotting.close_up import close_up as figure_of
from fgtrack.plotting.paper import Paper
from fgtrack.tracking.tracker import Tracker

_BACK_S = 0.15  # before the detection the estimates begin
_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
_SETTLED = 20  # measurements of a track before which it moves for want of a good start
_EARLY_S = 20.0  # what the choice is restricted to: the recording is replayed up to the detection for every run


def close_ups(runs: Sequence[Run | Path | str], stamp_ns: int | None = None) -> list[CloseUp]:
    """Return one late detection in slow motion, in each of `runs`: its track before and after it was fused.

    The detection is a typical one of those that lower the error of the first run's present, see `chosen`; `rule` of
    the result is the rule of the choice. The recording is replayed up to there for every run; `fgtrack.plot.close_up`
    draws the result.

    Parameters
    ----------
    runs
        Runs of one recording, or their folders.
    stamp_ns
        Choose the detection with the stamp nearest to this one.

    Raises
    ------
    CallError
        A folder holds no run.
    DataError
        The first run fused no such detection, a run did not fuse it, or a recording is not there any more.
    """
    read = [run if isinstance(run, Run) else load_run(Path(run)) for run in runs]
    arrival, rule = chosen(read, stamp_ns)
    recordings = [(run.recording, run.config.get("input")) for run in read]
    same = recordings.count(recordings[0]) == len(read)
    recorded = tee(_recorded(read[0]), len(read)) if same else map(_recorded, read)  # a recording is read once
    return [replace(close_up_of(run, arrival, one), rule=rule) for run, one in zip(read, recorded, strict=True)]


def drawn_close_up(
    runs: Sequence[EvaluatedRun], stamp_ns: int | None = None, **paper: Unpack[Paper]
) -> tuple[list[tuple[str, Figure]], CloseUp | DataError]:
    """Return the named figure of `close_ups` and the first of these; no figure and the error where there is none.

    It is that of the runs of the first one's recording.
    """
    same = by_recording(runs)[0]
    try:
        late = close_ups([one.run for one in same], stamp_ns)
    except DataError as error:
        return [], error
    return [("close_up", figure_of(same, late, **paper))], late[0]


def _recorded(run: Run) -> Iterator[Message]:
    """Return the messages of its recording. Raises `DataError` where that is not there any more."""
    if run.recording is None:
        given = (run.meta.get("input") or {}).get("path") or "messages in memory"
        raise DataError(f"{given}: the recording of the run is not there, so no close-up")
    try:
        return open_input(run.recording, validate(Config, run.config, str(run.config_path)).input).messages()
    except CallError as error:  # nobody has called with it: the run names it
        raise DataError(f"{error}, so no close-up") from error


def close_up_of(run: Run, arrival: Arrival, messages: Iterable[Message] | None = None) -> CloseUp:
    """Return the track of `run` that fused `arrival`, before and after: its recording is replayed up to there.

    `messages` are by default read from it. What came with the same tick before the list is processed first, by itself;
    what came after it is left out. Raises `DataError` if the recording or a file that the configuration names is not
    there any more, the recording does not hold the detection, or no track fused it.
    """
    try:
        config = validate(Config, run.config, str(run.config_path))
        tracker = build_tracker(config)
    except CallError as error:  # as above
        raise DataError(f"{error}, so no close-up") from error
    key = arrival.sensor, arrival.receipt_ns, arrival.index
    start_ns, fused_ns = arrival.stamp_ns - nanoseconds(_BACK_S), list[tuple[int | None, int]]()
    name = f"detection {arrival.index} of {arrival.sensor} received at {arrival.receipt_ns} ns"
    for now_ns, batch in delivered(_recorded(run) if messages is None else messages, config):
        lists = (
            k
            for k, message in enumerate(batch)
            if isinstance(message, DetectionList) and key[:2] == (message.sensor, message.receipt_ns)
        )
        row = next(lists, None)
        for message in batch[:row]:
            tracker.receive(message)
        report = tracker.tick(now_ns)
        fused_ns += [(one.track_id, one.stamp_ns) for one in report.updates if one.disposition in FUSED[1:]]
        if row is None:
            continue
        stamps_ns = sorted({*range(now_ns, start_ns - 1, -nanoseconds(STEP_S)), arrival.stamp_ns}, reverse=True)
        before = {one.track_id: _estimates(tracker, one.track_id, stamps_ns) for one in report.tracks}
        tracker.receive(batch[row])
        updates = tracker.tick(now_ns).updates
        taken = next((one for one in updates if (one.sensor, one.receipt_ns, one.index) == key), None)
        if taken is None or taken.disposition not in FUSED or taken.track_id not in before:
            raise DataError(f"{name}: no track has fused it ({taken.disposition if taken else 'no such detection'})")
        track_id, after = taken.track_id, _estimates(tracker, taken.track_id, stamps_ns)
        since_ns = sorted(stamp for track, stamp in fused_ns if track == track_id and stamp >= start_ns)
        return CloseUp(arrival, now_ns, track_id, before[track_id], after, np.array(since_ns, dtype=np.int64))
    raise DataError(f"{name}: there is no such list")


def _estimates(tracker: Tracker, track_id: int, stamps_ns: Iterable[int]) -> Estimates:
    """States at the falling `stamps_ns`, as far as the track's window reaches back."""
    states = []
    for stamp_ns in stamps_ns:
        try:
            states.append(tracker.state_at(track_id, stamp_ns).state)
        except CallError:  # before its window
            break
    states.reverse()
    return Estimates(np.array([state.stamp_ns for state in states]), np.array([state.mean for state in states]))


class _Late(NamedTuple):
    """A late detection that its track fused by itself: its effect on the present of one run."""

    track_id: int
    moved_m: float
    """From where the tick before it predicted the present."""
    before_m: float
    """Error of the present before it; NaN without truth."""
    after_m: float


def chosen(runs: Sequence[Run], stamp_ns: int | None = None) -> tuple[Arrival, str]:
    """Return a typical out-of-sequence detection that every run fused, and a sentence with the rule of the choice.

    Of those that lower the error of the first run's present, it is the one with errors nearest to their root mean
    squares: before it in the first run, after it in all of them; nearest is the largest of the ratios. It is one of
    the first 20 s where there is any. Without truth it is the one that moves the present by the median. Ticks at which
    a track fused several detections, and tracks with fewer than twenty, are left out. With `stamp_ns` it is the one
    with the nearest stamp. Raises `DataError` if there is none.
    """
    first, *others = (_late_detections(run) for run in runs)
    common = [one for one in first if all(one in other for other in others)]
    if not common:
        raise DataError(
            f"{runs[0].path or 'the run'}: no late detection was fused by itself after {_SETTLED} others, so there is "
            "no close-up"
        )
    if stamp_ns is not None:
        return min(common, key=lambda one: abs(one.stamp_ns - stamp_ns)), "Chosen by its stamp."
    errors_m = np.array(
        [[first[one].before_m, first[one].after_m, *(late[one].after_m for late in others)] for one in common]
    )
    lowered = errors_m[:, 1] < errors_m[:, 0]
    if not lowered.any():
        moved_m = np.array([first[one].moved_m for one in common])
        row = int(np.abs(moved_m - np.median(moved_m)).argmin())
        return common[row], f"Of {len(common)} late detections, the one that moves the present by the median."
    rms_m = np.sqrt(np.nanmean(errors_m[lowered] ** 2, axis=0))
    with np.errstate(divide="ignore"):
        apart = np.abs(np.log(errors_m / rms_m)).max(axis=1)
    candidates = lowered & np.isfinite(apart)
    receipts_ns = np.array([one.receipt_ns for one in common])
    early = candidates & (receipts_ns - receipts_ns.min() <= nanoseconds(_EARLY_S))
    row = int(np.where(early if early.any() else candidates, apart, np.inf).argmin())
    rms_all_m = np.sqrt(np.nanmean(errors_m[:, :2] ** 2, axis=0))
    return common[row], (
        f"{100.0 * float(lowered.mean()):.0f} % of {len(common)} late detections lower the error of the present; this "
        f"one, of the first {_EARLY_S:g} s, is nearest to their root mean square ({rms_m[0]:.2f} to {rms_m[1]:.2f} m; "
        f"of all {rms_all_m[0]:.2f} to {rms_all_m[1]:.2f} m)."
    )


def _late_detections(run: Run) -> dict[Arrival, _Late]:
    updates, tracks, paths = run.tables["updates"], run.tables["tracks"], true_paths(run.tables["truth"])
    used = np.isin(updates["disposition"], FUSED[1:])
    pairs = np.stack([updates["tick"], updates["track_id"]], axis=-1)
    _, group, sizes = np.unique(pairs[used], axis=0, return_inverse=True, return_counts=True)
    alone = np.zeros(len(used), dtype=bool)
    alone[used] = sizes[group.reshape(-1)] == 1
    late = np.flatnonzero(alone & (updates["disposition"] == Disposition.OUT_OF_SEQUENCE))
    rows, before = (published_rows(tracks, pairs[late, 0] - back, pairs[late, 1]) for back in (0, 1))
    known = (rows >= 0) & (before >= 0) & (tracks["num_measured"][rows] >= _SETTLED)
    late, rows, before = late[known], rows[known], before[known]
    states, now_ns = np.stack([tracks[name] for name in _STATE], axis=-1), tracks["now_ns"][rows]
    dt_s = (now_ns - tracks["now_ns"][before]) / NS_PER_S
    at_m, predicted_m = states[rows, :2], CTRV().predict(states[before], dt_s)[:, :2]
    true_m = np.stack([path.at(now_ns)[:, :2] for path in paths] or [np.full_like(at_m, np.nan)], axis=1)
    apart_m = np.linalg.norm(true_m - at_m[:, None], axis=-1)
    nearest_m = true_m[np.arange(len(late)), np.where(np.isnan(apart_m), np.inf, apart_m).argmin(axis=1)]
    ends_m = ((at_m, predicted_m), (predicted_m, nearest_m), (at_m, nearest_m))
    lengths_m = [np.linalg.norm(one - other, axis=-1).tolist() for one, other in ends_m]
    columns = (updates[name][late].tolist() for name in ("sensor", "stamp_ns", "receipt_ns", "index"))
    keys = (Arrival(*key) for key in zip(*columns, strict=True))
    return dict(zip(keys, map(_Late, pairs[late, 1].tolist(), *lengths_m), strict=True))
