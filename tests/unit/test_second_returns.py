"""A long hull with two detections in each list is one track; two vessels are two."""

import numpy as np

from fgtrack import Config, Detection, DetectionList
from fgtrack.pipeline.build import build_tracker

SECOND = 1_000_000_000


def confirmed(
    second_velocity_mps: tuple[float, float],
    share: float | None,
    second_m: tuple[float, float] = (8.0, 0.0),
) -> int:
    """Return the number of confirmed tracks of two echoes, the second one with a place and a velocity of its own."""
    returns = None if share is None else {"share": share, "std_m": 6.0}
    config = Config.from_dict(
        {
            "estimator": "ekf-replay",
            "association": {"kind": "hypotheses"},
            "sensors": {
                "lidar": {
                    "std": {"x_m": 0.5, "y_m": 0.5},
                    "detection_probability": 0.95,
                    "clutter_per_m2": 1e-5,
                    "second_returns": returns,
                }
            },
            "motion": {"kind": "cv", "std_per_s": {"velocity": 1.0}},
            "birth": {"speed_std_mps": 3.0},
            "clock": {"node_hz": None},
        }
    )
    tracker, rng = build_tracker(config), np.random.default_rng(3)
    for k in range(60):
        t_s = 0.2 * k
        first = np.array([3.0 * t_s, 0.0])
        second = np.array(second_m) + np.array(second_velocity_mps) * t_s
        seen = [first] if k % 10 == 0 else [first, second]
        objects = [
            Detection(x_m=float(x), y_m=float(y))
            for x, y in (each + rng.normal(0.0, 0.5, 2) for each in seen)
        ]
        stamp_ns = k * SECOND // 5
        tracker.receive(
            DetectionList("lidar", stamp_ns, stamp_ns, objects, frame="map")
        )
        report = tracker.tick(stamp_ns)
    return sum(each.status != "tentative" for each in report.tracks)


def test_the_second_end_of_a_hull_is_no_object() -> None:
    assert confirmed((3.0, 0.0), share=0.5) == 1
    assert confirmed((3.0, 0.0), share=None) == 2


def test_a_second_vessel_with_its_own_velocity_is_an_object() -> None:
    assert confirmed((0.0, 3.0), share=0.5) == 2


def test_a_vessel_abreast_is_an_object_and_not_the_other_end_of_the_hull() -> None:
    assert confirmed((3.0, 0.0), share=0.5, second_m=(0.0, 12.0)) == 2
    assert confirmed((3.0, 0.0), share=0.5, second_m=(12.0, 0.0)) == 1
