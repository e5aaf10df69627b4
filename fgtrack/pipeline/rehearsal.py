"""A rehearsal of a tracker: a made-up scene in which everything happens that a tick may have to compute.

Compiled loops, SciPy and gtsam are imported at their first use, which takes up to seconds. A rehearsal is this first
use, so that it does not come in the middle of a drive.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from typing import NamedTuple

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.geometry import body_point, wrap_angle
from fgtrack.core.linalg import inverse_root
from fgtrack.core.time import NS_PER_S, nanoseconds, period_ns, seconds
from fgtrack.core.types import FRAMES, Detection, DetectionList, EgoState, Frame
from fgtrack.models.sensors import SensorModel
from fgtrack.models.track_map import TrackMap
from fgtrack.pipeline.build import build_road, build_tracker
from fgtrack.pipeline.clock import clock_ticks

_LOG = logging.getLogger(__name__)
_START_NS = 1_000 * NS_PER_S
_SPEED_MPS = 10.0
_TICK_NS = 20_000_000
#: Time between two lists of a sensor, if the node ticks faster than this.
_SCAN_NS = 50_000_000
#: Lists of each sensor before and after the window of the estimator has filled.
_NUM_LISTS, _NUM_AFTER = 16, 6
#: First list with objects; this list is late. The objects of every third row are at first detected by one sensor.
_BIRTH, _NUM_FIRST = 2, 3
#: Most lists while the window fills.
_MOST_LISTS = 16
#: Distances of the objects ahead of the ego; the near ones are between two tracks for a detection, or merged.
_AHEAD_M = (8.0, 10.5, 18.0, 26.0, 27.5, 40.0)
#: Modules that a tick needs only in a rare case, for example the assignment of many objects side by side.
_RARE_MODULES = ("scipy.sparse", "scipy.sparse.csgraph", "scipy.special")
_rehearsed = set[int]()


def rehearse(config: Config) -> None:
    """Run the scene through a tracker of `config`; once in a process for equal configurations."""
    digest = hash(repr(config))
    if digest in _rehearsed:
        return
    _LOG.info("loading and compiling what a tick needs")
    inverse_root(np.eye(1))  # LAPACK, which some estimators need in rare ticks only
    for name in _RARE_MODULES:
        import_module(name)
    tracker = build_tracker(config)
    for tick in clock_ticks(_messages(config), config.clock.node_hz):
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        len(report.tracks), len(report.updates)
        tracker.tracks_at(tick.now_ns - 5 * _TICK_NS)
        tracker.tracks_at(tick.now_ns + _TICK_NS)
    tracker.finish()
    _rehearsed.add(digest)
    _LOG.info("ready: every tick finds loaded what it needs")


def _messages(config: Config) -> list[EgoState | DetectionList]:
    """Return the messages of the scene in order of receipt."""
    scene = _Scene(_start(config), config.ego.detection_origin_m)
    hz = config.clock.node_hz
    scan_ns = max(_SCAN_NS, 0 if hz is None else period_ns(hz))
    messages: list[EgoState | DetectionList] = []
    for k, at_ns in enumerate(_scans_ns(config, scan_ns)):
        messages.append(scene.ego(k, at_ns))
        for row, (name, sensor) in enumerate(config.used_sensors.items()):
            first = row % _NUM_FIRST
            messages.append(
                scene.detections(k, at_ns + row * 1000, first, name, sensor)
            )
    return sorted(messages, key=lambda message: message.receipt_ns)


def _scans_ns(config: Config, scan_ns: int) -> Iterator[int]:
    """Yield the times of the scans: some close together, some while the window fills, some after it has filled."""
    reach_ns = nanoseconds(1.2 * config.effective.reach_s)
    now_ns = _START_NS
    rest_ns = max(reach_ns - (_NUM_LISTS + _NUM_AFTER) * scan_ns, 0)
    for num_lists, step_ns in (
        (_NUM_LISTS, scan_ns),
        (
            min(_MOST_LISTS, -(-rest_ns // scan_ns)),
            max(rest_ns // _MOST_LISTS, scan_ns),
        ),
        (_NUM_AFTER, scan_ns),
    ):
        for _ in range(num_lists):
            yield now_ns
            now_ns += step_ns


class _Pose(NamedTuple):
    """Position and direction in the map."""

    x_m: float
    y_m: float
    yaw_rad: float

    def moved(
        self, ahead_m: float, left_m: float = 0.0, turned_rad: float = 0.0
    ) -> "_Pose":
        """Return a pose that is given relative to this pose."""
        at = body_point(self.x_m, self.y_m, self.yaw_rad, 0.0, 0.0, ahead_m, left_m)
        return _Pose(at[0], at[1], wrap_angle(self.yaw_rad + turned_rad))

    def seen(self, pose: "_Pose") -> "_Pose":
        """Return `pose` relative to this pose: distances ahead and to the left, and the difference of the yaws."""
        x_m, y_m = pose.x_m - self.x_m, pose.y_m - self.y_m
        ahead_m, left_m, _, _ = body_point(0.0, 0.0, -self.yaw_rad, 0.0, 0.0, x_m, y_m)
        return _Pose(ahead_m, left_m, wrap_angle(pose.yaw_rad - self.yaw_rad))


def _start(config: Config) -> _Pose:
    """Return the pose of the ego at the beginning: on the map, if there is a map."""
    track = build_road(config.map).track
    if not isinstance(track, TrackMap):
        return _Pose(0.0, 0.0, 0.3)
    arcs_m = np.array([0.3, 0.31]) * track.length_m
    (x_m, y_m), ahead = track.position(arcs_m, np.zeros(2)).tolist()
    return _Pose(x_m, y_m, math.atan2(ahead[1] - y_m, ahead[0] - x_m))


@dataclass(frozen=True)
class _Scene:
    """An ego and objects that drive straight on."""

    start: _Pose
    origin_m: tuple[float, float]
    """Origin of the detection frame, seen from the reference point of the ego."""

    def _ego(self, at_ns: int) -> _Pose:
        return self.start.moved(_SPEED_MPS * seconds(at_ns - _START_NS))

    def ego(self, k: int, at_ns: int) -> EgoState:
        """Return the ego state of a scan; some are late, some have a covariance, and one has jumped."""
        pose = self._ego(at_ns).moved(3.0 if k == _NUM_LISTS - 4 else 0.0)
        covariance = tuple((0.01 * np.eye(5)).ravel().tolist()) if k % 2 else None
        receipt_ns = at_ns + (3 * _TICK_NS if k % 5 == 3 else 0)
        return EgoState(at_ns, receipt_ns, *pose, _SPEED_MPS, covariance=covariance)

    def detections(
        self, k: int, at_ns: int, first: int, name: str, sensor: SensorModel
    ) -> DetectionList:
        """Return the list `k` of a sensor, which is the first one to detect the objects of the row `first` on.

        Every fourth list comes after the next four lists. A late list may show objects for the first time. One list is
        too old.
        """
        late_ns = nanoseconds(min(0.2, sensor.max_delay_s or 0.2)) if k % 4 == 2 else 0
        if k == _NUM_LISTS - 2:
            late_ns = 20 * _SCAN_NS
        return DetectionList(
            name,
            at_ns,
            at_ns + late_ns,
            self._objects(k, at_ns, first, sensor),
            _frame(k),
        )

    def _objects(
        self, k: int, at_ns: int, first: int, sensor: SensorModel
    ) -> list[Detection]:
        """Return the detections of a list. Some objects are missed; all are hidden in some lists."""
        if k < _BIRTH or k % 11 == 0:
            return []
        others = k >= _BIRTH + 6
        rows = [
            (row, ahead_m)
            for row, ahead_m in enumerate(_AHEAD_M)
            if (row % _NUM_FIRST == first or others) and (k + row) % 7
        ]
        if k % 3 == 1:  # an object in two parts, and an outlier
            rows += [(0, _AHEAD_M[0] + 1.0), (2, _AHEAD_M[2] + 2.0)]
        return [self._detection(k, at_ns, *each, sensor) for each in rows]

    def _detection(
        self, k: int, at_ns: int, row: int, ahead_m: float, sensor: SensorModel
    ) -> Detection:
        """Return a detection with the components of a sensor; some have other fields, too."""
        left_m = 0.05 * ((k * 7 + row * 3) % 5 - 2)
        is_flipped = (k + row) % 6 == 5
        car = self._ego(at_ns).moved(ahead_m, left_m, math.pi if is_flipped else 0.0)
        values = self._measured(at_ns, car, _frame(k), sensor)
        variances = [sensor.std[name] ** 2 for name in sensor.components]
        has_own, describes, rule = k % 3 == 2, k % 2 == 1, sensor.score
        return Detection(
            **{name: values[name] for name in sensor.components},  # type: ignore[arg-type]  # names of values
            covariance=tuple(np.diag(variances).ravel().tolist()) if has_own else None,
            stamp_ns=at_ns - row * 1_000_000 if k % 5 == 4 else None,
            score=0.9 if rule is None else rule.even + 5.0 * rule.scale,
            class_name="car" if describes else None,
            length_m=4.5 if describes else None,
            width_m=1.8 if describes else None,
            id=f"object {row}" if describes and row % 2 else None,
        )

    def _measured(
        self, at_ns: int, car: _Pose, frame: Frame, sensor: SensorModel
    ) -> dict[str, float]:
        """Return all values of an object that a sensor can measure; positions are in `frame`."""
        mount = sensor.mount_or_origin
        origin = self._ego(at_ns).moved(*self.origin_m)
        own = origin.moved(mount.x_m, mount.y_m, mount.yaw_rad)
        axes = {"map": _Pose(0.0, 0.0, 0.0), "ego": origin, "sensor": own}[frame]
        at, sight = axes.seen(car), own.seen(car)
        return {
            **at._asdict(),
            "speed_mps": _SPEED_MPS,
            "range_m": math.hypot(sight.x_m, sight.y_m),
            "bearing_rad": math.atan2(sight.y_m, sight.x_m),
            "range_rate_mps": 0.0,
        }


def _frame(k: int) -> Frame:
    """Return the frame of the lists `k`."""
    return FRAMES[k % len(FRAMES)]
