"""A drive that is right, as records: an ego, five sensors that measure everything that a detection may hold, six cars.

A record is a message as a dictionary, as in a stream. Its `at_ns`, which no message has, is the time when it arrives.
Two cars are seen by `lidar` alone, whatever the other sensors report.
"""

import math
from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np

Record = dict[str, Any]

START_NS = 1_700_000_000_000_000_000
DURATION_S, RATE_HZ = 1.4, 10
_WHOLE_CIRCLE = 6.28
#: The sensors of the drive, as in a configuration. Each sees its own cars alone.
SENSORS: dict[str, Any] = {
    "lidar": {
        "std": {"x_m": 0.3, "y_m": 0.3},
        "field_of_view_rad": 1.2,
        "max_range_m": 120.0,
    },
    "boxes": {
        "std": {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1},
        "mount": {"yaw_rad": 1.57},
        "field_of_view_rad": 1.5,
        "max_range_m": 80.0,
        "filters": {"class_name": {"none_of": ["bird"]}},
        "score": {"even": 0.2, "scale": 0.5},
    },
    "radar": {
        "std": {"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.2},
        "mount": {"x_m": -1.0, "yaw_rad": 3.14},
        "field_of_view_rad": 1.5,
        "max_range_m": 120.0,
    },
    "camera": {"std": {"bearing_rad": 0.01}, "max_delay_s": 0.5},
    "v2x": {
        "std": {"x_m": 1.0, "y_m": 1.0, "yaw_rad": 0.1, "speed_mps": 0.5},
        "stamp_from": "object",
        "stamp_std_s": 0.02,
        "scan": False,
        "copies_s": 0.05,
        "field_of_view_rad": _WHOLE_CIRCLE,
    },
}
#: Position at the start, and the velocity along x, of each car. The ego drives along x at 10 m/s from the origin.
CARS: dict[str, tuple[float, float, float]] = {
    "ahead": (40.0, 5.0, 11.0),
    "far ahead": (70.0, -6.0, 9.0),
    "left": (2.0, 20.0, 10.0),
    "behind": (-30.0, 3.0, 10.5),
    "far behind": (-60.0, -8.0, 10.0),
    "right": (5.0, -40.0, 12.0),
}
#: Sensors that see each car.
SEEN_BY = {
    "ahead": "lidar",
    "far ahead": "lidar",
    "left": "boxes",
    "behind": "radar",
    "far behind": "radar",
    "right": "v2x",
}
_EGO_MPS = 10.0
_DELAYS_MS = {"lidar": 30, "boxes": 60, "radar": 40, "camera": 80, "v2x": 150}


def place_m(car: str, stamp_ns: int) -> tuple[float, float]:
    """Return the true position of a car at a stamp."""
    x_m, y_m, speed_mps = CARS[car]
    return x_m + speed_mps * (stamp_ns - START_NS) / 1e9, y_m


def drive(sensors: Sequence[str] = tuple(SENSORS)) -> list[Record]:
    """Return the records of the ego and of some sensors in the order of their arrival, for the caller to change."""
    return [
        deepcopy(record)
        for record in _drive()
        if record.get("sensor") in (None, *sensors)
    ]


@cache
def _drive() -> list[Record]:
    rng, records = np.random.default_rng(42), list[Record]()
    for k in range(round(DURATION_S * RATE_HZ)):
        stamp_ns = START_NS + k * 10**9 // RATE_HZ
        records.append(_ego(stamp_ns))
        for sensor, delay_ms in _DELAYS_MS.items():
            records.append(_list(rng, sensor, stamp_ns, delay_ms))
    return sorted(records, key=lambda record: record["at_ns"])


def _ego(stamp_ns: int) -> Record:
    variances = (0.01, 0.01, 1e-4, 0.01, 1e-4)
    return {
        "type": "ego",
        "stamp_ns": stamp_ns,
        "receipt_ns": stamp_ns + 5 * 10**6,
        "x_m": _EGO_MPS * (stamp_ns - START_NS) / 1e9,
        "y_m": 0.0,
        "yaw_rad": 0.0,
        "speed_mps": _EGO_MPS,
        "yaw_rate_radps": 0.0,
        "accel_mps2": 0.0,
        "in_pit": False,
        "covariance": np.diag(variances).ravel().tolist(),
        "at_ns": stamp_ns + 5 * 10**6,
    }


def _list(
    rng: np.random.Generator, sensor: str, stamp_ns: int, delay_ms: int
) -> Record:
    seen = [
        car
        for car, by in SEEN_BY.items()
        if by == sensor or (sensor == "camera" and by == "boxes")
    ]
    receipt_ns = stamp_ns + delay_ms * 10**6
    return {
        "type": "detections",
        "sensor": sensor,
        "stamp_ns": stamp_ns,
        "receipt_ns": receipt_ns,
        "frame": {"lidar": "map", "v2x": "map", "radar": "sensor"}.get(sensor, "ego"),
        "objects": [_detection(rng, sensor, car, stamp_ns) for car in seen],
        "at_ns": receipt_ns,
    }


def _detection(
    rng: np.random.Generator, sensor: str, car: str, stamp_ns: int
) -> Record:
    x_m, y_m = place_m(car, stamp_ns)
    ahead_m, left_m = x_m - _EGO_MPS * (stamp_ns - START_NS) / 1e9, y_m
    noise = rng.standard_normal(4).tolist()
    number = list(CARS).index(car)
    described = {
        "length_m": 4.5,
        "width_m": 1.8,
        "height_m": 1.5,
        "class_name": "car",
        "score": 0.9,
        "z_m": 0.7,
    }
    if sensor == "lidar":
        return {"x_m": x_m + 0.3 * noise[0], "y_m": y_m + 0.3 * noise[1]}
    if sensor == "boxes":
        return {
            "x_m": ahead_m + 0.3 * noise[0],
            "y_m": left_m + 0.3 * noise[1],
            "yaw_rad": 0.05 * noise[2],
            "covariance": [0.09, 0.01, 0.0, 0.01, 0.09, 0.0, 0.0, 0.0, 0.01],
            "object_id": number,
            **described,
        }
    if sensor == "camera":
        return {
            "bearing_rad": math.atan2(left_m, ahead_m) + 0.01 * noise[0],
            "class_name": "car",
            "score": 0.8,
        }
    if sensor == "radar":
        back_m = -1.0 - ahead_m  # the sensor looks back
        range_m = math.hypot(back_m, left_m)
        rate_mps = -(CARS[car][2] - _EGO_MPS) * back_m / range_m
        return {
            "range_m": range_m + 0.5 * noise[0],
            "bearing_rad": math.atan2(-left_m, back_m) + 0.02 * noise[1],
            "range_rate_mps": rate_mps + 0.2 * noise[2],
            "object_id": number,
        }
    return {
        "x_m": x_m + noise[0],
        "y_m": y_m + noise[1],
        "yaw_rad": 0.1 * noise[2],
        "speed_mps": CARS[car][2] + 0.5 * noise[3],
        "covariance": np.diag((1.0, 1.0, 0.01, 0.25)).ravel().tolist(),
        "stamp_ns": stamp_ns + 3 * 10**6,
        "id": f"4CA9{number:02}",
        **described,
    }


def numbers_of(records: Sequence[Record]) -> int:
    """Return the number of detections."""
    return sum(
        len(record["objects"]) for record in records if record["type"] == "detections"
    )
