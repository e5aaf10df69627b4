"""Coverage of a sensor: its field of view, range and rate, and the kind of its lists, estimated from a recording."""

import math
from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median

import numpy as np

from fgtrack.core.geometry import wrap_angle, wrap_angles
from fgtrack.core.time import NS_PER_S, nanoseconds, seconds
from fgtrack.core.types import (
    BoolArray,
    Detection,
    DetectionList,
    EgoState,
    FloatArray,
    IntArray,
    Message,
)
from fgtrack.models.sensors import Mount
from fgtrack.pipeline.assumptions.persistence import (
    Lists,
    Persistence,
    disagreement_m,
    persistence,
)

__all__ = ["Coverage", "coverages"]

#: Share of detections that may lie outside of the estimated view, and the number of which it is one at least.
_OUTSIDE, _FEWEST = 0.01, 100
#: Cells in which a detection must come back: at least so long, so many periods of the sensor, and so wide.
_CELL_S, _CELL_PERIODS, _CELL_M, _CELL_MPS, _CELL_BEARING = 0.25, 5.0, 3.0, 30.0, 0.3
#: How near detections follow one another up to the edges of a sector, and the margin of a range.
_LINK_RAD, _RANGE_FACTOR = 0.2, 1.1
#: No sensor of vehicles has a narrower sector (20 degrees, long-range RADAR); wider ones look like traffic.
_NARROWEST_RAD, _WIDEST_RAD = 0.35, 2.8
#: Axes are multiples of 45 degrees, where the middle of the sector is so near to one.
_AXES_RAD, _AXIS_TOLERANCE_RAD = math.pi / 4.0, 0.15
#: Lists with one object, as a share of all, that show a sensor to report objects one by one; and the fewest lists.
_REPORTS_SHARE, _FEWEST_LISTS = 0.75, 10
#: No vehicle is faster than an airliner [m/s], and no position of one is worse than this [m].
_FASTEST_MPS, _POSITION_M = 300.0, 10.0
#: Memory of earlier detections, and the most and fewest revisits that count.
_MEMORY_S, _MOST_REVISITS, _FEWEST_REVISITS = 60.0, 5000, 20
_OUTAGE_S = 2.0


@dataclass(frozen=True)
class Coverage:
    """Lists of a sensor and where it detects; by default those of a sensor without messages."""

    measured: frozenset[str] = frozenset()
    """Components that its detections hold."""
    num_lists: int = 0
    num_detections: int = 0
    boxes: bool = False
    """True if its detections have a length and a width."""
    rate_hz: float | None = None
    """Lists per second; None of fewer than two."""
    silence_s: float = 0.0
    """Longest time between two successive lists, up to `_OUTAGE_S`: after longer ones objects are new."""
    scans: bool = True
    """False if it reports objects one by one, as ADS-B, AIS and V2X do: its lists hold one object, now and then several
    by coincidence, and none is empty."""
    density_per_m2: float = math.inf
    """All detections of a list over the rectangle that holds those of all; infinite if unknown."""
    revisit_s: float | None = None
    """Median time between two detections of an object; None without positions, or of too few."""
    persistence: Persistence | None = None
    """Persistence of its detections from list to list; None where too few do."""
    disagreement_m: float | None = None
    """Least standard deviation of its positions against those of another sensor; None where none sees the same."""
    area_m2: float | None = None
    """Area over which its detections with a range are spread, at least that of the narrowest sector up to there."""
    axis_rad: float = 0.0
    """Direction of the middle of its sector, 0 along the axis of the frame of its detections."""
    field_of_view_rad: float | None = None
    """Full angle of its sector; None where it detects all around, or too seldom to judge."""
    range_m: float | None = None
    """Up to where it detects; None where it measures no range, or too seldom."""


def coverages(
    messages: Iterable[Message], mounts: Mapping[str, Mount] | None = None
) -> dict[str, Coverage]:
    """Coverage of each sensor in `messages`, by name; `mounts` are the known ones.
    - Only a detection that comes back counts: another list of the sensor has one close by and soon, as of an object and
      seldom of clutter. With fewer than 100 of them nothing is estimated.
    - The sector is the rest of the circle beside the widest arc with at most 1 % of these, up to 160 degrees:
      one car that overtakes has a sensor which looks all around detect in nearly half a circle.
    - Cars pass its edges within a few lists. So it goes on as far as the detections in that arc follow one another
      within 12 degrees and a third of what they would if they were spread evenly over it, as clutter is.
    - The range is the quantile of 99 %, and a tenth more. Detections in the map give neither without an ego.
    """
    ego, received = array("d"), defaultdict[str, _Detections](_Detections)
    first_ns: int | None = None
    for message in messages:
        first_ns = message.receipt_ns if first_ns is None else first_ns
        if isinstance(message, EgoState):
            ego.extend(
                (
                    (message.stamp_ns - first_ns) / NS_PER_S,
                    message.x_m,
                    message.y_m,
                    message.yaw_rad,
                )
            )
        elif isinstance(message, DetectionList):
            received[message.sensor].add(message)
    path = np.array(ego).reshape(-1, 4)
    path = path[np.isfinite(path).all(axis=1)]
    path = path[np.argsort(path[:, 0], kind="stable")]
    path[:, 3] = np.unwrap(path[:, 3])
    result = {
        name: item.coverage(first_ns or 0, path, (mounts or {}).get(name))
        for name, item in sorted(received.items())
    }
    measured = {
        name: item.persistence
        for name, item in result.items()
        if item.persistence is not None
    }
    for name, own in measured.items():
        apart_m = [
            disagreement_m(item, own.lists)
            for other, item in measured.items()
            if other != name
        ]
        result[name] = replace(
            result[name], disagreement_m=min(filter(None, apart_m), default=None)
        )
    return result


class _Detections:
    """The detections of one sensor, in order of receipt."""

    def __init__(self) -> None:
        self.measured, self.frames, self.boxes = set[str](), set[str](), False
        self.lists = array("q")
        """Stamp, receipt and number of detections of each list."""
        self.rows = array("d")
        """Index of its list, x, y (of a bearing alone those of a unit vector), whether it has a range, and score (NaN
        without one) of each detection with a bearing."""

    def add(self, message: DetectionList) -> None:
        """Take the detections of a list."""
        index = len(self.lists) // 3
        self.lists.extend((message.stamp_ns, message.receipt_ns, len(message.objects)))
        if message.objects:
            self.frames.add(message.frame)
        for detection in message.objects:
            self.measured.update(detection.measured)
            self.boxes |= (
                detection.length_m is not None and detection.width_m is not None
            )
            x_m, y_m, has_range = _position(detection)
            if math.isfinite(x_m) and math.isfinite(y_m):
                score = math.nan if detection.score is None else detection.score
                self.rows.extend((index, x_m, y_m, has_range, score))

    def coverage(
        self, first_ns: int, path: FloatArray, mount: Mount | None
    ) -> Coverage:
        """Return the coverage, with the ego's `path`: seconds since `first_ns`, x, y and yaw, shape (n, 4)."""
        stamps_ns, receipts_ns, counts = np.array(self.lists).reshape(-1, 3).T
        stamps_s, receipts_s = (
            (stamps_ns - first_ns) / NS_PER_S,
            (receipts_ns - first_ns) / NS_PER_S,
        )
        rows = np.array(self.rows).reshape(-1, 5)
        ranged = rows[rows[:, 3] > 0.0]
        begins = np.searchsorted(
            ranged[:, 0], np.arange(len(counts) + 1)
        )  # rows stand list by list
        parts = [slice(*ends) for ends in pairwise(begins)]
        num_lists, gaps_s, span_s = (
            len(counts),
            np.diff(np.sort(stamps_s)),
            float(np.ptp(receipts_s)),
        )
        sides_m = np.ptp(ranged[:, 1:3], axis=0) if len(ranged) else np.zeros(2)
        enough, has_area = num_lists >= _FEWEST_LISTS, bool(sides_m.all())
        singles = np.count_nonzero(counts == 1)
        result = Coverage(
            frozenset(self.measured),
            num_lists,
            int(counts.sum()),
            self.boxes,
            rate_hz=(num_lists - 1) / span_s if span_s > 0.0 else None,
            silence_s=float(gaps_s[gaps_s <= _OUTAGE_S].max(initial=0.0)),
            scans=not enough
            or not counts.all()
            or bool(singles < _REPORTS_SHARE * num_lists),
            density_per_m2=float(counts.sum() / num_lists / np.prod(sides_m))
            if enough and has_area
            else math.inf,
            revisit_s=_revisit_s(
                stamps_ns.tolist(), [ranged[part, 1:3] for part in parts]
            ),
        )
        rows, in_map = ranged if len(ranged) else rows, "map" in self.frames
        if len(self.frames) != 1 or len(rows) < _FEWEST or (in_map and not len(path)):
            return result
        numbers, seen_m = rows[:, 0].astype(np.int64), rows[:, 1:3]
        placed_m = seen_m
        if len(path):
            x_m, y_m, yaw_rad = (
                np.interp(stamps_s[numbers], path[:, 0], column)
                for column in path[:, 1:].T
            )
            if not in_map:
                placed_m = _turned(seen_m, yaw_rad) + np.column_stack([x_m, y_m])
            elif len(ranged):
                seen_m = _turned(seen_m - np.column_stack([x_m, y_m]), -yaw_rad)
        if mount is not None and "sensor" not in self.frames:
            seen_m = (
                seen_m - np.array([mount.x_m, mount.y_m]) if len(ranged) else seen_m
            )
            seen_m = _turned(seen_m, np.full(len(seen_m), -mount.yaw_rad))
        if len(ranged):
            extent_m = np.quantile(seen_m, 1.0 - _OUTSIDE, axis=0) - np.quantile(
                seen_m, _OUTSIDE, axis=0
            )
            ranges_m = np.hypot(*seen_m.T)
            reach_m = float(np.quantile(ranges_m, 1.0 - _OUTSIDE))
            area_m2 = max(
                float(np.prod(extent_m)), 0.5 * _NARROWEST_RAD * reach_m**2
            )  # an object may stand
            order = np.argsort(stamps_s, kind="stable")
            columns = (
                [column[parts[k]] for k in order]
                for column in (placed_m, rows[:, 4], ranges_m)
            )
            result = replace(
                result,
                persistence=persistence(Lists(stamps_s[order], *columns)),
                area_m2=area_m2,
            )
        period_s = float(np.median(np.diff(receipts_s))) if num_lists > 1 else 0.0
        cell_s = max(_CELL_S, _CELL_PERIODS * period_s)
        cell = _CELL_M + _CELL_MPS * cell_s if len(ranged) else _CELL_BEARING
        seen_m = seen_m[
            _comes_back(
                np.column_stack([seen_m / cell, receipts_s[numbers] / cell_s]), numbers
            )
        ]
        if len(seen_m) < _FEWEST:
            return result
        sector = _sector(
            np.arctan2(seen_m[:, 1], seen_m[:, 0]),
            "sensor" in self.frames or mount is not None,
        )
        axis_rad, full_rad = sector or (0.0, None)
        range_m = _RANGE_FACTOR * float(
            np.quantile(np.hypot(*seen_m.T), 1.0 - _OUTSIDE)
        )
        limit_m = float(round(range_m)) if len(ranged) else None
        return replace(
            result, axis_rad=axis_rad, field_of_view_rad=full_rad, range_m=limit_m
        )


def _revisit_s(
    stamps_ns: Sequence[int], points_m: Sequence[FloatArray]
) -> float | None:
    """Median time since the last list with a detection that could be the same object, in lists in order of receipt."""
    lists = [
        (stamp_ns, points)
        for stamp_ns, points in zip(stamps_ns, points_m, strict=True)
        if len(points)
    ]
    result, first = list[float](), 0
    for k, (stamp_ns, points) in enumerate(lists):
        if len(result) >= _MOST_REVISITS:
            break
        while lists[first][0] < stamp_ns - nanoseconds(_MEMORY_S):
            first += 1
        for point_m in points:
            for earlier_ns, earlier_m in reversed(lists[first:k]):
                elapsed_s = seconds(stamp_ns - earlier_ns)
                reach_m = _FASTEST_MPS * elapsed_s + _POSITION_M
                if (
                    elapsed_s > 0.0
                    and (np.abs(earlier_m - point_m).max(axis=1) <= reach_m).any()
                ):
                    result.append(elapsed_s)
                    break
    return median(result) if len(result) >= _FEWEST_REVISITS else None


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
    """True for `points`, shape (n, 3), in a cell of one of two shifted grids with one of another list of `numbers`."""
    result = np.zeros(len(points), dtype=bool)
    for shift in (0.0, 0.5):
        cells = np.unique(np.floor(points + shift), axis=0, return_inverse=True)[
            1
        ].ravel()
        of_lists = np.unique(np.column_stack([cells, numbers]), axis=0)[:, 0]
        result |= np.bincount(of_lists)[cells] > 1
    return result


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
    apart = np.flatnonzero(
        np.diff(blind_rad) > min(_LINK_RAD, float(gaps_rad[widest]) / (3.0 * skip))
    )
    left_rad, right_rad = float(blind_rad[apart[0]]), float(blind_rad[apart[-1] + 1])
    half_rad = 0.5 * (math.tau - (right_rad - left_rad))
    middle_rad = wrap_angle(right_rad + half_rad)
    nearest_rad = 0.0 if axis_known else _AXES_RAD * round(middle_rad / _AXES_RAD)
    off_rad = abs(wrap_angle(middle_rad - nearest_rad))
    if axis_known or off_rad <= _AXIS_TOLERANCE_RAD:
        middle_rad, half_rad = wrap_angle(nearest_rad), half_rad + off_rad
    full_rad = max(math.ceil(200.0 * half_rad) / 100.0, _NARROWEST_RAD)
    return None if full_rad >= math.tau else (round(middle_rad, 2), full_rad)
