"""A dense scene: twelve cars in clutter, seen by a LiDAR and a RADAR."""

from collections.abc import Iterator, Mapping

import numpy as np

from fgtrack import NS_PER_S, Config, Detection, DetectionList, Message, TruthState

NUM_OBJECTS = 12
LENGTH_S = 6.0
SIDE_M = 50.0
FALSE_PER_LIST = 15.0
PERIOD_S = 0.1
SPEED_STD_MPS = 6.0
STDS_M: Mapping[str, float] = {"lidar": 0.3, "radar": 0.8}
DETECTED: Mapping[str, float] = {"lidar": 0.85, "radar": 0.7}
OFFSETS_S: Mapping[str, float] = {"lidar": 0.013, "radar": 0.041}
LAGS_S = (0.3, 1.0)


def messages(seed: int, delays_s: Mapping[str, float]) -> list[Message]:
    """Return the truth and all lists of a scene, in the order of receipt."""
    rng = np.random.default_rng(seed)
    first_m = rng.uniform(-0.5 * SIDE_M, 0.5 * SIDE_M, (NUM_OBJECTS, 2))
    velocities_mps = rng.normal(0.0, SPEED_STD_MPS, (NUM_OBJECTS, 2))
    begins_s = rng.uniform(0.0, 0.5 * LENGTH_S, NUM_OBJECTS)
    begins_s[: NUM_OBJECTS // 2] = 0.0
    ends_s = begins_s + rng.uniform(0.25, 1.0, NUM_OBJECTS) * LENGTH_S

    def positions_m(time_s: float) -> Iterator[tuple[int, np.ndarray]]:
        for k in range(NUM_OBJECTS):
            if begins_s[k] <= time_s < ends_s[k]:
                yield k, first_m[k] + velocities_mps[k] * (time_s - begins_s[k])

    found: list[Message] = []
    for time_s in np.arange(0.0, LENGTH_S, 0.5 * PERIOD_S).tolist():
        stamp_ns = round(time_s * NS_PER_S)
        found += [
            TruthState(
                stamp_ns,
                stamp_ns,
                k,
                *point_m.tolist(),
                float(np.arctan2(*velocities_mps[k][::-1])),
                float(np.hypot(*velocities_mps[k])),
            )
            for k, point_m in positions_m(time_s)
        ]
    for sensor, offset_s in OFFSETS_S.items():
        for time_s in np.arange(offset_s, LENGTH_S, PERIOD_S).tolist():
            seen = [
                point_m + rng.normal(0.0, STDS_M[sensor], 2)
                for _, point_m in positions_m(time_s)
                if rng.random() < DETECTED[sensor]
            ]
            number = rng.poisson(FALSE_PER_LIST)
            seen += list(rng.uniform(-0.5 * SIDE_M, 0.5 * SIDE_M, (number, 2)))
            stamp_ns = round(time_s * NS_PER_S)
            receipt_ns = stamp_ns + round(delays_s[sensor] * NS_PER_S)
            objects = [Detection(x_m=float(x), y_m=float(y)) for x, y in seen]
            found.append(
                DetectionList(sensor, stamp_ns, receipt_ns, objects, frame="map")
            )
    return sorted(found, key=lambda each: each.receipt_ns)


def configuration() -> Config:
    """Return the tracker of the scene."""
    return Config.from_dict(
        {
            "estimator": "smoother-banded",
            "sensors": {
                name: {
                    "std": {"x_m": std_m, "y_m": std_m},
                    "detection_probability": DETECTED[name],
                    "clutter_per_m2": FALSE_PER_LIST / SIDE_M**2,
                }
                for name, std_m in STDS_M.items()
            },
            "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
            "birth": {"speed_std_mps": 10.0},
            "clock": {"node_hz": 20.0},
            "filter": {"storage_s": 3.0},
            "smoother": {"lag_s": 3.0, "ring_s": 0.0, "lagged_s": list(LAGS_S)},
            "evaluation": {"gate_m": 3.0},
        }
    )
