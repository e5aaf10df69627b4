"""Estimates the coverage of a sensor from a recording: field of view, range, rate and kind of its lists."""

import math
from array import array
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
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
from fgtrack.meaning.persistence import (
    Lists,
    Persistence,
    disagreement_m,
    persistence,
)
from fgtrack.meaning.scattered_noise import Scatter
from fgtrack.meaning.single_reports import NO_ID, SingleReports, single_reports
from fgtrack.models.sensors import Mount

__all__ = ["Coverage", "coverages"]

#: Share of detections that may lie outside of the estimated view.
_OUTSIDE = 0.01
#: Fewest detections for an estimate.
_FEWEST = 100
#: Cells of space and time in which a detection must recur: least duration, and duration in periods of the sensor.
_CELL_S = 0.25
_CELL_PERIODS = 5.0
#: Width of the cells for positions, [m] and [m/s] times the duration, and for bearings (on the unit circle).
_CELL_M = 3.0
_CELL_MPS = 30.0
_CELL_BEARING = 0.3
#: Largest gap between successive bearings up to the edge of a sector.
_LINK_RAD = 0.2
#: Positions farther from their median than this multiple of the quantile are strays, which have no influence on areas.
_STRAY_FACTOR = 5.0
_STRAY_QUANTILE = 0.8
#: Fewest different coordinates of a grid, and its coarsest step.
_FEWEST_COORDINATES = 5
_COARSEST_M = 20.0
#: Margin of the range.
_RANGE_FACTOR = 1.1
#: Narrowest sector of vehicle sensors: 20 degrees, long-range RADAR.
_NARROWEST_RAD = 0.35
#: Widest sector that is estimated; wider gaps in the bearings may come from the traffic.
_WIDEST_RAD = 2.8
#: Axes of sectors are multiples of this angle, if the middle of the sector is within the tolerance.
_AXES_RAD = math.pi / 4.0
_AXIS_TOLERANCE_RAD = 0.15
#: Share of lists with one object from which a sensor reports objects one by one.
_REPORTS_SHARE = 0.75
#: Fewest lists for the judgement whether a sensor scans.
_FEWEST_LISTS = 10
#: Highest speed of an object: an airliner.
_FASTEST_MPS = 300.0
#: Largest error of a position.
_POSITION_M = 10.0
#: Memory of earlier detections for revisits.
_MEMORY_S = 60.0
#: Most revisits that are used, and fewest for an estimate.
_MOST_REVISITS = 5000
_FEWEST_REVISITS = 20
#: Silence of a sensor after which objects count as new.
_OUTAGE_S = 2.0
_DELAY_QUANTILE = 0.98
#: Columns of `_Detections.rows`.
_NUM_COLUMNS = 7


@dataclass(frozen=True)
class Coverage:
    """Coverage and lists of a sensor; the defaults describe a sensor without messages."""

    measured: frozenset[str] = frozenset()
    """Components that the detections contain, without `uninformative` ones."""
    uninformative: Mapping[str, str] = field(default_factory=dict)
    """Measured components that are no measurements, with the reason."""
    num_lists: int = 0
    num_detections: int = 0
    boxes: bool = False
    """True if the detections have a length and a width."""
    rate_hz: float | None = None
    """Lists per second; None for fewer than two lists."""
    silence_s: float = 0.0
    """Longest time between two successive lists, up to `_OUTAGE_S`; after longer times objects count as new."""
    delay_s: float = 0.0
    """Time from stamp to receipt that 98 % of the lists stay below."""
    scans: bool = True
    """False if the sensor reports objects one by one, as ADS-B, AIS and V2X do.

    Then most lists contain one object, a few contain several by coincidence, and none
    is empty.
    """
    density_per_m2: float = math.inf
    """Mean number of detections in a list per area of the rectangle around all detections; infinite if unknown."""
    revisit_s: float | None = None
    """Median time between two detections of an object; None without positions, or with too few detections."""
    persistence: Persistence | None = None
    """Persistence of the detections from list to list; None if too few recur."""
    reports: SingleReports | None = None
    """Objects of a sensor that reports them one by one; None for a sensor that scans, or with too few reports."""
    scatter: Mapping[str, Scatter] = field(default_factory=dict)
    """Noise of the components by the scatter of the detections of objects around straight lines."""
    speed_mps: float | None = None
    """Speed in the map that 95 % of the tracklets stay below; None with few tracklets."""
    disagreement_m: float | None = None
    """Smallest standard deviation between positions of this and another sensor; None without common objects."""
    unexplained_m: float = 0.0
    """Part of `disagreement_m` that the independent errors of both sensors do not explain."""
    area_m2: float | None = None
    """Area in which the detections with a range lie, at least the area of the narrowest sector with this range."""
    axis_rad: float = 0.0
    """Direction of the middle of the sector, 0 along the x axis of the detections' frame."""
    field_of_view_rad: float | None = None
    """Full angle of the sector; None if the sensor detects all around, or if there are too few detections."""
    range_m: float | None = None
    """Range up to which the sensor detects; None if it measures no range, or if there are too few detections."""

    @property
    def object_hz(self) -> float | None:
        """Measurements of an object per second: by its own reports, or by the lists; None if unknown."""
        return self.rate_hz if self.reports is None else 1.0 / self.reports.period_s


def coverages(
    messages: Iterable[Message], mounts: Mapping[str, Mount] | None = None
) -> dict[str, Coverage]:
    """Estimate the coverage of each sensor in `messages`, by name; `mounts` contains the known mounts.

    - Only recurring detections count: another list of the sensor has a detection close by and soon. This is usual for
      an object and rare for clutter. With fewer than 100 recurring detections nothing is estimated.
    - The sector is the complement of the widest arc that contains at most 1 % of the recurring detections. The widest
      sector is 160 degrees, because a single overtaking car covers nearly half a circle, whatever the field of view.
    - Cars cross the edge of the sector within a few lists. So the sector is extended into this arc while successive
      detections are closer than 12 degrees, and closer than a third of their distance if clutter were spread evenly.
    - The range is the 99 % quantile plus a tenth. Detections in the map give neither sector nor range without an ego.
    """
    ego = array("d")
    received = defaultdict[str, _Detections](_Detections)
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
    for name, one in measured.items():
        pairs = [
            (distance_m, max(distance_m**2 - one.std_m**2 - item.std_m**2, 0.0))
            for other, item in measured.items()
            if other != name
            and (distance_m := disagreement_m(item, one.lists)) is not None
        ]
        if pairs:
            smallest_m, unexplained_m2 = min(pairs)
            result[name] = replace(
                result[name],
                disagreement_m=smallest_m,
                unexplained_m=math.sqrt(unexplained_m2),
            )
    return result


class _Detections:
    """The detections of one sensor, in order of receipt."""

    def __init__(self) -> None:
        self.measured = set[str]()
        self.frames = set[str]()
        self.boxes = False
        self.lists = array("q")
        """Stamp, receipt and number of detections of each list."""
        self.rows = array("d")
        """Index of the list, x, y, 1 if there is a range else 0, score, yaw and speed of each detection.

        Missing numbers are NaN. A detection with only a bearing has the x and y of a unit vector; a detection without a
        bearing is left out.
        """
        self.ids = array("q")
        """Number of the identity of each row, or `NO_ID`."""
        self.names: dict[str, int] = {}
        """Numbers of the identities."""

    def add(self, message: DetectionList) -> None:
        """Add the detections of `message`."""
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
                described = detection.score, detection.yaw_rad, detection.speed_mps
                numbers = (math.nan if one is None else one for one in described)
                self.rows.extend((index, x_m, y_m, has_range, *numbers))
                name = detection.id
                self.ids.append(
                    NO_ID
                    if name is None
                    else self.names.setdefault(name, len(self.names))
                )

    def coverage(
        self, first_ns: int, path: FloatArray, mount: Mount | None
    ) -> Coverage:
        """Estimate the coverage; `path` contains seconds since `first_ns`, x, y and yaw of the ego, shape (n, 4)."""
        stamps_ns, receipts_ns, counts = np.array(self.lists).reshape(-1, 3).T
        stamps_s = (stamps_ns - first_ns) / NS_PER_S
        receipts_s = (receipts_ns - first_ns) / NS_PER_S
        rows = np.array(self.rows).reshape(-1, _NUM_COLUMNS)
        ranged = rows[rows[:, 3] > 0.0]
        # The rows are sorted by list.
        begins = np.searchsorted(ranged[:, 0], np.arange(len(counts) + 1))
        parts = [slice(*ends) for ends in pairwise(begins)]
        num_lists = len(counts)
        gaps_s = np.diff(np.sort(stamps_s))
        span_s = float(np.ptp(receipts_s))
        inside = _without_strays(ranged[:, 1:3])
        sides_m = np.ptp(ranged[inside, 1:3], axis=0) if len(ranged) else np.zeros(2)
        has_enough_lists = num_lists >= _FEWEST_LISTS
        has_area = bool(sides_m.all())
        singles = np.count_nonzero(counts == 1)
        result = Coverage(
            frozenset(self.measured),
            num_lists=num_lists,
            num_detections=int(counts.sum()),
            boxes=self.boxes,
            rate_hz=(num_lists - 1) / span_s if span_s > 0.0 else None,
            silence_s=float(gaps_s[gaps_s <= _OUTAGE_S].max(initial=0.0)),
            delay_s=float(np.quantile(receipts_s - stamps_s, _DELAY_QUANTILE)),
            scans=not has_enough_lists
            or not counts.all()
            or bool(singles < _REPORTS_SHARE * num_lists),
            density_per_m2=float(counts.sum() / num_lists / np.prod(sides_m))
            if has_enough_lists and has_area
            else math.inf,
            revisit_s=_revisit_s(
                stamps_ns.tolist(), [ranged[part, 1:3] for part in parts]
            ),
        )
        if not result.scans and self.frames == {"map"}:
            result = self._with_reports(result, stamps_s, rows)
        rows = ranged if len(ranged) else rows
        in_map = "map" in self.frames
        if len(self.frames) != 1 or len(rows) < _FEWEST or (in_map and not len(path)):
            return result
        numbers = rows[:, 0].astype(np.int64)
        seen_m = rows[:, 1:3]
        map_m = seen_m
        if len(path):
            x_m, y_m, yaw_rad = (
                np.interp(stamps_s[numbers], path[:, 0], column)
                for column in path[:, 1:].T
            )
            if not in_map:
                body_m = seen_m
                if mount is not None and "sensor" in self.frames:
                    arm_m = np.array([mount.x_m, mount.y_m])
                    turn_rad = np.full(len(seen_m), mount.yaw_rad)
                    body_m = _rotated(seen_m, turn_rad) + arm_m
                map_m = _rotated(body_m, yaw_rad) + np.column_stack([x_m, y_m])
            elif len(ranged):
                seen_m = _rotated(seen_m - np.column_stack([x_m, y_m]), -yaw_rad)
        if mount is not None and "sensor" not in self.frames:
            seen_m = (
                seen_m - np.array([mount.x_m, mount.y_m]) if len(ranged) else seen_m
            )
            seen_m = _rotated(seen_m, np.full(len(seen_m), -mount.yaw_rad))
        if len(ranged):
            inside_m = seen_m[_without_strays(seen_m)]
            extent_m = np.quantile(inside_m, 1.0 - _OUTSIDE, axis=0) - np.quantile(
                inside_m, _OUTSIDE, axis=0
            )
            ranges_m = np.hypot(*seen_m.T)
            reach_m = float(np.quantile(np.hypot(*inside_m.T), 1.0 - _OUTSIDE))
            # An object at rest would give an extent of 0.
            area_m2 = max(float(np.prod(extent_m)), 0.5 * _NARROWEST_RAD * reach_m**2)
            order = np.argsort(stamps_s, kind="stable")
            columns = (
                [column[parts[k]] for k in order]
                for column in (map_m, rows[:, 4], ranges_m)
            )
            result = replace(
                result,
                persistence=persistence(
                    Lists(stamps_s[order], *columns), _grid_std_m(rows[:, 1:3])
                ),
                area_m2=area_m2,
            )
        period_s = float(np.median(np.diff(receipts_s))) if num_lists > 1 else 0.0
        cell_s = max(_CELL_S, _CELL_PERIODS * period_s)
        cell = _CELL_M + _CELL_MPS * cell_s if len(ranged) else _CELL_BEARING
        seen_m = seen_m[
            _recurring(
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

    def _with_reports(
        self, result: Coverage, stamps_s: FloatArray, rows: FloatArray
    ) -> Coverage:
        """Return `result` with the objects of single reports in the map; their sensor is at its origin."""
        is_ranged = rows[:, 3] > 0.0
        at_m = rows[is_ranged, 1:3]
        reports = single_reports(
            stamps_s[rows[is_ranged, 0].astype(np.int64)],
            at_m,
            at_m,
            np.array(self.ids, dtype=np.int64)[is_ranged],
            rows[is_ranged, 5:7],
            result.revisit_s,
        )
        if reports is None:
            return result
        return replace(result, reports=reports, revisit_s=reports.period_s)


def _revisit_s(
    stamps_ns: Sequence[int], points_m: Sequence[FloatArray]
) -> float | None:
    """Return the median time since the last list with a detection that could be the same object; None for too few
    revisits.

    The lists are in order of receipt.
    """
    lists = [
        (stamp_ns, points)
        for stamp_ns, points in zip(stamps_ns, points_m, strict=True)
        if len(points)
    ]
    result = list[float]()
    first = 0
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
    """Return x, y and 1 for a position; cosine, sine and 0 for a bearing without a range; NaN if there is neither."""
    if detection.x_m is not None and detection.y_m is not None:
        return detection.x_m, detection.y_m, 1.0
    if detection.bearing_rad is None:
        return math.nan, math.nan, 0.0
    length = 1.0 if detection.range_m is None else detection.range_m
    cosine = math.cos(detection.bearing_rad)
    sine = math.sin(detection.bearing_rad)
    return length * cosine, length * sine, float(detection.range_m is not None)


def _without_strays(points_m: FloatArray) -> BoolArray:
    """Return True for each of the positions (n, 2) that is not far from all others, shape (n,)."""
    if not len(points_m):
        return np.zeros(0, dtype=bool)
    distances_m = np.hypot(*(points_m - np.median(points_m, axis=0)).T)
    limit_m = _STRAY_FACTOR * np.quantile(distances_m, _STRAY_QUANTILE)
    return np.asarray((distances_m <= limit_m) | (limit_m == 0.0))


def _grid_std_m(points_m: FloatArray) -> float:
    """Return the standard deviation of the rounding to a grid, in x, y or range, of positions (n, 2); 0 without a
    grid.
    """
    steps_m = [0.0]
    for values in (*points_m.T, np.hypot(*points_m.T)):
        coordinates = np.unique(np.round(values, 6))
        gaps_m = np.diff(coordinates)
        gaps_m = gaps_m[gaps_m > 2e-6]
        if len(coordinates) < _FEWEST_COORDINATES or not len(gaps_m):
            continue
        step_m = float(gaps_m.min())
        off_m = np.abs(gaps_m - step_m * np.round(gaps_m / step_m))
        if step_m <= _COARSEST_M and float(off_m.max()) < 0.02 * step_m:
            steps_m.append(step_m)
    return max(steps_m) / math.sqrt(12.0)


def _rotated(vectors_m: FloatArray, angles_rad: FloatArray) -> FloatArray:
    """Return `vectors_m`, shape (n, 2), each rotated by its angle, shape (n,)."""
    cosine = np.cos(angles_rad)
    sine = np.sin(angles_rad)
    x_m, y_m = vectors_m.T
    return np.column_stack([cosine * x_m - sine * y_m, sine * x_m + cosine * y_m])


def _recurring(points: FloatArray, numbers: IntArray) -> BoolArray:
    """Return True for each detection that recurs, shape (n,): another list has a detection in the same cell of
    either grid.

    The two grids are shifted by half a cell. `points`, shape (n, 3), are in units of
    the cells, `numbers` are the indices of their lists.
    """
    result = np.zeros(len(points), dtype=bool)
    for shift in (0.0, 0.5):
        cells = np.unique(np.floor(points + shift), axis=0, return_inverse=True)[
            1
        ].ravel()
        of_lists = np.unique(np.column_stack([cells, numbers]), axis=0)[:, 0]
        result |= np.bincount(of_lists)[cells] > 1
    return result


def _sector(bearings_rad: FloatArray, axis_known: bool) -> tuple[float, float] | None:
    """Return axis and full angle of the sector that contains the bearings; None if it is too wide to be
    distinguished.
    """
    rising = np.sort(wrap_angles(bearings_rad))
    skip = 1 + int(_OUTSIDE * len(rising))
    ends = np.append(rising, rising[:skip] + math.tau)
    gaps_rad = ends[skip:] - ends[:-skip]
    widest = int(np.argmax(gaps_rad))
    if gaps_rad[widest] < math.tau - _WIDEST_RAD:
        return None
    # The edges of the widest arc, and the detections in it.
    blind_rad = ends[widest : widest + skip + 1]
    gaps = np.flatnonzero(
        np.diff(blind_rad) > min(_LINK_RAD, float(gaps_rad[widest]) / (3.0 * skip))
    )
    left_rad = float(blind_rad[gaps[0]])
    right_rad = float(blind_rad[gaps[-1] + 1])
    half_rad = 0.5 * (math.tau - (right_rad - left_rad))
    middle_rad = wrap_angle(right_rad + half_rad)
    nearest_rad = 0.0 if axis_known else _AXES_RAD * round(middle_rad / _AXES_RAD)
    off_rad = abs(wrap_angle(middle_rad - nearest_rad))
    if axis_known or off_rad <= _AXIS_TOLERANCE_RAD:
        middle_rad = wrap_angle(nearest_rad)
        half_rad += off_rad
    full_rad = max(math.ceil(200.0 * half_rad) / 100.0, _NARROWEST_RAD)
    return None if full_rad >= math.tau else (round(middle_rad, 2), full_rad)
