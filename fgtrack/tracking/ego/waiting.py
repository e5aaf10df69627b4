"""Lists that wait for an ego message, because they would be placed by a pose that is extrapolated."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from statistics import median

from fgtrack.core.types import FloatArray
from fgtrack.models.measurement import RELATIVE
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.ego.trajectory import MAX_EXTRAPOLATION_NS, EgoTrajectory
from fgtrack.tracking.inbox import Batch, own_covariance

_POSITION = ("x_m", "y_m")


def places(batch: Batch, sensor: SensorModel) -> bool:
    """Return True if the ego pose decides where the detections of `batch` are, or which of them are used.

    Detections in the frame of the ego or of the sensor need the pose. Detections in the map need it where they are
    measured relative to the sensor, are moved back from a near side, or are limited to a range. The view of a sensor
    only judges tracks that a list does not show: an extrapolated pose is good enough for a view.
    """
    if batch.message.frame != "map":
        return True
    return (
        not sensor.std.keys().isdisjoint(RELATIVE)
        or sensor.max_range_m is not None
        or sensor.near_side_m != 0.0
    )


def range_of(batch: Batch) -> float | None:
    """Return the median of the measured distances of the detections of `batch`; None if no distance is measured."""
    ranges_m = [
        range_m
        for range_m in map(partial(_range_of, batch), batch.indices)
        if range_m is not None
    ]
    return median(ranges_m) if ranges_m else None


def _range_of(batch: Batch, index: int) -> float | None:
    """Return the measured distance of a detection from its sensor or the ego; None if it is not measured."""
    detection = batch.message.objects[index]
    if batch.message.frame == "map" or detection.x_m is None or detection.y_m is None:
        return detection.range_m
    return math.hypot(detection.x_m, detection.y_m)


@dataclass(frozen=True)
class PoseWait:
    """Decides which lists wait until an ego state at or after their stamp is there.

    A list waits where an extrapolated pose would cost it more than its noise, or where there is no pose. Else it is
    used at once: the track of an object that moves loses more by a delay. A list waits for at most `limit_ns` from the
    first tick after its receipt. It does not wait any longer once it is `most_age_ns` old: an estimator must still be
    able to fuse it.
    """

    ego: EgoTrajectory
    sensors: Mapping[str, SensorModel]
    limit_ns: int
    most_age_ns: int

    def __call__(self, batch: Batch, now_ns: int) -> bool:
        """Return True if `batch` waits at the tick `now_ns`."""
        stamp_ns, newest_ns = batch.stamp_ns, self.ego.newest_ns
        if newest_ns is not None and newest_ns >= stamp_ns:
            return False
        since_ns = now_ns if batch.since_ns is None else batch.since_ns
        if now_ns >= min(since_ns + self.limit_ns, stamp_ns + self.most_age_ns):
            return False
        sensor = self.sensors[batch.message.sensor]
        if not batch.indices or not places(batch, sensor):
            return False
        if newest_ns is None or newest_ns < stamp_ns - MAX_EXTRAPOLATION_NS:
            return (
                batch.message.frame != "map"
            )  # detections in the map are used as they are
        growth = self.ego.growth_at(stamp_ns)
        return growth is None or median(_losses(batch, sensor, growth)) > 1.0


def _losses(batch: Batch, sensor: SensorModel, growth: FloatArray) -> Iterator[float]:
    """Yield, for each detection of `batch`, the factor by which an extrapolated pose increases its variance.

    `growth`, shape (5, 5), is the covariance of x, y, yaw, speed and yaw rate that the extrapolation adds.
    """
    std, along_m2, turn_rad2 = (
        sensor.std,
        0.5 * float(growth[0, 0] + growth[1, 1]),
        float(growth[2, 2]),
    )
    for index in batch.indices:
        detection, losses, range_m = (
            batch.message.objects[index],
            [0.0],
            _range_of(batch, index),
        )
        if (
            batch.message.frame != "map"
            and detection.x_m is not None
            and "x_m" in std
            and range_m is not None
        ):
            noise_m2 = 0.5 * (std["x_m"] ** 2 + std["y_m"] ** 2)
            if detection.covariance is not None and sensor.message_covariance:
                noise_m2 = 0.5 * float(own_covariance(detection, _POSITION).trace())
            losses.append((along_m2 + range_m**2 * turn_rad2) / noise_m2)
        elif range_m is not None and "range_m" in std:
            losses.append(along_m2 / std["range_m"] ** 2)
        if "bearing_rad" in std:
            losses.append(turn_rad2 / std["bearing_rad"] ** 2)
        if "range_rate_mps" in std:
            losses.append(float(growth[3, 3]) / std["range_rate_mps"] ** 2)
        yield max(losses)
