"""Coverage of a sensor: its field of view, its range and its rate, estimated from a recording."""

import math
from array import array
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from fgtrack.core.geometry import wrap_angle, wrap_angles
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, Detection, DetectionList, EgoState, FloatArray, IntArray, Message
from fgtrack.models.sensors import Mount
from fgtrack.pipeline.assumptions.persistence import Lists, Persistence, disagreement_m, persistence

__all__ = ["Coverage", "coverages"]

#: Share of detections that may lie outside of the estimated view, and the number of which it is one at least.
_OUTSIDE, _FEWEST = 0.01, 100
#: Cells in which a detection must come back: at least so long, so many periods of the sensor, and so wide.
_CELL_S, _CELL_PERIODS, _CELL_M, _CELL_MPS, _CELL_BEARING = 0.25, 5.0, 3.0, 30.0, 0.3
#: How near detections follow one another up to the edges of a sector, and the margin of a range.
_LINK_RAD, _RANGE_FACTOR = 0.2, 1.1
#: No sensor of vehicles has a narrower sector (20 degrees, long-range RADAR); wider ones are not told from traffic.
_NARROWEST_RAD, _WIDEST_RAD = 0.35, 2.8
#: Axes are multiples of 45 degrees, where the middle of the sector is so near to one.
_AXES_RAD, _AXIS_TOLERANCE_RAD = math.pi / 4.0, 0.15

_OUTAGE_S = 2.0


@dataclass(frozen=True)
class Coverage:
    """Rate, field of view and range of a sensor, estimated from a recording."""

    measured: frozenset[str]
    """Components that its detections hold."""
    num_lists: int
    num_detections: int
    rate_hz: float | None
    """Lists per second; None of fewer than two."""
    axis_rad: float = 0.0
    """Direction of the middle of its sector, 0 along the axis of the frame of its detections."""
    field_of_view_rad: float | None = None
    """Full angle of its sector; None where it detects all around, or too seldom to tell."""
    range_m: float | None = None
    """Up to where it detects; None where it measures no range, or too seldom."""
    persistence: Persistence | None = None
    """Persistence of its detections from list to list; None where too few do."""
    disagreement_m: float | None = None
    """Least standard deviation of its positions against those of another sensor; None where none sees the same."""
    boxes: bool = False
    """True if its detections have a length and a width."""
    area_m2: float | None = None
    """Area over which its detections with a range are spread, at least that of the narrowest sector up to there."""
    silence_s: float = 0.0
    """Longest time between two lists running, up to `_OUTAGE_S`: after longer ones objects are new."""

    def __str__(self) -> str:
        rate = "" if self.rate_hz is None else f" at {self.rate_hz:.3g} Hz"
        return f"{self.num_detections} detections in {self.num_lists} lists{rate}"


def coverages(messages: Iterable[Message], mounts: Mapping[str, Mount] | None = None) -> dict[str, Coverage]:
    """Coverage of each sensor in `messages`, by name; `mounts` are the known ones.

    The estimate is that of what happens, not of a data sheet: where nothing is ever detected there may be nothing. For
    the tracks of the same recording both are the same, for there none is missed.

    - Only a detection that comes back counts: another list of the sensor has one close by and soon. Clutter that is
      spread over space and time seldom does, an object does at nearly every list.
    - The sector is the rest of the circle beside the widest arc with at most 1 % of these detections. It is taken up
      to 160 degrees: one car that overtakes has a sensor which looks all around detect in nearly half a circle, so
      that a wider sector cannot be told from traffic on one side.
    - Cars pass its edges within a few lists. So it goes on as far as the detections in that arc follow one another
      within 12 degrees and a third of what they would if they were spread evenly over it, as clutter is. The noise
      of the outermost ones is its margin.
    - The range is the quantile of 99 %, and a tenth more.
    - With fewer than 100 such detections, of which 1 % is not one, nothing is estimated.

    Detections in the map are seen from the ego, interpolated; without an ego they give no sector and no range.
    """
    ego, found = array("d"), dict[str, _Detections]()
    first_ns: int | None = None
    for message in messages:
        first_ns = message.receipt_ns if first_ns is None else first_ns
        if isinstance(message, EgoState):
            ego.extend(((message.stamp_ns - first_ns) / NS_PER_S, message.x_m, message.y_m, message.yaw_rad))
        elif isinstance(message, DetectionList):
            found.setdefault(message.sensor, _Detections()).add(message, first_ns)
    path = np.array(ego).reshape(-1, 4)
    path = path[np.isfinite(path).all(axis=1)]
    path = path[np.argsort(path[:, 0], kind="stable")]
    path[:, 3] = np.unwrap(path[:, 3])
    seen = {name: one.coverage(path, (mounts or {}).get(name)) for name, one in sorted(found.items())}
    measured = {name: one.persistence for name, one in seen.items() if one.persistence is not None}
    lists = {
        name: Lists(stamps_s, points_m) for name in measured for stamps_s, (points_m,) in [found[name].lists(path)]
    }
    for name, own in lists.items():
        pairs = [(measured[other], lists[other], own) for other in lists if other != name]
        apart_m = [m for each in pairs if (m := disagreement_m(*each)) is not None]
        seen[name] = replace(seen[name], disagreement_m=min(apart_m, default=None))
    return seen


@dataclass
class _Detections:
    """The detections of one sensor."""

    measured: set[str] = field(default_factory=set)
    num_detections: int = 0
    boxes: bool = False
    receipts_s: "array[float]" = field(default_factory=lambda: array("d"))
    """Receipt of every list, in s."""
    stamps_s: "array[float]" = field(default_factory=lambda: array("d"))
    """Stamp of every list, in s."""
    rows: "array[float]" = field(default_factory=lambda: array("d"))
    """Rows of detections with a bearing: number of its list, stamp, x, y (of a bearing alone those of a unit vector),
    whether it has a range, score (NaN without one)."""
    frames: set[str] = field(default_factory=set)

    def add(self, message: DetectionList, first_ns: int) -> None:
        """Take the detections of a list; stamps are seconds since `first_ns`."""
        number, stamp_s = len(self.receipts_s), (message.stamp_ns - first_ns) / NS_PER_S
        self.receipts_s.append((message.receipt_ns - first_ns) / NS_PER_S)
        self.stamps_s.append(stamp_s)
        self.num_detections += len(message.objects)
        if message.objects:
            self.frames.add(message.frame)
        for detection in message.objects:
            self.measured.update(detection.measured)
            self.boxes |= detection.length_m is not None and detection.width_m is not None
            x_m, y_m, has_range = _position(detection)
            if math.isfinite(x_m) and math.isfinite(y_m):
                score = math.nan if detection.score is None else detection.score
                self.rows.extend((number, stamp_s, x_m, y_m, has_range, score))

    def coverage(self, path: FloatArray, mount: Mount | None) -> Coverage:
        """Return the coverage, with the ego's `path`: times, x, y and yaw, shape (n, 4)."""
        receipts_s = np.array(self.receipts_s)
        span_s = float(np.ptp(receipts_s))
        rate_hz = (len(receipts_s) - 1) / span_s if span_s > 0.0 else None
        gaps_s = np.diff(np.sort(self.stamps_s))
        silence_s = float(gaps_s[gaps_s <= _OUTAGE_S].max(initial=0.0))
        measured, count = frozenset(self.measured), len(receipts_s)
        found = Coverage(measured, count, self.num_detections, rate_hz, boxes=self.boxes, silence_s=silence_s)
        rows = np.array(self.rows).reshape(-1, 6)
        has_range = rows[:, 4] > 0.0
        rows = rows[has_range] if has_range.any() else rows
        if len(self.frames) != 1 or len(rows) < _FEWEST or ("map" in self.frames and not len(path)):
            return found
        numbers, offsets_m = rows[:, 0].astype(np.int64), self._offsets_m(rows, path, mount)
        if has_range.any():
            extent_m = np.quantile(offsets_m, 1.0 - _OUTSIDE, axis=0) - np.quantile(offsets_m, _OUTSIDE, axis=0)
            reach_m = float(np.quantile(np.hypot(*offsets_m.T), 1.0 - _OUTSIDE))
            area_m2 = max(float(np.prod(extent_m)), 0.5 * _NARROWEST_RAD * reach_m**2)  # one object may keep its place
            stamps_s, columns = self.lists(path, rows[:, 5], np.hypot(*offsets_m.T))
            found = replace(found, persistence=persistence(stamps_s, *columns), area_m2=area_m2)
        period_s = float(np.median(np.diff(receipts_s))) if len(receipts_s) > 1 else 0.0
        span_s = max(_CELL_S, _CELL_PERIODS * period_s)
        reach = _CELL_M + _CELL_MPS * span_s if has_range.any() else _CELL_BEARING
        back = _comes_back(np.column_stack([offsets_m / reach, receipts_s[numbers] / span_s]), numbers)
        offsets_m = offsets_m[back]
        if len(offsets_m) < _FEWEST:
            return found
        sector = _sector(np.arctan2(offsets_m[:, 1], offsets_m[:, 0]), "sensor" in self.frames or mount is not None)
        range_m = float(np.quantile(np.hypot(*offsets_m.T), 1.0 - _OUTSIDE)) if has_range.any() else None
        axis_rad, full_rad = sector or (0.0, None)
        limit_m = None if range_m is None else float(round(_RANGE_FACTOR * range_m))
        return replace(found, axis_rad=axis_rad, field_of_view_rad=full_rad, range_m=limit_m)

    def lists(self, path: FloatArray, *columns: FloatArray) -> tuple[FloatArray, list[list[FloatArray]]]:
        """Stamps of the lists, rising, and of each list its positions and its part of `columns`.

        Positions are in the map where the ego's `path` is known. Detections without a range are left out.
        """
        rows = np.array(self.rows).reshape(-1, 6)
        rows = rows[rows[:, 4] > 0.0]
        points_m = rows[:, 2:4]
        if "map" not in self.frames and len(path):
            x_m, y_m, yaw_rad = (np.interp(rows[:, 1], path[:, 0], column) for column in path[:, 1:].T)
            points_m = _turned(points_m, yaw_rad) + np.column_stack([x_m, y_m])
        stamps_s = np.array(self.stamps_s)
        begins = np.searchsorted(rows[:, 0], np.arange(len(stamps_s) + 1))  # rows stand list by list
        parts = [slice(begins[k], begins[k + 1]) for k in np.argsort(stamps_s, kind="stable")]
        return np.sort(stamps_s), [[column[one] for one in parts] for column in (points_m, *columns)]

    def _offsets_m(self, rows: FloatArray, path: FloatArray, mount: Mount | None) -> FloatArray:
        """Positions seen from the sensor or, where its mount is not known, from the ego, shape (n, 2)."""
        points_m, ranged = rows[:, 2:4], bool(rows[0, 4])
        if "map" in self.frames and ranged:
            x_m, y_m, yaw_rad = (np.interp(rows[:, 1], path[:, 0], column) for column in path[:, 1:].T)
            points_m = _turned(points_m - np.column_stack([x_m, y_m]), -yaw_rad)
        if mount is None or "sensor" in self.frames:
            return points_m
        if ranged:
            points_m = points_m - np.array([mount.x_m, mount.y_m])
        return _turned(points_m, np.full(len(points_m), -mount.yaw_rad))


def _position(detection: Detection) -> tuple[float, float, float]:
    """x, y and 1 of a position; cosine, sine and 0 of a bearing alone; NaN of neither."""
    if detection.x_m is not None and detection.y_m is not None:
        return detection.x_m, detection.y_m, 1.0
    if detection.bearing_rad is None:
        return math.nan, math.nan, 0.0
    length = 1.0 if detection.range_m is None else detection.range_m
    cosine, sine = math.cos(detection.bearing_rad), math.sin(detection.bearing_rad)
    return length * cosine, length * sine, float(detection.range_m is not None)


def _turned(vectors_m: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Vectors, shape (n, 2), each turned by its angle, shape (n,)."""
    cosine, sine = np.cos(angles_rad), np.sin(angles_rad)
    x_m, y_m = vectors_m.T
    return np.column_stack([cosine * x_m - sine * y_m, sine * x_m + cosine * y_m])


def _comes_back(points: FloatArray, numbers: IntArray) -> BoolArray:
    """Which of `points`, shape (n, 3), share a unit cell with one of another list, of `numbers` (n,), shape (n,).

    Two grids, half a cell apart: what crosses a border of one is inside a cell of the other.
    """
    found = np.zeros(len(points), dtype=bool)
    for shift in (0.0, 0.5):
        cells = np.unique(np.floor(points + shift), axis=0, return_inverse=True)[1].ravel()
        of_lists = np.unique(np.column_stack([cells, numbers]), axis=0)[:, 0]
        found |= np.bincount(of_lists)[cells] > 1
    return found


def _sector(bearings_rad: FloatArray, axis_known: bool) -> tuple[float, float] | None:
    """Axis and full angle of the sector of these bearings; None where it is too wide for one."""
    rising = np.sort(wrap_angles(bearings_rad))
    skip = 1 + int(_OUTSIDE * len(rising))
    ends = np.append(rising, rising[:skip] + math.tau)
    gaps_rad = ends[skip:] - ends[:-skip]
    widest = int(np.argmax(gaps_rad))
    if gaps_rad[widest] < math.tau - _WIDEST_RAD:
        return None
    blind_rad = ends[widest : widest + skip + 1]  # its edges, and the detections in it
    apart = np.flatnonzero(np.diff(blind_rad) > min(_LINK_RAD, float(gaps_rad[widest]) / (3.0 * skip)))
    left_rad, right_rad = float(blind_rad[apart[0]]), float(blind_rad[apart[-1] + 1])
    half_rad = 0.5 * (math.tau - (right_rad - left_rad))
    middle_rad = wrap_angle(right_rad + half_rad)
    nearest_rad = 0.0 if axis_known else _AXES_RAD * round(middle_rad / _AXES_RAD)
    off_rad = abs(wrap_angle(middle_rad - nearest_rad))
    if axis_known or off_rad <= _AXIS_TOLERANCE_RAD:
        middle_rad, half_rad = wrap_angle(nearest_rad), half_rad + off_rad
    full_rad = max(math.ceil(200.0 * half_rad) / 100.0, _NARROWEST_RAD)
    return None if full_rad >= math.tau else (round(middle_rad, 2), full_rad)
