"""Tests of what is known of a new object."""

import math

import numpy as np
import pytest

from fgtrack.core.errors import CallError
from fgtrack.estimation.base import Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.motion import CTRA, CTRV, CV


def test_the_values_and_their_standard_deviations_become_the_state() -> None:
    start = Start(
        position_m=(1.0, 2.0),
        position_std_m=0.5,
        yaw_rad=0.4,
        yaw_std_rad=0.2,
        speed_mps=30.0,
    )
    mean, P = initial_state(CTRA(), start)
    assert mean.tolist() == [1.0, 2.0, 0.4, 30.0, 0.0, 0.0]
    assert np.sqrt(np.diag(P)).tolist() == pytest.approx(
        [0.5, 0.5, 0.2, 10.0, 0.3, 1.0]
    )


def test_every_value_is_named() -> None:
    with pytest.raises(TypeError):
        Start(0)  # type: ignore[misc]


def test_a_position_covariance_takes_the_place_of_the_standard_deviation() -> None:
    R = np.array([[2.0, 0.5], [0.5, 1.0]])
    for motion in (CTRV(), CV()):
        for yaw_rad in (0.3, None):
            P = initial_state(motion, Start(position_covariance=R, yaw_rad=yaw_rad))[1]
            assert P[:2, :2].tolist() == R.tolist()


def test_of_an_unknown_direction_the_yaw_is_uniform_and_the_velocity_isotropic() -> (
    None
):
    start = Start(speed_mps=3.0, speed_std_mps=4.0)
    mean, P = initial_state(CTRV(), start)
    assert (mean[2], P[2, 2]) == (0.0, pytest.approx(math.pi**2 / 3.0))
    mean, P = initial_state(CV(), start)
    assert mean.tolist() == [0.0] * 4
    assert P[2:, 2:].tolist() == [[25.0, 0.0], [0.0, 25.0]]
    assert initial_state(CTRV(), Start(yaw_rad=0.0))[1][2, 2] == pytest.approx(0.1**2)


@pytest.mark.parametrize(
    "wrong",
    [
        {"position_m": (1.0, math.nan)},
        {"position_m": (1.0, 2.0, 3.0)},
        {"position_covariance": np.eye(3)},
        {"position_std_m": -0.1},
        {"yaw_rad": math.inf},
        {"speed_mps": math.nan},
        {"position_std_m": 1e308},
        {"position_m": ("1", "2")},
        {"position_m": (1.0, (2.0, 3.0))},
        {"position_std_m": None},
        {"speed_mps": None},
        {"speed_mps": "fast"},
        {"speed_mps": np.array([1.0])},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_a_value_that_makes_no_sense_is_named(wrong: dict) -> None:
    with pytest.raises(CallError, match=f"^Start: {next(iter(wrong))}: must be finite"):
        Start(**wrong)
