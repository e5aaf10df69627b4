"""Final states of a tracker that decides by hypotheses."""

import pytest

from fgtrack import Config, Detection, DetectionList
from fgtrack.core.types import SmoothedReport
from fgtrack.pipeline.build import build_tracker

MS = 1_000_000


def final_positions(others: dict[int, int]) -> set[float]:
    """Return y of the tracks with final states: of an object at 0 m, and of others with this number of detections."""
    tracker = build_tracker(
        Config.from_dict(
            {
                "estimator": "smoother-banded",
                "association": {"kind": "hypotheses"},
                "lifecycle": {"kind": "existence"},
                "sensors": {"lidar": {"std": {"x_m": 0.2, "y_m": 0.2}}},
                "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
                "smoother": {"lag_s": 1.0},
            }
        )
    )
    reports: list[SmoothedReport] = []
    for k in range(30):
        objects = [Detection(x_m=0.5 * k, y_m=0.0)]
        objects += [
            Detection(x_m=0.0, y_m=float(y_m))
            for y_m, count in others.items()
            if 5 <= k < 5 + count
        ]
        now_ns = k * 100 * MS
        tracker.receive(DetectionList("lidar", now_ns, now_ns, objects, frame="map"))
        reports += tracker.tick(now_ns).smoothed
    reports += tracker.finish()
    final = [each for each in reports if each.lag_s is None]
    return {round(float(each.state.mean[1]), 3) for each in final}


@pytest.mark.parametrize(("count", "expected"), [(1, {0.0}), (6, {0.0, 60.0})])
def test_one_unconfirmed_detection_gives_no_final_state(
    count: int, expected: set[float]
) -> None:
    assert final_positions({60: count}) == expected
