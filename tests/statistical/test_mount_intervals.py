"""Intervals of estimated mounts contain the true mounts, and are not much wider than the information bound."""

import numpy as np
import pytest

import fgtrack
from tests.support.scripts import load

DRIVES = load("mounts", "drives")


@pytest.mark.slow
def test_intervals_of_mounts_contain_the_true_mounts() -> None:
    covered: list[bool] = []
    ratios: list[float] = []
    for seed in range(6):
        one = DRIVES.drive(seed)
        mounts = fgtrack.mounts(one.messages)
        for sensor, stds in zip(one.sensors[1:], DRIVES.bound(one), strict=True):
            item = mounts[sensor.name]
            true = (sensor.yaw_rad, sensor.x_m, sensor.y_m)
            errors = np.abs(np.subtract(item.pose, true))
            covered += (errors < item.half_widths).tolist()
            ratios += (np.array(item.half_widths) / (1.96 * stds)).tolist()
    assert len(covered) == 36
    assert np.mean(covered) > 0.85
    assert 1.0 < np.median(ratios) < 1.8
