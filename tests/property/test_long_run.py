"""What a tracker keeps does not grow with the length of the run."""

import gc
import tracemalloc

import numpy as np
import pytest

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.shipped import read_config
from fgtrack.tracking.tracker import Tracker

START_NS = 1_600_000_000 * NS_PER_S
HZ = 10


def drive(tracker: Tracker, sensor: str, rng: np.random.Generator, begin: int, end: int) -> None:
    """Lists `begin` to `end` of three cars side by side, one of them in and out of sight, and false ones."""
    for k in range(begin, end):
        stamp_ns = START_NS + k * NS_PER_S // HZ
        points = np.array([[2.0 * k, 0.0], [2.0 * k, 30.0], [2.0 * k, 60.0]]) + 0.1 * rng.normal(size=(3, 2))
        seen = points[: 2 + (k // 50) % 2].tolist()
        if rng.random() < 0.1:
            seen.append([2.0 * k + 40.0, 300.0])
        objects = [Detection(x_m=x, y_m=y, yaw_rad=0.0) for x, y in seen]
        tracker.receive(DetectionList(sensor, stamp_ns, stamp_ns + NS_PER_S // 10, objects, "map"))
        tracker.tick(stamp_ns + NS_PER_S // 10)


@pytest.mark.parametrize("estimator", ["ekf-replay", "ekf-backward-forward", "smoother-banded"])
def test_a_run_four_times_as_long_keeps_no_more(estimator: str) -> None:
    config = read_config("smoother", ["smoother.lag_s=0.5", "filter.storage_s=0.5"], estimator=estimator)
    tracker, rng = build_tracker(config), np.random.default_rng(0)
    kept = []
    tracemalloc.start()
    try:
        for begin, end in ((0, 100), (100, 400)):
            drive(tracker, "lidar", rng, begin, end)
            gc.collect()
            kept.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert kept[1] < 1.2 * kept[0] + 50_000, f"{kept[0] / 1e3:.0f} kB, later {kept[1] / 1e3:.0f} kB"
