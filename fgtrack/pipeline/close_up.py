"""Close-ups of runs: which late detection to look at, and their recordings replayed up to it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.io.run import Run, load_run, recording_of
from fgtrack.io.source import open_input
from fgtrack.models.motion import CTRV
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import validate
from fgtrack.pipeline.replay import delivered
from fgtrack.tracking.close_up import Arrival, CloseUp, close_up

_STATE = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
_SETTLED = 20  # measurements of a track before which it moves for want of a good start


def close_ups(
    runs: Sequence[Run | Path | str], track_id: int | None = None, stamp_ns: int | None = None
) -> list[CloseUp]:
    """One late detection in slow motion, in each of `runs`: its track before and after it was fused.

    The detection is the one of the first run after which the present moved most, see `most_moved`. The recording is
    replayed up to there for every run; `fgtrack.plot.close_up` draws the result.

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
    arrival = most_moved(read[0], track_id, stamp_ns)
    return [close_up_of(run, arrival) for run in read]


def close_up_of(run: Run, arrival: Arrival) -> CloseUp:
    """The track of `run` that fused `arrival`, before and after: its recording is replayed up to there.

    Raises
    ------
    DataError
        The recording, or a file that the configuration names, is not there any more; or it does not hold the
        detection; or no track fused it.
    """
    recording = recording_of(run)
    if recording is None:
        given = (run.meta.get("input") or {}).get("path") or "messages in memory"
        raise DataError(f"{given}: the recording of the run is not there, so no close-up")
    try:
        config = validate(Config, run.config, str(run.config_path))
        ticks = delivered(open_input(recording, config.input).messages(), config)
        return close_up(lambda observed: build_tracker(config, observed), ticks, arrival)
    except CallError as error:  # nobody has called with it: it is what the run says
        raise DataError(f"{error}, so no close-up") from error


def most_moved(run: Run, track_id: int | None = None, stamp_ns: int | None = None) -> Arrival:
    """The out-of-sequence detection after which the present state of its track moved most.

    Moved is the distance from where the state of the tick before would be by now. Ticks at which a track fused several
    detections, and tracks with fewer than twenty, are left out.

    Parameters
    ----------
    run
        The run.
    track_id
        Only detections that this track fused; None for any.
    stamp_ns
        The detection with the stamp nearest to this one, in place of that which moved most.

    Raises
    ------
    DataError
        The run has no such detection.
    """
    updates = run.updates
    late = updates["disposition"] == "out_of_sequence"
    if track_id is not None:
        late &= updates["track_id"] == track_id
    used = np.isin(updates["disposition"], ("in_sequence", "out_of_sequence", "beyond_window"))
    pairs = np.stack([updates["tick"], updates["track_id"]], axis=-1)
    _, group, sizes = np.unique(pairs[used], axis=0, return_inverse=True, return_counts=True)
    alone = np.zeros(len(used), dtype=bool)
    alone[used] = sizes[group.reshape(-1)] == 1
    rows = np.flatnonzero(late & alone)
    moved_m = _moved_m(run, pairs[rows])
    rows, moved_m = rows[np.isfinite(moved_m)], moved_m[np.isfinite(moved_m)]
    if not len(rows):
        where, of = run.path or "the run", "" if track_id is None else f" of track {track_id}"
        if track_id is not None and track_id not in run.tracks["track_id"]:
            raise DataError(f"{where}: has no track {track_id}")
        raise DataError(
            f"{where}: no late detection{of} was fused by itself after {_SETTLED} others, so there is no close-up"
        )
    row = rows[moved_m.argmax() if stamp_ns is None else np.abs(updates["stamp_ns"][rows] - stamp_ns).argmin()]
    found = (int(updates[name][row]) for name in ("stamp_ns", "receipt_ns", "index"))
    return Arrival(str(updates["sensor"][row]), *found)


def _moved_m(run: Run, wanted: IntArray) -> FloatArray:
    """By how much each of `wanted` (n, 2), ticks and tracks, moved against the tick before; NaN where unknown, (n,)."""
    tracks = run.tracks
    order = np.lexsort((tracks["tick"], tracks["track_id"]))
    keys = np.stack([tracks["tick"], tracks["track_id"]], axis=-1)[order]
    states = np.stack([tracks[name] for name in _STATE], axis=-1)[order]
    settled = tracks["num_measured"][order] >= _SETTLED
    index = {key: row for row, key in enumerate(map(tuple, keys.tolist()))}
    found = np.full(len(wanted), np.nan)
    now_ns, motion = tracks["now_ns"][order], CTRV()
    for place, (tick, track) in enumerate(wanted.tolist()):
        row = index.get((tick, track))
        if row is not None and row and settled[row] and keys[row - 1, 1] == track:
            expected = motion.predict(states[row - 1], seconds(int(now_ns[row] - now_ns[row - 1])))
            found[place] = np.hypot(*(states[row, :2] - expected[:2]))
    return found
