"""Two false points near each other confirm no track, whichever hypothesis is the best one."""

import numpy as np

from fgtrack import Config, Detection, DetectionList
from fgtrack.pipeline.build import build_tracker

SIDE_M = 50.0
FALSE_PER_LIST = 15.0
PERIOD_NS = 50_000_000


def test_clutter_alone_confirms_hardly_any_track() -> None:
    config = Config.from_dict(
        {
            "estimator": "ekf-replay",
            "association": {"kind": "hypotheses"},
            "sensors": {
                "lidar": {
                    "std": {"x_m": 0.3, "y_m": 0.3},
                    "detection_probability": 0.85,
                    "clutter_per_m2": FALSE_PER_LIST / SIDE_M**2,
                }
            },
            "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
            "birth": {"speed_std_mps": 10.0},
            "clock": {"node_hz": None},
        }
    )
    tracker, rng = build_tracker(config), np.random.default_rng(5)
    confirmed = set[int]()
    for k in range(30):
        points_m = rng.uniform(0.0, SIDE_M, (rng.poisson(FALSE_PER_LIST), 2))
        objects = [Detection(x_m=float(x), y_m=float(y)) for x, y in points_m]
        stamp_ns = k * PERIOD_NS
        tracker.receive(
            DetectionList("lidar", stamp_ns, stamp_ns, objects, frame="map")
        )
        report = tracker.tick(stamp_ns)
        confirmed |= {
            each.track_id for each in report.tracks if each.status != "tentative"
        }
    assert len(confirmed) <= 2
