"""Tracks that no late list can change any more are handed out once, and forgotten."""

import numpy as np

from fgtrack import Config, Detection, DetectionList
from fgtrack.core.types import FinalTrack
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.decided_tracker import DecidedTracker

MS = 1_000_000
NUM_LISTS = 400


def tracks_in_clutter() -> tuple[list[FinalTrack], list[FinalTrack], int]:
    """Return the final tracks of the reports, the tracks after the last list, and how many tracks are still known.

    One object is detected in each list, beside five false detections.
    """
    config = Config.from_dict(
        {
            "estimator": "ekf-replay",
            "association": {"kind": "hypotheses"},
            "lifecycle": {"kind": "existence"},
            "sensors": {"lidar": {"std": {"x_m": 0.2, "y_m": 0.2}}},
            "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
            "smoother": {"lag_s": 1.0},
        }
    )
    tracker = build_tracker(config)
    assert isinstance(tracker, DecidedTracker)
    rng = np.random.default_rng(3)
    handed_out: list[FinalTrack] = []
    for k in range(NUM_LISTS):
        false = rng.uniform(-200.0, 200.0, (5, 2)).tolist()
        objects = [Detection(x_m=0.5 * k, y_m=0.0)]
        objects += [Detection(x_m=x_m, y_m=y_m) for x_m, y_m in false]
        now_ns = (k + 1) * 100 * MS
        tracker.receive(DetectionList("lidar", now_ns, now_ns, objects, frame="map"))
        handed_out += tracker.tick(now_ns).final_tracks
    num_known = len(tracker._public)
    tracker.finish()
    return handed_out, [*tracker.settled_tracks(), *tracker.final_tracks()], num_known


def test_each_track_is_handed_out_once_and_forgotten() -> None:
    handed_out, last, num_known = tracks_in_clutter()
    numbers = [each.track_id for each in (*handed_out, *last)]
    assert len(numbers) == len(set(numbers))
    assert len(numbers) > 1000 > 3 * num_known
    [lasting] = [each for each in (*handed_out, *last) if each.is_confirmed]
    assert lasting.first_stamp_ns <= 200 * MS
    assert lasting.last_stamp_ns == NUM_LISTS * 100 * MS
