"""A run of a KITTI sequence as a result file of the data set, for its own evaluation and for that of AB3DMOT.

A line per track and frame: `frame track type truncated occluded alpha left top right bottom h w l x y z rotation_y
score` (Geiger, Lenz, Urtasun 2012, development kit of the tracking benchmark). Tracks have position and
heading in the plane. The rest comes from the detections of boxes that the track has fused by then: mean
size and score, most frequent class, last height above the ground. The box in the image is the box in space as camera 2
sees it, cut at the borders.
"""

import math
from bisect import bisect_right
from collections import Counter, defaultdict
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.geometry import rotation, wrap_angle
from fgtrack.core.time import seconds
from fgtrack.evaluation.matching import confirmed
from fgtrack.evaluation.placement import update_rows
from fgtrack.io.adapters.kitti import CLASS_NAMES, is_sequence, view_of_sequence
from fgtrack.io.adapters.kitti_view import PERIOD_NS, Box, View
from fgtrack.io.output import check_apart, new_file
from fgtrack.io.run import NO_TRACK, Run

_SIZE = ("height_m", "width_m", "length_m", "z_m")


#: Mean height, width and length of a track, last height of its middle above ground, mean score, most frequent class.
_Description = tuple[list[float], float, float, str]


def write_kitti_result(run: Run, sequence: Path, out: Path, *, overwrite: bool = False) -> tuple[int, int, int]:
    """Write the tracks of `run` at the frames of `sequence` to the text file `out`.

    Returns the boxes, one of each track at each frame, the tracks that have one, and those that have none, because no
    detection of theirs has a size. Tracks are written where they are `confirmed`, unless all are evaluated
    (`evaluation.confirmed_only`). `sequence` is the file of the sequence in `oxts/`, or a folder with one sequence.

    Raises
    ------
    CallError
        `sequence` is not one, something is at `out`, or it lies in an input.
    DataError
        A file of the sequence is damaged, or no detection of the run has a size.
    """
    if not is_sequence(sequence):
        raise CallError(f"{sequence}: is not a sequence of the KITTI data set, name its oxts/NNNN.txt")
    check_apart(out, [sequence, *(() if run.path is None else (run.path,))])
    views = view_of_sequence(sequence)
    lines, tracks, without = _lines(run, views)
    if not lines and without:
        raise DataError(
            f"{run.path}: no detection of its tracks has a size (detections.csv), which a box needs: replay detections "
            "with length_m, width_m, height_m and z_m"
        )
    with new_file(out, overwrite) as file:
        file.write("".join(lines).encode())
    return len(lines), len(tracks), len(without - tracks)


def _lines(run: Run, views: list[View]) -> tuple[list[str], set[int], set[int]]:
    """Lines, the tracks that are in them, and those that are not for want of a box at some frame."""
    tracks = run.tables["tracks"]
    tracks = tracks.where(confirmed(tracks)) if run.evaluation.confirmed_only else tracks
    of_tick = defaultdict(list)
    for row, tick in enumerate(tracks["tick"].tolist()):
        of_tick[tick].append(row)
    names = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
    states = np.nan_to_num(np.column_stack([tracks[name] for name in names]))
    ids, fused = tracks["track_id"].tolist(), _fused(run)
    lines, written, without = [], set(), set()
    for frame, (now_ns, tick) in _ticks(run, len(views)).items():
        ahead_s = seconds(frame * PERIOD_NS - now_ns)
        for row in of_tick[tick]:
            description = _described(fused[ids[row]], tick)
            if description is None:
                without.add(ids[row])
                continue
            line = _line(frame, ids[row], views[frame], _moved(states[row], ahead_s), description)
            if line is not None:
                lines.append(line)
                written.add(ids[row])
    return lines, written, without


def _fused(run: Run) -> dict[int, list[tuple[Any, ...]]]:
    """By track the tick, size, height above ground, score and class of the detections that it fused, by tick."""
    detections, updates, rows = run.tables["detections"], run.tables["updates"], update_rows(run)
    fused = np.flatnonzero(rows >= 0)
    fused = fused[updates["track_id"][rows[fused]] != NO_TRACK]
    columns = (detections[name][fused].tolist() for name in (*_SIZE, "score", "class_name"))
    result: dict[int, list[tuple[Any, ...]]] = defaultdict(list)
    ticks, ids = (updates[name][rows[fused]].tolist() for name in ("tick", "track_id"))
    for track_id, *entry in sorted(zip(ids, ticks, *columns, strict=True), key=itemgetter(1)):
        result[track_id].append(tuple(entry))
    return result


def _described(entries: list[tuple[Any, ...]], tick: int) -> _Description | None:
    """Mean size and score, most frequent class and last height of the detections up to `tick`; None without a size."""
    until = entries[: bisect_right(entries, tick, key=itemgetter(0))]
    boxes = [entry for entry in until if math.isfinite(sum(entry[1:5]))]
    if not boxes:
        return None
    size_m = np.mean([entry[1:4] for entry in boxes], axis=0).tolist()
    scores = [entry[5] for entry in boxes if math.isfinite(entry[5])]
    kinds = Counter(entry[6] for entry in until if entry[6]).most_common(1)
    score, kind = float(np.mean(scores)) if scores else 1.0, kinds[0][0] if kinds else "car"
    return size_m, boxes[-1][4], score, kind


def _ticks(run: Run, num_frames: int) -> dict[int, tuple[int, int]]:
    """Time and number of the newest tick at each frame; not of a frame within whose period there was none before."""
    result: dict[int, tuple[int, int]] = {}
    for now_ns, tick in zip(
        run.tables["timing"]["now_ns"].tolist(), run.tables["timing"]["tick"].tolist(), strict=True
    ):
        frame = -(-now_ns // PERIOD_NS)  # the first one that is not before the tick
        if 0 <= frame < num_frames:
            result[frame] = (now_ns, tick)
    return dict(sorted(result.items()))


def _moved(state: np.ndarray, ahead_s: float) -> tuple[float, float, float]:
    """Position and yaw of a state a moment later, at constant speed and yaw rate."""
    x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = state.tolist()
    middle_rad = yaw_rad + 0.5 * ahead_s * yaw_rate_radps
    way_m = speed_mps * ahead_s
    x_m, y_m = x_m + way_m * math.cos(middle_rad), y_m + way_m * math.sin(middle_rad)
    return x_m, y_m, wrap_angle(yaw_rad + ahead_s * yaw_rate_radps)


def _line(
    frame: int, track_id: int, view: View, pose: tuple[float, float, float], described: _Description
) -> str | None:
    """The line of a track; None where camera 2 does not see it."""
    (x_m, y_m, yaw_rad), ego = pose, view.ego
    (height_m, width_m, length_m), middle_m, score, kind = described
    ahead_m, aside_m = (np.array([x_m - ego.x_m, y_m - ego.y_m]) @ rotation(ego.yaw_rad)).tolist()
    bottom = np.array([ahead_m, aside_m, middle_m - 0.5 * height_m])
    place, turned_rad = view.rectified(bottom, yaw_rad - ego.yaw_rad)
    right_m, down_m, forward_m = place.tolist()
    box = Box(height_m, width_m, length_m, right_m, down_m, forward_m, turned_rad)
    image = box.image_px(view.projection)
    if image is None:
        return None
    alpha_rad = wrap_angle(turned_rad - math.atan2(box.x_m, box.z_m))
    numbers = (alpha_rad, *image, *box, score)
    return f"{frame} {track_id} {CLASS_NAMES.get(kind, kind)} -1 -1 {' '.join(f'{value:.6f}' for value in numbers)}\n"
