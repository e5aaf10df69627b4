"""Messages of automotive radars, as their drivers give them: detections in the frame of the sensor.

A radar measures the range, the bearing and the range rate of an object; what of it a tracker uses is the choice of the
sensor model. Slots without an object, and what the radar itself says is none, are no detections. The Delphi radars
count angles clockwise, the ESR in degrees and the MRR in radians; each of their messages is one detection (`scan_s`
makes scans of them).
"""

import math
from typing import Any

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection
from fgtrack.io.adapters.common import ObjectList, RosMessage, object_list

__all__ = ["conti_radar", "delphi_esr", "delphi_mrr"]

_NO_TARGET = 0  # status of an ESR track


def conti_radar(message: RosMessage) -> ObjectList:
    """`conti_radar/Measurement`, clusters of a Continental ARS 408: x ahead and y to the left, relative velocities."""
    points = [point for point in message.points if getattr(point, "invalid_state", 0) == 0]
    return object_list(message.header, map(_conti, points), "sensor")


def _conti(point: RosMessage) -> Detection:
    x_m, y_m = float(point.longitude_dist), float(point.lateral_dist)
    range_m = math.hypot(x_m, y_m)
    along = x_m * float(point.longitude_vel) + y_m * float(point.lateral_vel)
    return Detection(
        x_m=x_m,
        y_m=y_m,
        range_m=range_m,
        bearing_rad=math.atan2(y_m, x_m),
        range_rate_mps=along / range_m if range_m > 0.0 else math.nan,
        object_id=int(point.id),
    )


def delphi_esr(message: RosMessage) -> ObjectList:
    """`delphi_esr_msgs/EsrTrack`, one track of a Delphi (Aptiv) ESR."""
    if message.status == _NO_TARGET:
        return object_list(message.header, [], "sensor")
    track = _polar(message.range, -math.radians(message.angle), message.range_rate, message.id, float(message.width))
    return object_list(message.header, [track], "sensor")


def delphi_mrr(message: RosMessage) -> ObjectList:
    """`delphi_mrr_msgs/Detection` (in older drivers `MrrDetection`), one detection of a Delphi (Aptiv) MRR."""
    if not _of(message, "valid_level", "validLevel") or _of(message, "host_veh_clutter", "hostVehClutter"):
        return object_list(message.header, [], "sensor")
    rate, number = _of(message, "range_rate", "rangeRate"), _of(message, "detection_id", "detectionId")
    return object_list(message.header, [_polar(message.range, -message.azimuth, rate, number)], "sensor")


def _polar(range_m: float, bearing_rad: float, rate_mps: float, number: int, width_m: float = 0.0) -> Detection:
    return Detection(
        range_m=float(range_m),
        bearing_rad=wrap_angle(float(bearing_rad)) if math.isfinite(bearing_rad) else math.nan,
        range_rate_mps=float(rate_mps),
        object_id=int(number),
        width_m=width_m if width_m > 0.0 else None,
    )


def _of(message: RosMessage, *names: str) -> Any:  # Any: a number; the versions of a message name it differently
    return next(getattr(message, name) for name in names if hasattr(message, name))
