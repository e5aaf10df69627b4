"""A long hull with two detections in each list is one track; two vessels are two."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from fgtrack import Config, Detection, DetectionList
from fgtrack.pipeline.build import build_tracker

SECOND = 1_000_000_000


RETURNS = {"share": 0.5, "std_m": 6.0}


def ships(min_travel_m: float, returns: dict[str, float] | None = RETURNS) -> Config:
    """Return a configuration with one LiDAR."""
    lidar: dict[str, Any] = {
        "std": {"x_m": 0.5, "y_m": 0.5},
        "detection_probability": 0.95,
        "clutter_per_m2": 1e-5,
        "second_returns": returns,
    }
    return Config.from_dict(
        {
            "estimator": "ekf-replay",
            "association": {"kind": "hypotheses"},
            "lifecycle": {"kind": "existence", "min_travel_m": min_travel_m},
            "sensors": {"lidar": lidar},
            "motion": {"kind": "cv", "std_per_s": {"velocity": 1.0}},
            "birth": {"speed_std_mps": 3.0},
            "clock": {"node_hz": None},
        }
    )


def confirmed(
    second_velocity_mps: tuple[float, float],
    share: float | None,
    second_m: tuple[float, float] = (8.0, 0.0),
) -> int:
    """Return the number of confirmed tracks of two echoes, the second one with a place and a velocity of its own."""
    returns = None if share is None else {"share": share, "std_m": 6.0}
    config = ships(0.0, returns)
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


def test_a_vessel_that_was_apart_stays_an_object_alongside() -> None:
    """Both vessels sail side by side at the end, as close as both ends of a hull."""
    assert len(alongside(8.0)) == 2


def test_a_second_return_does_not_take_the_detections_of_its_hull() -> None:
    """Both ends of a hull are seen at random, and their errors last."""
    assert np.mean([hull(seed) for seed in range(2)]) > 0.8


def test_a_slow_object_is_confirmed_once_its_velocity_is_known() -> None:
    """It moves 6 m of the 20 m of `min_travel_m`. A standing object is never confirmed."""
    assert single(speed_mps=1.0, min_travel_m=20.0)
    assert not single(speed_mps=0.0, min_travel_m=20.0)


def alongside(gap_m: float) -> list[int]:
    """Return the confirmed tracks after two vessels have come together."""

    def positions_m(t_s: float) -> list[tuple[float, float]]:
        across_m = 60.0 * math.exp(-0.3 * t_s)
        return [(3.0 * t_s, 0.0), (3.0 * t_s + gap_m, across_m)]

    return tracked(positions_m, 30.0, min_travel_m=0.0)


def hull(seed: int) -> float:
    """Return the share of the last 20 s in which a hull of 14 m has exactly one confirmed track."""
    config = ships(0.0, {"share": 0.3, "std_m": 13.0}).replace(
        {
            "sensors.lidar.std": {"x_m": 3.6, "y_m": 3.6},
            "sensors.lidar.correlation": {
                "share": 0.97,
                "time_s": 35.0,
                "jump_probability": 0.11,
            },
        }
    )
    tracker, rng, shown = build_tracker(config), np.random.default_rng(seed), []
    for k in range(60):
        stamp_ns = k * SECOND // 2
        ends = [
            (2.0 * k + rng.uniform(-7.0, 7.0), rng.normal(0.0, 0.5))
            for _ in range(rng.integers(1, 3))
        ]
        objects = [Detection(x_m=float(x), y_m=float(y)) for x, y in ends]
        tracker.receive(
            DetectionList("lidar", stamp_ns, stamp_ns, objects, frame="map")
        )
        report = tracker.tick(stamp_ns)
        shown.append(sum(each.status != "tentative" for each in report.tracks) == 1)
    return float(np.mean(shown[20:]))


def single(speed_mps: float, min_travel_m: float) -> list[int]:
    """Return the confirmed tracks of one object after 6 s."""
    return tracked(lambda t_s: [(speed_mps * t_s, 0.0)], 6.0, min_travel_m)


def tracked(
    positions_m: Callable[[float], list[tuple[float, float]]],
    length_s: float,
    min_travel_m: float,
) -> list[int]:
    """Return the confirmed tracks after `length_s`."""
    tracker, rng = build_tracker(ships(min_travel_m)), np.random.default_rng(3)
    for k in range(round(5.0 * length_s)):
        stamp_ns = k * SECOND // 5
        objects = [
            Detection(x_m=float(x), y_m=float(y))
            for x, y in (
                each + rng.normal(0.0, 0.5, 2) for each in positions_m(0.2 * k)
            )
        ]
        tracker.receive(
            DetectionList("lidar", stamp_ns, stamp_ns, objects, frame="map")
        )
        report = tracker.tick(stamp_ns)
    return [each.track_id for each in report.tracks if each.status != "tentative"]
