"""The ego's path through all of its states."""

import numpy as np
import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import EgoState
from fgtrack.pipeline.ego_path import EgoPath

START_NS = 1_600_000_000_000_000_000
SPEED_MPS, YAW_RATE_RADPS = 50.0, 0.25


def states(std_m: float = 0.0, num: int = 1000) -> list[EgoState]:
    """A circle at 100 Hz; the yaw passes the jump of its convention."""
    rng = np.random.default_rng(0)
    found = []
    for k in range(num):
        yaw_rad = 2.5 + YAW_RATE_RADPS * 0.01 * k
        radius_m = SPEED_MPS / YAW_RATE_RADPS
        x_m, y_m = radius_m * np.array([np.sin(yaw_rad), -np.cos(yaw_rad)]) + std_m * rng.standard_normal(2)
        wrapped_rad = np.arctan2(np.sin(yaw_rad), np.cos(yaw_rad))
        stamp_ns = START_NS + nanoseconds(0.01 * k)
        found.append(EgoState(stamp_ns, stamp_ns, x_m, y_m, float(wrapped_rad), SPEED_MPS, YAW_RATE_RADPS, 0.0))
    return found


def at(after_s: float) -> int:
    return START_NS + nanoseconds(after_s)


def test_it_goes_through_exact_states_and_between_them() -> None:
    path = EgoPath(states(), 2.0)
    for after_s in (1.234, 5.0, 8.7654):
        yaw_rad = 2.5 + YAW_RATE_RADPS * after_s
        pose = path(at(after_s))
        np.testing.assert_allclose(pose[:2], 200.0 * np.array([np.sin(yaw_rad), -np.cos(yaw_rad)]), atol=1e-3)
        assert pose.yaw_rad == pytest.approx(yaw_rad, abs=1e-4)
        assert pose.speed_mps == pytest.approx(SPEED_MPS, rel=1e-3)


def test_it_moves_as_the_ego_does_and_not_as_its_noise() -> None:
    path = EgoPath(states(0.02), 2.0)
    moved_m = [np.subtract(path(at(t + 0.001))[:2], path(at(t - 0.001))[:2]) for t in np.arange(1.0, 9.0, 0.1)]
    speeds_mps = np.linalg.norm(moved_m, axis=1) / 0.002
    assert np.abs(speeds_mps - SPEED_MPS).max() < 0.2  # from state to state the noise moves at 3 m/s


def test_it_goes_straight_on_beyond_both_ends() -> None:
    path = EgoPath(states(), 2.0)
    for end_ns, sign in ((path.start_ns, -1), (path.end_ns, 1)):
        end, beyond = path(end_ns), path(end_ns + sign * nanoseconds(0.5))
        assert np.hypot(*np.subtract(beyond[:2], end[:2])) == pytest.approx(0.5 * SPEED_MPS, rel=0.01)
    assert seconds(path.end_ns - path.start_ns) == pytest.approx(9.99)


def test_the_order_of_states_and_broken_ones_do_not_matter() -> None:
    good = states(0.02, 50)
    bad = EgoState(at(0.1234), at(0.1234), float("nan"), 0.0, 0.0, 50.0, 0.0, 0.0)
    time_ns = at(0.2345)
    assert EgoPath([*reversed(good), bad, good[3]], 2.0)(time_ns) == EgoPath(good, 2.0)(time_ns)


def test_too_few_states_are_refused_with_their_number() -> None:
    with pytest.raises(DataError, match="4 states"):
        EgoPath(states(num=4), 2.0)
