"""Objects seen from an ego whose pose comes late are as uncertain as the tracker says."""

from dataclasses import replace

import numpy as np
import pytest
from support.late_ego import Drive, followed

CAR = Drive()
RACE_CAR = Drive(speed_mps=70.0, yaw_rate_radps=0.3, period_s=8.0, range_m=40.0)
SHIP = Drive(
    speed_mps=4.0, yaw_rate_radps=0.02, period_s=20.0, range_m=100.0, noise_m=1.0
)
ROVER = Drive(
    speed_mps=2.0, yaw_rate_radps=0.2, period_s=6.0, range_m=15.0, noise_m=0.2
)
STRAIGHT = Drive(yaw_rate_radps=0.0)
SEEDS = range(6)
#: Consistent positions have a mean NEES of 2; the bar of a late ego is 1.5 to 3.
LOW, HIGH = 1.5, 3.0


def is_consistent(
    given: Drive, estimator: str = "ekf-replay", **settings: object
) -> bool:
    """True if the mean NEES is within the bar, whose lower end it may miss by its sampling error of 95 %."""
    each = [followed(given, seed, estimator, **settings).nees for seed in SEEDS]
    error = 2.0 * np.std(each, ddof=1) / np.sqrt(len(each))
    return bool(LOW - error < np.mean(each) < HIGH)


@pytest.mark.long
@pytest.mark.parametrize("late_s", [0.1, 0.2, 0.35, 0.6])
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_positions_are_consistent_however_late_the_ego_is(
    estimator: str, late_s: float
) -> None:
    assert is_consistent(replace(CAR, late_s=late_s), estimator)


@pytest.mark.long
@pytest.mark.parametrize("late_s", [0.2, 0.35, 0.6])
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_positions_are_consistent_without_waiting(
    estimator: str, late_s: float
) -> None:
    assert is_consistent(replace(CAR, late_s=late_s), estimator, wait_s=0.0)


@pytest.mark.long
@pytest.mark.parametrize("wait_s", [0.0, 1.0])
@pytest.mark.parametrize(
    "vehicle",
    [
        replace(RACE_CAR, late_s=0.25),
        replace(SHIP, late_s=0.6),
        replace(ROVER, late_s=0.5),
        replace(STRAIGHT, late_s=0.4),
        replace(CAR, late_s=0.2, jitter_s=0.4),
        replace(CAR, late_s=0.3, list_hz=25.0),
        replace(CAR, late_s=0.3, list_hz=2.0, duration_s=30.0),
        replace(CAR, late_s=0.4, noise_m=2.0, range_m=30.0),
    ],
    ids=[
        "race car",
        "ship",
        "rover",
        "straight road",
        "jitter",
        "25 Hz",
        "2 Hz",
        "2 m",
    ],
)
def test_the_uncertainty_fits_what_the_vehicle_does(
    vehicle: Drive, wait_s: float
) -> None:
    assert is_consistent(vehicle, wait_s=wait_s)


@pytest.mark.long
@pytest.mark.parametrize("late_s", [0.0, 0.4])
@pytest.mark.parametrize("ego_hz", [1.0, 3.0])
def test_positions_between_two_states_of_a_slow_ego_are_consistent(
    ego_hz: float, late_s: float
) -> None:
    assert is_consistent(replace(CAR, ego_hz=ego_hz, late_s=late_s))


@pytest.mark.slow
def test_the_default_smoother_is_consistent_with_a_late_ego() -> None:
    assert is_consistent(replace(CAR, late_s=0.45), "smoother")


@pytest.mark.long
def test_waiting_until_the_pose_is_good_enough_gives_smaller_errors_than_not_waiting() -> (
    None
):
    late = replace(CAR, late_s=0.6)
    at_once, waiting = (
        [followed(late, seed, wait_s=w).rmse_m for seed in SEEDS] for w in (0.0, 1.0)
    )
    gain_m = np.subtract(at_once, waiting)
    assert gain_m.mean() > 2.0 * gain_m.std(ddof=1) / np.sqrt(len(gain_m)) > 0.0


@pytest.mark.parametrize("late_s", [0.0, 0.3, 0.8, 1.7, 3.0])
@pytest.mark.parametrize("wait_s", [0.0, 0.4, 1.0])
def test_every_detection_ends_once_whatever_the_ego_does(
    late_s: float, wait_s: float
) -> None:
    for ego_from_s, ego_until_s in (
        (-1.0, 20.0),
        (1.0, 20.0),
        (-1.0, 2.0),
        (5.0, 20.0),
    ):
        given = replace(
            CAR,
            late_s=late_s,
            duration_s=4.0,
            ego_from_s=ego_from_s,
            ego_until_s=ego_until_s,
        )
        assert len(followed(given, 1, wait_s=wait_s).dispositions) == 40
