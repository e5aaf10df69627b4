"""How a replaying filter finds the direction of an object that starts with an unknown one."""

from collections.abc import Sequence
from itertools import permutations

import numpy as np
import pytest
from scipy.stats import chi2
from support.directions import PERIOD_NS, START, STD_M, position, positions

import fgtrack
from fgtrack.core.geometry import polar, polar_gradient, rotation, wrap_angle
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.track_initiation import (
    LONGEST_S,
    MOST_MEASUREMENTS,
    TrackInitiation,
)
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRV
from fgtrack.sim.vehicles import draw_states

METHODS = ("two-point", "regression")


def fed(
    initiation: str, measurements: Sequence[Measurement], start: Start = START
) -> Estimator:
    estimator = fgtrack.estimator("ekf-replay", CTRV(), start, initiation=initiation)
    for measurement in measurements:
        assert estimator.update(measurement).nis is not None
    return estimator


def states(estimator: Estimator, num: int) -> list[FloatArray]:
    """Means and covariances between the start and after the last of `num` stamps."""
    found = [
        estimator.state_at(at_ns)
        for at_ns in range(0, (num + 2) * PERIOD_NS, PERIOD_NS // 2)
    ]
    return [np.vstack([state.mean, state.covariance]) for state in found]


def test_without_process_noise_two_points_give_the_textbook_state() -> None:
    """Bar-Shalom, Li and Kirubarajan 2001, section 5.5.3: position z1, velocity (z1 - z0) / T, and their covariance."""
    still = CTRV(*[1e-20] * 4)
    start = Start(
        position_std_m=0.4, yaw_std_rad=1e4, speed_std_mps=1e5, yaw_rate_std_radps=0.0
    )
    z1, T, R0, R1 = (
        np.array([-2.0, 1.0]),
        0.1,
        0.4**2 * np.eye(2),
        np.diag([0.09, 0.04]),
    )
    measurement = Measurement.of(100_000_000, x_m=z1[0], y_m=z1[1], covariance=R1)
    estimator = fgtrack.estimator("ekf-replay", still, start, initiation="two-point")
    estimator.update(measurement)
    found = estimator.state_at(measurement.stamp_ns)
    J = np.eye(4)
    J[2:, 2:] = polar_gradient(z1 / T, 0.0)
    expected = J @ np.block([[R1, R1 / T], [R1 / T, (R0 + R1) / T**2]]) @ J.T
    np.testing.assert_allclose(
        found.mean, [*z1, *polar(z1 / T), 0.0], rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(found.covariance[:4, :4], expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("yaw_rad", [-2.5, 1.5, 3.0])
def test_no_direction_of_travel_is_preferred(method: str, yaw_rad: float) -> None:
    for num in (1, 2, 3, 12):
        ahead, turned = (
            fed(method, positions(yaw, num)).state_at(num * PERIOD_NS).mean.copy()
            for yaw in (0.0, yaw_rad)
        )
        ahead[:2] = rotation(yaw_rad) @ ahead[:2]
        assert abs(wrap_angle(turned[YAW] - ahead[YAW] - yaw_rad)) < 1e-9
        np.testing.assert_allclose(
            np.delete(turned, YAW), np.delete(ahead, YAW), atol=1e-8
        )
    assert abs(turned[3] - 30.0) < 4.0


def test_what_is_no_position_does_not_count() -> None:
    """A bearing alone and a range alone are fused, and give no line."""
    partial = [
        Measurement.of(
            PERIOD_NS,
            bearing_rad=0.4,
            std={"bearing_rad": 0.1},
            pose=SensorPose(-20.0, -9.0),
        ),
        Measurement.of(
            2 * PERIOD_NS,
            range_m=21.0,
            std={"range_m": 1.0},
            pose=SensorPose(-20.0, -9.0),
        ),
        Measurement.of(3 * PERIOD_NS, speed_mps=25.0, std={"speed_mps": 1.0}),
    ]
    expected = states(fed("one-point", partial), 3)
    for method in METHODS:
        np.testing.assert_array_equal(states(fed(method, partial), 3), expected)


def test_range_and_bearing_together_are_a_position() -> None:
    pose = SensorPose(-30.0, 5.0, 0.3)
    measurements = []
    for k, truth in enumerate(positions(2.0, 6), start=1):
        x_m, y_m = (truth.z - np.array([pose.x_m, pose.y_m])).tolist()
        std = {"range_m": 0.3, "bearing_rad": 0.01}
        bearing_rad = float(np.arctan2(y_m, x_m)) - pose.yaw_rad
        measurements.append(
            Measurement.of(
                k * PERIOD_NS,
                range_m=float(np.hypot(x_m, y_m)),
                bearing_rad=bearing_rad,
                std=std,
                pose=pose,
            )
        )
    found = fed("regression", measurements).state_at(6 * PERIOD_NS).mean
    assert abs(wrap_angle(found[YAW] - 2.0)) < 0.15
    assert abs(found[3] - 30.0) < 4.0


def test_two_points_end_it_and_a_regression_ends_where_the_direction_is_certain() -> (
    None
):
    slow = positions(1.0, 3, speed_mps=1.0)
    for method, num in (("two-point", 1), ("regression", 3)):
        opening = TrackInitiation.of(CTRV(), START, method)
        for measurement in slow[:num]:
            assert opening is not None
            assert not opening.over
            opening = opening.with_measurement(measurement)
        assert opening is not None
        assert opening.over == (method == "two-point")
    assert opening is not None
    assert (
        opening.with_measurement(
            position(round(LONGEST_S * 1e9) // PERIOD_NS + 1, 0.0, 0.0)
        )
        is None
    )
    fast = TrackInitiation.of(CTRV(), START, "regression")
    assert fast is not None
    last = fast.with_measurement(position(2, 100.0, 0.0))
    assert last is not None
    assert last.over
    at_rest = [position(4, 0.0, 0.0)] * (MOST_MEASUREMENTS + 1)
    openings = [TrackInitiation.of(CTRV(), START, "regression")]
    for measurement in at_rest:
        assert openings[-1] is not None
        openings.append(openings[-1].with_measurement(measurement))
    assert openings[-1] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "slowest_mps"), [("two-point", 80.0), ("regression", 15.0)]
)
def test_the_state_is_consistent_where_the_direction_is_found(
    method: str, slowest_mps: float
) -> None:
    """Each position counts once: the error matches the covariance, while the direction is sought and after.

    Two points of a slow object leave its direction uncertain, and the filter stays linearised at a wrong one.
    """
    motion, num, nees = CTRV(), 300, np.zeros((300, 6))
    for run in range(num):
        rng = np.random.default_rng([7, run])
        x = np.array(
            [
                0.0,
                0.0,
                rng.uniform(-np.pi, np.pi),
                slowest_mps * rng.uniform(1.0, 3.0),
                0.3 * rng.standard_normal(),
            ]
        )
        start = Start(
            position_m=STD_M * rng.standard_normal(2),
            position_std_m=STD_M,
            speed_std_mps=150.0,
        )
        estimator = fgtrack.estimator("ekf-replay", motion, start, initiation=method)
        for k in range(1, 7):
            x = draw_states(motion, x, 0.05, rng)
            estimator.update(
                position(k, *(x[:2] + STD_M * rng.standard_normal(2)).tolist())
            )
            state = estimator.state_at(k * PERIOD_NS)
            off = state.mean - x
            off[YAW] = wrap_angle(off[YAW])
            nees[run, k - 1] = off @ np.linalg.solve(state.covariance, off)
    # with one fix more than the start the direction may be any: no Gaussian, and not asked for here
    low, high = chi2.ppf([0.001, 0.999], 5 * num) / num
    assert (
        (low < nees[:, 2:].mean(axis=0)) & (nees[:, 2:].mean(axis=0) < high)
    ).all(), nees.mean(axis=0)


def test_what_is_known_of_the_speed_is_used_once() -> None:
    """A speed that is known well is not drowned by two fixes close together, and gets no better by the line."""
    start = Start(position_std_m=STD_M, speed_mps=20.0, speed_std_mps=1.0)
    state = fed("regression", positions(2.0, 2, speed_mps=20.0), start).state_at(
        2 * PERIOD_NS
    )
    assert abs(state.mean[3] - 20.0) < 1.5
    assert 0.9 < np.sqrt(state.covariance[3, 3]) < 1.05


def test_an_unknown_method_is_refused_with_the_known_ones() -> None:
    for name in ("ekf-replay", "smoother"):
        with pytest.raises(
            fgtrack.CallError,
            match=r"initiation: must be one-point, two-point, regression, is 'three",
        ):
            fgtrack.estimator(name, CTRV(), START, initiation="three-point")


@pytest.mark.parametrize("method", METHODS)
def test_the_order_of_arrival_does_not_matter(method: str) -> None:
    """A late fix that is older than the others changes the line, so all that came of it is computed again."""
    measurements = positions(2.0, 4, 2.0)
    measurements.insert(
        2, Measurement.of(2 * PERIOD_NS, bearing_rad=1.5, std={"bearing_rad": 0.2})
    )
    expected = states(fed(method, measurements), 4)
    for order in list(permutations(measurements))[::11]:
        np.testing.assert_array_equal(states(fed(method, order), 4), expected)
