"""Shortcuts for tests of the tracking floor."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.types import (
    Detection,
    DetectionList,
    FloatArray,
    Frame,
    TrackStatus,
)
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.models.road import Road
from fgtrack.models.track_map import RoadView
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.lives.existence import Lifecycle
from fgtrack.tracking.preprocess import Candidate, Candidates, Group

ZEROS, UNIT = np.zeros(5), np.eye(5)
START_NS = 1_600_000_000_000_000_000


def ms(value: float) -> int:
    """Nanoseconds of `value` milliseconds."""
    return round(value * 1e6)


def message(
    *objects: Detection,
    sensor: str = "lidar",
    stamp_ms: float = 0.0,
    delay_ms: float = 0.0,
    frame: Frame = "ego",
) -> DetectionList:
    """A message that is received `delay_ms` after its stamp."""
    stamp_ns = START_NS + ms(stamp_ms)
    return DetectionList(sensor, stamp_ns, stamp_ns + ms(delay_ms), objects, frame)


def batch(*objects: Detection, frame: Frame = "ego") -> Batch:
    """All of `objects` in one batch."""
    return Batch(message(*objects, frame=frame), START_NS, tuple(range(len(objects))))


def candidate(x_m: float, y_m: float, variance_m2: float = 0.09) -> Candidate:
    """A position in the map."""
    R = variance_m2 * np.eye(2)
    position = np.array([x_m, y_m])
    measurement = Measurement(
        START_NS, measurement_model(("x_m", "y_m"), CTRV()), position, R
    )
    return Candidate(0, (), measurement, position, R)


def bearing(bearing_rad: float, pose: SensorPose, std_rad: float = 0.02) -> Candidate:
    """A line of sight."""
    model = measurement_model(("bearing_rad",), CTRV())
    measurement = Measurement(
        START_NS, model, np.array([bearing_rad]), np.array([[std_rad**2]]), pose
    )
    return Candidate(0, (), measurement, None, None)


def candidates_of(items: Sequence[Candidate]) -> Candidates:
    """The `items`, each in a group of its own."""
    lines, groups = np.full((len(items), 3), np.nan), []
    for i, one in enumerate(items):
        own, pose = one.measurement, one.measurement.pose
        lines[i] = pose.x_m, pose.y_m, pose.yaw_rad + one.values.get("bearing_rad", 0.0)
        if one.position_m is not None:
            lines[i] = *one.position_m, np.nan
        spread = own.R if one.position_covariance is None else one.position_covariance
        groups.append(
            Group(
                np.array([i]),
                replace(own, z=own.z[None], R=own.R[None]),
                spread[None],
                None,
            )
        )
    return Candidates(list(range(len(items))), {}, lines, groups)


def match(
    life: Lifecycle,
    track_id: int,
    scan: Scan,
    item: Candidate,
    mean: FloatArray = ZEROS,
    P: FloatArray = UNIT,
) -> None:
    """`item` is matched with a track of this state."""
    life.matched(
        scan,
        candidates_of([item]),
        [(0, 0)],
        StatesAt((track_id,), mean[None], P[None]),
    )


def status(life: Lifecycle, track_id: int = 0) -> TrackStatus:
    """Status of a track."""
    [found], _ = life.reported([track_id])
    return found


def states(
    positions_m: Sequence[tuple[float, float]], variance_m2: float = 0.09
) -> StatesAt:
    """Tracks 10, 11, ... at these positions."""
    means = np.zeros((len(positions_m), 5))
    means[:, :2] = np.array(positions_m).reshape(-1, 2)
    covariances = np.tile(variance_m2 * np.eye(5), (len(positions_m), 1, 1))
    return StatesAt(tuple(range(10, 10 + len(positions_m))), means, covariances)


class StraightRoad(Road):
    """Runs along a heading; outside is what lies further than `half_width_m` from y = 0."""

    has_track = True

    def __init__(
        self,
        yaw_rad: float = 0.4,
        curvature_radpm: float = 0.01,
        half_width_m: float = np.inf,
    ) -> None:
        super().__init__()
        self.__dict__.update(
            _yaw_rad=yaw_rad,
            _curvature_radpm=curvature_radpm,
            _half_width_m=half_width_m,
        )

    def view(self, points_m: FloatArray) -> RoadView:
        """See `fgtrack.models.road.Road.view`."""
        count = len(points_m)
        outside = np.abs(points_m[:, 1]) > self._half_width_m
        return RoadView(
            np.full(count, self._yaw_rad),
            np.full(count, self._curvature_radpm),
            outside,
        )
