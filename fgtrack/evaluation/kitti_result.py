"""A run of a KITTI sequence as a result file of the data set, for its own evaluation and for that of AB3DMOT.

A line per track and frame: `frame track type truncated occluded alpha left top right bottom h w l x y z rotation_y
score` (Geiger, Lenz, Urtasun 2012, development kit of the tracking benchmark). The tracker knows where an object is in
the plane and which way it heads. The rest is what the detections of boxes say that its track has fused by then: mean
size and score, most frequent class, last height above the ground. The box in the image is the box in space as camera 2
sees it, cut at the borders.
"""

import math
import re
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

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

__all__ = ["KittiResult", "write_kitti_result"]

#: As `_line` writes it: frame, track, type, not told how truncated and occluded, thirteen numbers.
_LINE = re.compile(rb"\d+ \d+ .+ -1 -1( -?\d+\.\d{6}){13}")
_LONGEST_LINE = 1000


@dataclass(frozen=True)
class KittiResult:
    """What was written."""

    lines: int
    """Boxes, one of each track at each frame."""
    tracks: int
    without_box: int
    """Tracks that are not in it, because no detection of theirs says how large the object is."""


@dataclass
class _Seen:
    """What the detections of a track say of its object so far."""

    middle_m: float = math.nan
    sizes_m: list[tuple[float, float, float]] = field(default_factory=list)
    """Height, width and length of each."""
    scores: list[float] = field(default_factory=list)
    classes: Counter[str] = field(default_factory=Counter)

    def take(self, size_m: tuple[float, float, float], middle_m: float, score: float, name: str) -> None:
        if name:
            self.classes[name] += 1
        if not math.isfinite(sum(size_m) + middle_m):
            return
        self.sizes_m.append(size_m)
        self.middle_m = middle_m
        if math.isfinite(score):
            self.scores.append(score)


def write_kitti_result(run: Run, sequence: Path, out: Path, *, overwrite: bool = False) -> KittiResult:
    """Write the tracks of `run` at the frames of `sequence` to the text file `out`.

    A track is in it where it is `confirmed`, unless the run is judged by all (`evaluation.confirmed_only`).

    Parameters
    ----------
    sequence
        The file of the sequence in `oxts/`, or a folder with one sequence: it says where the camera is.

    Raises
    ------
    CallError
        `sequence` is none, something is at `out`, or it lies in an input.
    DataError
        A file of the sequence is damaged, or no detection of the run says how large its object is.
    """
    if not is_sequence(sequence):
        raise CallError(f"{sequence}: is no sequence of the KITTI data set, name its oxts/NNNN.txt")
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
    return KittiResult(len(lines), len(tracks), len(without - tracks))


def _lines(run: Run, views: list[View]) -> tuple[list[str], set[int], set[int]]:
    """Lines, the tracks that are in them, and those that are not for want of a box at some frame."""
    tracks = (
        run.tables["tracks"].where(confirmed(run.tables["tracks"]))
        if run.evaluation.confirmed_only
        else run.tables["tracks"]
    )
    of_tick = defaultdict(list)
    for row, tick in enumerate(tracks["tick"].tolist()):
        of_tick[tick].append(row)
    names = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps")
    states = np.nan_to_num(np.column_stack([tracks[name] for name in names]))
    ids = tracks["track_id"].tolist()
    told = _Told(run)
    lines, written, without = [], set(), set()
    for frame, (now_ns, tick) in _ticks(run, len(views)).items():
        told.until(tick)
        ahead_s = seconds(frame * PERIOD_NS - now_ns)
        for row in of_tick[tick]:
            seen = told.of[ids[row]]
            if not seen.sizes_m:
                without.add(ids[row])
                continue
            line = _line(frame, ids[row], views[frame], _moved(states[row], ahead_s), seen)
            if line is not None:
                lines.append(line)
                written.add(ids[row])
    return lines, written, without


class _Told:
    """Goes through the detections as they were fused, and keeps what they say of each track."""

    def __init__(self, run: Run) -> None:
        self.of: dict[int, _Seen] = defaultdict(_Seen)
        detections, updates, rows = run.tables["detections"], run.tables["updates"], update_rows(run)
        fused = np.flatnonzero(rows >= 0)
        fused = fused[updates["track_id"][rows[fused]] != NO_TRACK]
        ticks = updates["tick"][rows[fused]]
        order = np.argsort(ticks, kind="stable")
        self._ticks, self._next = ticks[order].tolist(), 0
        self._ids = updates["track_id"][rows[fused]][order].tolist()
        columns = ("height_m", "width_m", "length_m", "z_m", "score", "class_name")
        self._values = list(zip(*(detections[name][fused][order].tolist() for name in columns), strict=True))

    def until(self, tick: int) -> None:
        """Take in what was fused up to `tick`."""
        while self._next < len(self._ticks) and self._ticks[self._next] <= tick:
            *size_m, middle_m, score, name = self._values[self._next]
            self.of[self._ids[self._next]].take(tuple(size_m), middle_m, score, name)
            self._next += 1


def _ticks(run: Run, num_frames: int) -> dict[int, tuple[int, int]]:
    """Time and number of the newest tick at each frame; not of a frame within whose period there was none before."""
    found: dict[int, tuple[int, int]] = {}
    for now_ns, tick in zip(
        run.tables["timing"]["now_ns"].tolist(), run.tables["timing"]["tick"].tolist(), strict=True
    ):
        frame = -(-now_ns // PERIOD_NS)  # the first one that is not before the tick
        if 0 <= frame < num_frames:
            found[frame] = (now_ns, tick)
    return dict(sorted(found.items()))


def _moved(state: np.ndarray, ahead_s: float) -> tuple[float, float, float]:
    """Position and yaw of a state a moment later, at constant speed and yaw rate."""
    x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = state.tolist()
    middle_rad = yaw_rad + 0.5 * ahead_s * yaw_rate_radps
    way_m = speed_mps * ahead_s
    x_m, y_m = x_m + way_m * math.cos(middle_rad), y_m + way_m * math.sin(middle_rad)
    return x_m, y_m, wrap_angle(yaw_rad + ahead_s * yaw_rate_radps)


def _line(frame: int, track_id: int, view: View, pose: tuple[float, float, float], seen: _Seen) -> str | None:
    """The line of a track; None where camera 2 does not see it."""
    x_m, y_m, yaw_rad = pose
    height_m, width_m, length_m = np.mean(seen.sizes_m, axis=0).tolist()
    ego = view.ego
    ahead_m, aside_m = (np.array([x_m - ego.x_m, y_m - ego.y_m]) @ rotation(ego.yaw_rad)).tolist()
    bottom = np.array([ahead_m, aside_m, seen.middle_m - 0.5 * height_m])
    place, turned_rad = view.rectified(bottom, yaw_rad - ego.yaw_rad)
    right_m, down_m, forward_m = place.tolist()
    box = Box(height_m, width_m, length_m, right_m, down_m, forward_m, turned_rad)
    image = box.image_px(view.calibration)
    if image is None:
        return None
    kind = seen.classes.most_common(1)[0][0] if seen.classes else "car"
    alpha_rad = wrap_angle(turned_rad - math.atan2(box.x_m, box.z_m))
    score = float(np.mean(seen.scores)) if seen.scores else 1.0
    numbers = (alpha_rad, *image, *box, score)
    return f"{frame} {track_id} {CLASS_NAMES.get(kind, kind)} -1 -1 {' '.join(f'{value:.6f}' for value in numbers)}\n"
