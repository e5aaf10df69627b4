"""Choice of a late detection, and the estimates of its track just before and after the fusion."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import validate
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import (
    FUSED,
    DetectionList,
    Disposition,
    FloatArray,
    IntArray,
)
from fgtrack.evaluation.matching import published_rows
from fgtrack.evaluation.runs import EvaluatedRun, by_recording
from fgtrack.evaluation.truth import paths_around
from fgtrack.meaning.draft import opened
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.replay import delivered
from fgtrack.runs import Run, load_run
from fgtrack.show.figures.close_up import STEP_S, Arrival, CloseUp, Estimates
from fgtrack.show.figures.close_up import close_up as figure_of
from fgtrack.show.figures.paper import Paper
from fgtrack.tracking.tracker import MultiObjectTracker

# The estimates begin this time before the detection.
_BACK_S = 0.15
# Largest number of estimates of a track, for a detection with a long delay.
_MOST_STEPS = 500
_STATE = ["x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps"]
_DETECTION = ["sensor", "stamp_ns", "receipt_ns", "index"]
# Number of measurements after which the first state of a track hardly matters.
_SETTLED = 20
# Length of the first part of the recording in which the detection is chosen, if possible. Every run replays
# the recording up to the detection.
_EARLY_S = 20.0
# Largest number of late detections among which one is chosen: a close-up of an hour needs the hour's first minutes.
_MOST_LATE = 10_000


def close_ups(
    runs: Sequence[Run | Path | str], stamp_ns: int | None = None
) -> list[CloseUp]:
    """Return close-ups of one late detection in each of `runs`: its track before and after the fusion.

    The detection is a typical one among those that lower the present error of the first
    run, see `chosen`. With `stamp_ns` it is the detection with the nearest stamp.
    `runs` are runs of one recording, or their folders. The recording is replayed up to
    the detection for every run. `fgtrack.plot.close_up` draws the result.

    Raises `CallError` if a folder is not a run. Raises `DataError` if the first run
    fused no late detection, or a run did not fuse the chosen one. Also if a recording
    is missing.
    """
    read = [run if isinstance(run, Run) else load_run(Path(run)) for run in runs]
    arrival, rule = chosen(read, stamp_ns)
    return [close_up_of(run, arrival, rule) for run in read]


def drawn_close_up(
    runs: Sequence[EvaluatedRun], stamp_ns: int | None = None, **paper: Unpack[Paper]
) -> tuple[list[tuple[str, Figure]], CloseUp | DataError]:
    """Return the named figure of `close_ups` and its first close-up; without a close-up no figure, and the error.

    It covers the runs of the same recording as the first run.
    """
    same = by_recording(runs)[0]
    try:
        late = close_ups([item.run for item in same], stamp_ns)
    except DataError as error:
        return [], error
    return [("close_up", figure_of(same, late, **paper))], late[0]


def close_up_of(run: Run, arrival: Arrival, rule: str = "") -> CloseUp:
    """Return the track of `run` that fused `arrival`, before and after the fusion.

    The recording is replayed up to the detection. Messages of the same tick before the
    list are processed first, in a tick of their own. Messages after the list are
    ignored. Raises `DataError` if the recording or a configured file is missing, the
    recording lacks the detection, or no track fused it.
    """
    if run.recording is None:
        given = (run.meta.get("input") or {}).get("path") or "messages in memory"
        raise DataError(
            f"{given}: the recording of the run is missing, so there is no close-up"
        )
    try:
        config = validate(Config, run.config, str(run.config_path))
        tracker = build_tracker(config)
        messages = opened(run.recording, config).source.messages()
    except CallError as error:  # the path comes from the run, not from the caller
        raise DataError(f"{error}, so there is no close-up") from error
    key = arrival.sensor, arrival.receipt_ns, arrival.index
    start_ns = arrival.stamp_ns - nanoseconds(_BACK_S)
    fused_ns = list[tuple[int | None, int]]()
    name = f"detection {arrival.index} of {arrival.sensor} received at {arrival.receipt_ns} ns"
    for now_ns, batch in delivered(messages, config):
        lists = (
            k
            for k, message in enumerate(batch)
            if isinstance(message, DetectionList)
            and key[:2] == (message.sensor, message.receipt_ns)
        )
        row = next(lists, None)
        for message in batch[:row]:
            tracker.receive(message)
        report = tracker.tick(now_ns)
        fused_ns += [
            (item.track_id, item.stamp_ns)
            for item in report.updates
            if item.disposition in FUSED[1:]
        ]
        if row is None:
            continue
        step_ns = nanoseconds(STEP_S) * (
            1 + (now_ns - start_ns) // nanoseconds(_MOST_STEPS * STEP_S)
        )
        stamps_ns = sorted(
            {*range(now_ns, start_ns - 1, -step_ns), arrival.stamp_ns}, reverse=True
        )
        before = {
            item.track_id: _estimates(tracker, item.track_id, stamps_ns)
            for item in report.tracks
        }
        tracker.receive(batch[row])
        updates = tracker.tick(now_ns).updates
        taken = next(
            (
                item
                for item in updates
                if (item.sensor, item.receipt_ns, item.index) == key
            ),
            None,
        )
        if (
            taken is None
            or taken.disposition not in FUSED
            or taken.track_id not in before
        ):
            raise DataError(
                f"{name}: no track fused it ({taken.disposition if taken else 'no such detection'})"
            )
        track_id = taken.track_id
        after = _estimates(tracker, track_id, stamps_ns)
        since_ns = sorted(
            stamp
            for track, stamp in fused_ns
            if track == track_id and stamp >= start_ns
        )
        return CloseUp(
            arrival,
            now_ns,
            track_id,
            before[track_id],
            after,
            np.array(since_ns, dtype=np.int64),
            rule,
        )
    raise DataError(f"{name}: the recording has no such list")


def _estimates(
    tracker: MultiObjectTracker, track_id: int, stamps_ns: Iterable[int]
) -> Estimates:
    """Return the states of a track at the descending `stamps_ns`, up to the first stamp before its window.

    The result is in ascending order.
    """
    states = []
    for stamp_ns in stamps_ns:
        try:
            states.append(tracker.state_at(track_id, stamp_ns).state)
        except CallError:  # before its window
            break
    states.reverse()
    return Estimates(
        np.array([state.stamp_ns for state in states]),
        np.array([state.mean for state in states]),
    )


def chosen(runs: Sequence[Run], stamp_ns: int | None = None) -> tuple[Arrival, str]:
    """Return a typical out-of-sequence detection that every run fused, and a sentence on the choice.

    With `stamp_ns` it is the detection with the nearest stamp. Otherwise the candidates are the detections that lower
    the error of the present in the first run. Each has the error before the fusion in the first run, and the errors
    after the fusion in all runs. The chosen detection has errors near their root mean squares: its largest ratio to
    them is the smallest. It lies in the first 20 s if possible. If no detection lowers the error, or without truth, it
    is the detection that moves the present by the median distance.

    Ticks in which a track fused several detections are excluded, and tracks with fewer than twenty measurements. Raises
    `DataError` if there is no such detection.
    """
    first, *others = (_late_detections(run, stamp_ns) for run in runs)
    late = first[
        np.all([first.index.isin(other.index) for other in (first, *others)], axis=0)
    ]
    if late.empty:
        raise DataError(
            f"{runs[0].path or 'the run'}: no late detection was fused alone in a tick after {_SETTLED} other "
            "measurements of its track, so there is no close-up"
        )
    arrivals = [Arrival(*key) for key in late.index.tolist()]
    if stamp_ns is not None:
        return min(
            arrivals, key=lambda item: abs(item.stamp_ns - stamp_ns)
        ), "Chosen by its stamp."
    errors_m = np.column_stack(
        [
            late["before_m"],
            late["after_m"],
            *(other.loc[late.index, "after_m"] for other in others),
        ]
    )
    lowered = errors_m[:, 1] < errors_m[:, 0]
    if not lowered.any():
        row = int((late["moved_m"] - late["moved_m"].median()).abs().argmin())
        return (
            arrivals[row],
            f"Of {late.attrs['name']}, the one that moves the present by the median.",
        )
    rms_m, (rms_before_m, rms_after_m, *_) = (
        np.sqrt(np.nanmean(rows_m**2, axis=0))
        for rows_m in (errors_m[lowered], errors_m)
    )
    with np.errstate(divide="ignore"):
        ratio = np.abs(np.log(errors_m / rms_m)).max(axis=1)
    candidates = lowered & np.isfinite(ratio)
    receipts_ns = np.array([item.receipt_ns for item in arrivals])
    early = candidates & (receipts_ns - receipts_ns.min() <= nanoseconds(_EARLY_S))
    row = int(np.where(early if early.any() else candidates, ratio, np.inf).argmin())
    return arrivals[row], (
        f"{100.0 * float(lowered.mean()):.0f} % of {late.attrs['name']} lower the present error; this "
        f"detection, of the first {_EARLY_S:g} s, is nearest to their root mean square ({rms_m[0]:.2f} to "
        f"{rms_m[1]:.2f} m; over all late detections {rms_before_m:.2f} to {rms_after_m:.2f} m)."
    )


def _late_detections(
    run: Run, stamp_ns: int | None
) -> Any:  # Any: a DataFrame, whose columns have no types
    """Return a table of the late detections that a track fused alone in a tick, indexed by `_DETECTION`.

    The track has fused at least `_SETTLED` detections. Columns in metres: `moved_m`, the distance of the present from
    its prediction, and `before_m` and `after_m`, the errors before and after the fusion. They are NaN without truth.
    Only the first `_MOST_LATE` late detections count, or with `stamp_ns` those with the nearest stamps. `attrs["name"]`
    names them in a sentence.
    """
    import pandas as pd

    tracks, updates = run.tables["tracks"], run.tables["updates"]
    fused = updates.where(np.isin(updates["disposition"], FUSED[1:]))
    together = np.stack([fused["tick"], fused["track_id"]], axis=-1)
    _, inverse, counts = np.unique(
        together, axis=0, return_inverse=True, return_counts=True
    )
    late = fused.where(
        (fused["disposition"] == Disposition.OUT_OF_SEQUENCE) & (counts[inverse] == 1)
    )
    is_cut = late.num_rows > _MOST_LATE
    if is_cut and stamp_ns is not None:
        away_ns = np.abs(late["stamp_ns"] - stamp_ns)
        late = late.where(np.sort(np.argsort(away_ns, kind="stable")[:_MOST_LATE]))
    elif is_cut:
        late = late.where(np.arange(_MOST_LATE))
    rows, rows_before = (
        published_rows(tracks, late["tick"] - back, late["track_id"]) for back in (0, 1)
    )
    known = (rows >= 0) & (rows_before >= 0)
    known[known] = tracks["num_measured"][rows[known]] >= _SETTLED
    late = late.where(known)
    now, before = tracks.where(rows[known]), tracks.where(rows_before[known])
    now_ns = now["now_ns"]
    at_m = np.stack([now["x_m"], now["y_m"]], axis=-1)
    predicted_m = CTRV().predict(
        np.stack([before[name] for name in _STATE], axis=-1),
        (now_ns - before["now_ns"]) / NS_PER_S,
    )[:, :2]
    nearest_m = _nearest_truth(run, now_ns, at_m)
    table = pd.DataFrame({name: late[name] for name in _DETECTION})
    for name, item, other in (
        ("moved_m", at_m, predicted_m),
        ("before_m", predicted_m, nearest_m),
        ("after_m", at_m, nearest_m),
    ):
        table[name] = np.linalg.norm(item - other, axis=-1)
    table = table.drop_duplicates(_DETECTION).set_index(_DETECTION)
    table.attrs["name"] = (
        f"{'the first ' if is_cut else ''}{len(table)} late detections"
    )
    return table


def _nearest_truth(run: Run, now_ns: IntArray, at_m: FloatArray) -> FloatArray:
    """Return the position of the true object that is nearest to each position `at_m` (n, 2) at `now_ns` (n,)."""
    nearest_m = np.full_like(at_m, np.nan)
    least_m = np.full(len(at_m), np.inf)
    for path in paths_around(run, now_ns):
        true_m = path.at(now_ns)[:, :2]
        distance_m = np.linalg.norm(true_m - at_m, axis=-1)
        nearer = distance_m < least_m
        nearest_m[nearer] = true_m[nearer]
        least_m[nearer] = distance_m[nearer]
    return nearest_m
