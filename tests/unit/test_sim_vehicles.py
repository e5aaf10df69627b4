import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy import stats

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import ACCEL, SPEED, YAW, YAW_RATE
from fgtrack.models.motion import CTRV
from fgtrack.models.oval import make_oval
from fgtrack.models.path import Path
from fgtrack.sim.vehicles import DrawnVehicle, LaneChange, TrackVehicle, draw_states

OVAL = make_oval()
PATH = Path.through(OVAL.table[:, :2])
BUSY = TrackVehicle(
    arc_m=2350.0,
    lateral_m=-4.0,
    speed=((0.0, 60.0), (10.0, 75.0), (30.0, 50.0), (35.0, 70.0)),
    lane_changes=(
        LaneChange(1.0, 3.0, 4.0),
        LaneChange(4.0, 2.0, 0.0),
        LaneChange(25.0, 6.0, -5.0),
    ),
)
STILL = CTRV(0.0, 0.0, 0.0, 0.0, resting_yaw_rad2ps=0.0)


@given(st.lists(st.floats(0.01, 60.0), min_size=1, max_size=50))
@example([34.89984906191907])
def test_yaw_is_the_direction_of_travel_and_the_rates_are_derivatives(
    times: list[float],
) -> None:
    t, h = np.array(times), 1e-4
    now, ahead, behind = (BUSY.states(PATH, t + shift) for shift in (0.0, h, -h))
    velocity = (ahead[:, :2] - behind[:, :2]) / (2.0 * h)
    np.testing.assert_allclose(np.hypot(*velocity.T), now[:, SPEED], rtol=1e-6)
    assert (
        np.abs(
            wrap_angles(np.arctan2(velocity[:, 1], velocity[:, 0]) - now[:, YAW])
        ).max()
        < 1e-6
    )
    yaw_rate = wrap_angles(ahead[:, YAW] - behind[:, YAW]) / (2.0 * h)
    np.testing.assert_allclose(now[:, YAW_RATE], yaw_rate, atol=1e-4)
    # Where a piece of the path begins, the acceleration off the line jumps: a numeric one is half the jump off.
    knots = PATH.u_m
    jump = np.abs(
        PATH.frame(knots + 1e-9).turn_rate - PATH.frame(knots - 1e-9).turn_rate
    ).max()
    atol = 0.5 * jump * 75.0**2 * 5.0 + 1e-3
    assert atol < 0.1
    np.testing.assert_allclose(
        now[:, ACCEL], (ahead[:, SPEED] - behind[:, SPEED]) / (2.0 * h), atol=atol
    )


def test_a_drawn_vehicle_without_noise_drives_the_exact_arc() -> None:
    vehicle = DrawnVehicle(1.0, 2.0, 3.0, 60.0, 0.3, motion=STILL)
    times = np.array([0.0, 0.0049, 0.01, 1.2345, 20.0])
    states = vehicle.trajectory(np.random.default_rng(0), 20.0).states(times)
    expected = STILL.predict(np.array([1.0, 2.0, 3.0, 60.0, 0.3]), times)
    expected[:, YAW] = wrap_angles(expected[:, YAW])
    np.testing.assert_allclose(states[:, :5], expected, atol=1e-9)
    assert (states[:, ACCEL] == 0.0).all()


@pytest.mark.parametrize(("start_s", "step_s"), [(0.0, 0.05), (0.0037, 0.4)])
def test_a_drawn_vehicle_moves_as_its_motion_model_says(
    start_s: float, step_s: float
) -> None:
    motion = CTRV()
    vehicle = DrawnVehicle(0.0, 0.0, 1.0, 60.0, 0.2, motion=motion)
    states = vehicle.trajectory(np.random.default_rng(2), 20.0).states(
        np.arange(start_s, 20.0, step_s)
    )
    x = states[:, : motion.dim]
    error = x[1:] - motion.predict(x[:-1], step_s)
    error[:, YAW] = wrap_angles(error[:, YAW])
    Q = motion.process_noise(x[:-1], step_s)
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(Q, error[:, :, None])[:, :, 0])
    chi2 = stats.chi2(motion.dim * len(nees))
    assert chi2.ppf(1e-4) < nees.sum() < chi2.ppf(1.0 - 1e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: TrackVehicle(0.0, speed=((1.0, 9.0), (1.0, 9.0))),
            "speed: times of the knots",
        ),
        (lambda: TrackVehicle(arc_m=float("inf"), speed=((0.0, 9.0),)), "arc_m"),
        (
            lambda: TrackVehicle(
                0.0,
                speed=((0.0, 9.0),),
                lane_changes=(LaneChange(0.0, 2.0, 1.0), LaneChange(1.0, 2.0, 0.0)),
            ),
            "lane_changes: a lane change must end before the next one starts",
        ),
        (lambda: DrawnVehicle(0.0, 0.0, 0.0, 9.0, step_s=0.0), "step_s"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_draws_have_the_mean_and_the_covariance_of_the_model() -> None:
    x, dt_s, num = np.array([3.0, -2.0, 3.1, 20.0, 0.2]), 0.1, 20_000
    found = draw_states(
        CTRV(), np.tile(x, (num, 1)), dt_s, np.random.default_rng(1)
    ) - CTRV().predict(x, dt_s)
    found[:, YAW] = wrap_angles(found[:, YAW])
    Q = CTRV().process_noise(x, dt_s)
    whitened = np.linalg.solve(np.linalg.cholesky(Q), found.T)
    np.testing.assert_allclose(whitened.mean(axis=1), 0.0, atol=5.0 / np.sqrt(num))
    np.testing.assert_allclose(
        np.cov(whitened), np.eye(5), atol=5.0 * np.sqrt(2.0 / num)
    )
