import math
from dataclasses import replace

import numpy as np
import pytest
from support.tracking import START_NS, ms

from fgtrack.config.settings import EgoConfig
from fgtrack.core.types import EgoState
from fgtrack.models.dead_reckoning import (
    PositionEstimate,
    ReportedErrors,
    estimate_position,
)
from fgtrack.tracking.ego.trajectory import EgoStd, EgoTrajectory

ERRORS = ReportedErrors(0.5**2, 20.0, 0.03**2)
VELOCITY_MPS = 12.0, -5.0


def drive(
    reported_m, errors: ReportedErrors = ERRORS, velocity_mps=VELOCITY_MPS
) -> list[PositionEstimate]:
    """Estimates from positions reported ten times a second."""
    estimates: list[PositionEstimate] = []
    for k, position_m in enumerate(np.asarray(reported_m).tolist()):
        last = estimates[-1] if estimates else None
        estimates.append(
            estimate_position(
                last, START_NS + ms(100 * k), tuple(position_m), velocity_mps, errors
            )
        )
    return estimates


def straight(count: int) -> np.ndarray:
    return 0.1 * np.arange(count)[:, None] * VELOCITY_MPS


def test_the_estimate_is_that_of_a_kalman_filter_of_position_and_error():
    rng = np.random.default_rng(7)
    reported_m = straight(40) + np.cumsum(0.02 * rng.standard_normal((40, 2)), axis=0)
    (s2, time_s, q), r = ERRORS, 0.05**2
    F = np.diag([1.0, math.exp(-0.1 / time_s)])
    Q = np.diag([q * 0.1, s2 * (1.0 - F[1, 1] ** 2)])
    x, P, H = (
        np.array([reported_m[0], [0.0, 0.0]]),
        np.array([[s2 + r, -s2], [-s2, s2]]),
        np.ones((1, 2)),
    )
    for z, estimate in zip(reported_m[1:], drive(reported_m)[1:], strict=True):
        x, P = F @ x + [[0.1 * v for v in VELOCITY_MPS], [0.0, 0.0]], F @ P @ F.T + Q
        K = P @ H.T / (H @ P @ H.T + r)
        x, P = x + K @ (z - H @ x), P - K @ H @ P
        np.testing.assert_allclose(
            [estimate.position_m, estimate.error_m], x, atol=1e-9
        )
        np.testing.assert_allclose(
            estimate.covariance, P[[0, 0, 1], [0, 1, 1]], atol=1e-12
        )


def test_a_step_of_the_reported_position_is_no_step_of_the_vehicle():
    reported_m = straight(60)
    reported_m[30:] += [0.58, 0.0]
    off_m = np.array([each.position_m for each in drive(reported_m)]) - straight(60)
    assert np.abs(off_m[:31]).max() < 0.02
    assert np.abs(off_m).max() < 0.15
    assert drive(reported_m)[-1].error_m[0] > 0.4


@pytest.mark.parametrize("share", [0.5, 0.0])
def test_a_wrong_velocity_gives_a_steady_offset_of_at_most_three_standard_deviations(
    share,
):
    velocity_mps = tuple(share * v for v in VELOCITY_MPS)
    estimates = drive(straight(300), velocity_mps=velocity_mps)
    off_m = np.array([each.position_m for each in estimates]) - straight(300)
    assert np.linalg.norm(off_m, axis=1).max() <= 1.5
    np.testing.assert_allclose(off_m[100:], off_m[-1:].repeat(200, axis=0), atol=0.01)


@pytest.mark.parametrize(("moved_m", "gap_ms"), [(50.0, 100), (50.0, 60_000)])
def test_a_vehicle_that_was_moved_is_three_standard_deviations_off_at_first(
    moved_m, gap_ms
):
    last = drive(straight(20))[-1]
    reported_m = (
        last.position_m[0] + 0.001 * gap_ms * VELOCITY_MPS[0] + moved_m,
        last.position_m[1],
    )
    estimates = [
        estimate_position(
            last, last.stamp_ns + ms(gap_ms), reported_m, (0.0, 0.0), ERRORS
        )
    ]
    for _ in range(600):
        estimates.append(
            estimate_position(
                estimates[-1],
                estimates[-1].stamp_ns + ms(100),
                reported_m,
                (0.0, 0.0),
                ERRORS,
            )
        )
    off_m = [math.dist(each.position_m, reported_m) for each in estimates]
    assert 0.5 < off_m[0] <= 1.5
    assert off_m[-1] < 0.5 * off_m[0]


def test_an_estimate_that_is_not_finite_ends_with_the_position_that_was_not():
    lost = estimate_position(
        drive(straight(20))[-1],
        START_NS + ms(2000),
        (math.nan, 0.0),
        VELOCITY_MPS,
        ERRORS,
    )
    after = estimate_position(
        lost, START_NS + ms(2100), (7.0, 8.0), VELOCITY_MPS, ERRORS
    )
    assert (after.position_m, after.error_m) == ((7.0, 8.0), (0.0, 0.0))


def ego(k: int, off_m: float = 0.0, **more) -> EgoState:
    stamp_ns = START_NS + ms(100 * k)
    return EgoState(stamp_ns, stamp_ns, 1.0 * k + off_m, 0.0, 0.0, 10.0, **more)


def fused(states) -> EgoTrajectory:
    source = EgoTrajectory(
        1.0, 1.0, EgoStd(position_m=0.5, speed_mps=0.03), position_time_s=20.0
    )
    for state in states:
        assert source.receive(state) is None
    return source


def wandering() -> list[EgoState]:
    return [ego(k, 0.3 * math.sin(0.2 * k)) for k in range(50)]


def test_poses_wander_less_than_the_reported_positions():
    source = fused(wandering())
    off_m = [
        source.pose_at(state.stamp_ns, state.stamp_ns).x_m - k
        for k, state in enumerate(wandering())
    ]
    assert np.ptp(off_m) < 0.5 * 0.6
    assert source.current.x_m == pytest.approx(49.0 + off_m[-1])
    assert source.located(wandering()[20]).x_m == pytest.approx(20.0 + off_m[20])


def test_a_late_ego_state_gives_the_poses_that_it_gives_in_time():
    states = wandering()
    late = [*states[:20], *states[21:25], states[20], *states[25:]]
    prompt, delayed = fused(states), fused(late)
    for k in range(50):
        ours, others = (
            each.pose_at(states[k].stamp_ns, 0) for each in (delayed, prompt)
        )
        assert ours[:5] == pytest.approx(others[:5], abs=1e-12)
        np.testing.assert_allclose(ours.covariance, others.covariance)


def test_the_variance_of_a_pose_is_that_of_a_dead_reckoning_of_one_second():
    P = fused(wandering()).pose_at(START_NS + ms(4000), 0).covariance
    np.testing.assert_allclose(np.diag(P)[:4], [0.03**2, 0.03**2, 0.0, 0.03**2])
    given = tuple(np.diag([0.09, 0.09, 1e-4, 0.04, 0.01]).ravel().tolist())
    P = (
        fused([replace(state, covariance=given) for state in wandering()])
        .pose_at(START_NS + ms(4000), 0)
        .covariance
    )
    np.testing.assert_allclose(np.diag(P), [0.05, 0.05, 1e-4, 0.04, 0.01], rtol=1e-9)


def test_old_states_are_forgotten():
    source = fused(ego(k) for k in range(300))
    assert len(source._reckoned) == len(source._states) < 130


def test_without_a_correlation_time_poses_are_as_reported():
    source = EgoTrajectory(1.0, 1.0, EgoStd(position_m=0.5, speed_mps=0.05))
    for state in wandering():
        source.receive(state)
        assert source.located(state) is state
        assert source.pose_at(state.stamp_ns, 0).x_m == state.x_m


def test_ego_states_whose_uncertainty_is_ignored_cannot_be_fused():
    with pytest.raises(
        ValueError,
        match="uncertainty: must be `independent` if position_time_s is set, is none",
    ):
        EgoConfig(uncertainty="none", position_time_s=60.0)
