"""A point that is fixed to a moving body."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtrack.core.geometry import body_point, in_polygon, may_be_radians

metres = st.floats(-10.0, 10.0)


@given(
    yaw=st.floats(-3.1, 3.1),
    speed=st.floats(-30.0, 60.0),
    rate=st.floats(-1.0, 1.0),
    ahead=metres,
    left=metres,
)
def test_its_velocity_is_the_derivative_of_its_position(
    yaw: float, speed: float, rate: float, ahead: float, left: float
) -> None:
    def place(dt_s: float) -> np.ndarray:
        """Of a body that moves on its arc for a moment."""
        middle = yaw + 0.5 * rate * dt_s
        moved = (
            5.0 + speed * dt_s * math.cos(middle),
            -2.0 + speed * dt_s * math.sin(middle),
        )
        return np.array(
            body_point(*moved, yaw + rate * dt_s, speed, rate, ahead, left)[:2]
        )

    step_s = 1e-5
    found = body_point(5.0, -2.0, yaw, speed, rate, ahead, left)[2:]
    assert found == pytest.approx(
        (place(step_s) - place(-step_s)) / (2.0 * step_s), abs=1e-6
    )


def test_a_standing_body_that_turns_carries_it_round_a_circle() -> None:
    x_m, y_m, vx_mps, vy_mps = body_point(1.0, 2.0, math.pi / 2.0, 0.0, 0.5, 3.0, 1.0)
    assert (x_m, y_m) == pytest.approx((0.0, 5.0))
    assert (vx_mps, vy_mps) == pytest.approx((-1.5, -0.5))


def test_arrays_give_what_single_numbers_give() -> None:
    bodies = np.random.default_rng(0).normal(size=(7, 5))
    found = np.stack(body_point(*bodies.T, 2.0, -1.0), axis=1)
    np.testing.assert_allclose(
        found, [body_point(*body.tolist(), 2.0, -1.0) for body in bodies], rtol=1e-15
    )


def test_a_polygon_holds_what_its_outline_surrounds() -> None:
    bent = np.array(
        [(0.0, 0.0), (4.0, 0.0), (4.0, 4.0), (3.0, 4.0), (3.0, 1.0), (0.0, 1.0)]
    )
    points = np.array(
        [(0.5, 0.5), (3.5, 3.0), (1.0, 2.0), (-0.1, 0.5), (4.1, 0.5), (3.5, 4.5)]
    )
    for corners in (bent, bent[::-1], np.roll(bent, 2, axis=0)):
        assert in_polygon(points, corners).tolist() == [
            True,
            True,
            False,
            False,
            False,
            False,
        ]
    slanted = np.array([(1.0, 1.0), (5.0, 1.0), (1.0, 3.0)])
    assert in_polygon(
        np.array([(2.9, 2.0), (3.1, 2.0), (4.5, 1.2), (0.9, 2.0)]), slanted
    ).tolist() == [
        True,
        False,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("least", "most", "is_plausible"),
    [
        (-math.pi, math.pi, True),
        (0.0, math.tau, True),
        (100.0, 101.0, False),
        (-6.0, 6.0, False),
        (0.0, 6.3, False),
    ],
)
def test_angles_in_radians_lie_within_a_turn(
    least: float, most: float, is_plausible: bool
) -> None:
    assert may_be_radians(least, most) == is_plausible
