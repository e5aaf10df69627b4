"""The out-of-sequence methods: which are exact when, and what the others forget or assume."""

import inspect
import itertools
import pickle

import numpy as np
import pytest
from support.oosm import (
    ANY_LAG,
    FUSING,
    LAG_S,
    LINEAR,
    MOTIONS,
    NUM_STEPS,
    ONE_LAG,
    START_NS,
    STEP_S,
    assert_same,
    fed,
    in_sequence,
    last,
    late,
    measured,
    prior,
    replayed,
    stamp,
    started,
)

from fgtrack.core.errors import CallError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.oosm.buffers import DelayedHorizon, ReorderBuffer
from fgtrack.estimation.oosm.crossing import A1
from fgtrack.estimation.oosm.late import CovarianceIntersection
from fgtrack.estimation.registry import estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV
from fgtrack.testing.references import dense_joint


@pytest.mark.parametrize("part", [0.0, 1e-8, 0.3, 0.999999])
@pytest.mark.parametrize(
    ("name", "lag"),
    [
        *((name, 1) for name in ONE_LAG),
        *itertools.product(ANY_LAG, [2, 3, 10, NUM_STEPS]),
    ],
)
def test_an_exact_method_gives_the_answer_of_the_time_order_after_one_late_measurement(
    name: str, lag: int, part: float
) -> None:
    rng = np.random.default_rng(lag)
    measurements = [*in_sequence(rng), late(rng, lag, part)]
    estimator = fed(started(name), measurements)
    assert_same(last(estimator), last(replayed(measurements)))


@pytest.mark.parametrize("name", ANY_LAG)
def test_an_exact_method_stays_exact_when_the_next_late_measurement_is_newer_than_the_step_that_fused_the_last(
    name: str,
) -> None:
    rng = np.random.default_rng(2)
    steps = in_sequence(rng)
    measurements = [
        *steps[:10],
        measured(rng, 0.63),
        *steps[10:],
        measured(rng, 1.37),
        measured(rng, 2.05),
    ]
    estimator = fed(started(name), measurements)
    assert_same(
        estimator.state_at(stamp(2.2)), replayed(measurements).state_at(stamp(2.2))
    )


@pytest.mark.parametrize("name", ["c", "rts", "zlz"])
def test_without_process_noise_nothing_is_lost_by_any_number_of_late_measurements(
    name: str,
) -> None:
    motion, rng = CV(velocity_density_m2ps3=0.0), np.random.default_rng(5)
    measurements = [
        *in_sequence(rng, motion),
        late(rng, 5),
        late(rng, 9),
        late(rng, 1),
        late(rng, 5),
    ]
    estimator = fed(started(name, motion), measurements)
    assert_same(last(estimator), last(replayed(measurements, motion)))


@pytest.mark.parametrize("lag", [1, 3, 10])
def test_al1_and_fpfd_are_the_same_also_for_a_second_late_measurement(lag: int) -> None:
    rng = np.random.default_rng(lag)
    measurements = [*in_sequence(rng), late(rng, lag), late(rng, lag + 2)]
    for count in (1, 2):
        arrived = measurements[: NUM_STEPS + count]
        assert_same(
            last(fed(started("al1"), arrived)), last(fed(started("fpfd"), arrived))
        )


def test_a1_fails_rather_than_give_a_covariance_that_is_none() -> None:
    rng = np.random.default_rng(10)
    estimator = A1(LINEAR, prior(), LAG_S)
    before = last(fed(estimator, in_sequence(rng)))
    assert estimator.update(late(rng, 10)).status is UpdateStatus.FAILED
    np.testing.assert_array_equal(last(estimator).mean, before.mean)
    np.testing.assert_array_equal(last(estimator).covariance, before.covariance)


@pytest.mark.parametrize("lag", [1, 3, 10])
def test_backward_forward_forgets_what_came_between(lag: int) -> None:
    rng = np.random.default_rng(lag)
    steps, more = in_sequence(rng), late(rng, lag)
    kept = [m for m in steps if m.stamp_ns <= more.stamp_ns]
    estimator = fed(started("rewind-forget"), [*steps, more])
    assert_same(
        last(estimator),
        dense_joint(LINEAR, prior(), [*kept, more], [stamp(2.0)])[stamp(2.0)],
    )
    assert estimator.window_ns[1] == stamp(2.0)
    between = measured(rng, 1.995)
    assert estimator.update(between).status is UpdateStatus.OUT_OF_SEQUENCE
    assert_same(last(estimator), last(replayed([*kept, more, between])))


@pytest.mark.parametrize("lag", [1, 3, 10])
def test_larsen_carries_the_late_correction_through_the_gains_of_the_steps_since(
    lag: int,
) -> None:
    rng = np.random.default_rng(lag)
    steps, more = in_sequence(rng), late(rng, lag)
    filtered = replayed(steps)
    at_tau = filtered.state_at(more.stamp_ns)
    H = more.model.selection(4)
    K = np.linalg.solve(H @ at_tau.covariance @ H.T + more.R, H @ at_tau.covariance).T
    shift, lost = K @ (more.z - H @ at_tau.mean), K @ H @ at_tau.covariance
    now_ns = more.stamp_ns
    for step in steps[NUM_STEPS - lag :]:
        F = LINEAR.jacobian(np.zeros(4), (step.stamp_ns - now_ns) / NS_PER_S)
        P = (
            replayed([m for m in steps if m.stamp_ns < step.stamp_ns])
            .state_at(step.stamp_ns)
            .covariance
        )
        carried = F - np.linalg.solve(H @ P @ H.T + step.R, H @ P).T @ H @ F
        shift, lost, now_ns = carried @ shift, carried @ lost @ carried.T, step.stamp_ns
    expected = last(filtered)
    found = last(fed(started("larsen"), [*steps, more]))
    assert_same(
        found,
        TrackState(found.stamp_ns, expected.mean + shift, expected.covariance - lost),
    )


def test_the_delayed_horizon_is_the_replay_up_to_the_horizon_and_prediction_after() -> (
    None
):
    rng = np.random.default_rng(9)
    steps = in_sequence(rng)
    estimator = fed(DelayedHorizon(LINEAR, prior(), LAG_S, 0.35), steps)
    estimator.advance(stamp(2.1))
    assert estimator.update(measured(rng, 1.7)).status is UpdateStatus.TOO_OLD
    in_time = measured(rng, 1.76, std=0.1)
    assert estimator.update(in_time).status is UpdateStatus.OUT_OF_SEQUENCE
    assert_same(
        estimator.state_at(stamp(2.1)), replayed(steps[:17]).state_at(stamp(2.1))
    )
    estimator.advance(stamp(2.2))
    assert_same(
        estimator.state_at(stamp(2.2)),
        replayed([*steps[:18], in_time]).state_at(stamp(2.2)),
    )
    assert_same(estimator.state_at(stamp(1.0)), replayed(steps).state_at(stamp(1.0)))


def test_the_reorder_buffer_is_pushed_by_stamps_and_not_by_the_clock() -> None:
    rng = np.random.default_rng(10)
    steps = in_sequence(rng)
    estimator = fed(ReorderBuffer(LINEAR, prior(), LAG_S, 0.25), steps)
    estimator.advance(stamp(4.0))
    in_time = measured(rng, 1.76, std=0.1)
    assert estimator.update(in_time).status is UpdateStatus.OUT_OF_SEQUENCE
    assert estimator.update(measured(rng, 1.74)).status is UpdateStatus.TOO_OLD
    assert_same(
        estimator.state_at(stamp(4.0)), replayed(steps[:17]).state_at(stamp(4.0))
    )
    newer = measured(rng, 2.02)
    estimator.update(newer)
    assert_same(
        estimator.state_at(stamp(4.0)),
        replayed([*steps[:17], in_time]).state_at(stamp(4.0)),
    )


@pytest.mark.parametrize(
    ("kind", "option"), [(DelayedHorizon, "horizon_s"), (ReorderBuffer, "hold_s")]
)
def test_the_time_that_is_claimed_is_the_default(kind, option: str) -> None:
    assert inspect.signature(kind).parameters[option].default == kind.held_s


@pytest.mark.parametrize("hold_s", [-0.1, 1.1, float("nan")])
@pytest.mark.parametrize("kind", [DelayedHorizon, ReorderBuffer])
def test_measurements_cannot_be_held_longer_than_the_window(
    kind, hold_s: float
) -> None:
    with pytest.raises(CallError, match="give a time from 0 to the window"):
        kind(LINEAR, prior(), 1.0, hold_s)


def test_covariance_intersection_takes_the_estimate_of_the_smaller_trace() -> None:
    rng = np.random.default_rng(3)
    steps, more = (
        [measured(rng, k * STEP_S) for k in range(1, 41)],
        measured(rng, 3.75, std=0.3),
    )
    start = Start(
        stamp_ns=START_NS,
        yaw_rad=None,
        yaw_std_rad=0.0,
        speed_mps=0.0,
        speed_std_mps=10.0,
        yaw_rate_std_radps=0.0,
        accel_std_mps2=0.0,
    )
    found = fed(CovarianceIntersection(LINEAR, start, LAG_S), [*steps, more])
    other = estimator("drop", LINEAR, start, lag_s=LAG_S)
    assert_same(
        found.state_at(stamp(4.0)), fed(other, [*steps, more]).state_at(stamp(4.0))
    )


def test_covariance_intersection_weighs_where_neither_estimate_is_better_in_all() -> (
    None
):
    rng = np.random.default_rng(3)
    model = measurement_model(("x_m",), LINEAR)
    one_axis = [
        Measurement(m.stamp_ns, model, m.z[:1], m.R[:1, :1]) for m in in_sequence(rng)
    ]
    late_y = Measurement(
        stamp(1.85), measurement_model(("y_m",), LINEAR), np.array([20.0]), np.eye(1)
    )
    arrived = [*one_axis, late_y]
    now, found = (
        last(fed(started(name), arrived)).covariance for name in ("drop", "ci")
    )
    late_only = last(fed(started("rewind-forget"), arrived)).covariance

    def mixed(w: float) -> np.ndarray:
        return np.linalg.inv(
            w * np.linalg.inv(now) + (1.0 - w) * np.linalg.inv(late_only)
        )

    weights = np.linspace(0.0, 1.0, 2001)
    best = min(weights, key=lambda w: np.trace(mixed(w)))
    assert 0.01 < best < 0.99
    np.testing.assert_allclose(np.trace(found), np.trace(mixed(best)), rtol=1e-6)
    assert np.trace(found) <= np.trace(mixed(best))


@pytest.mark.parametrize("name", FUSING)
def test_in_a_bend_a_late_measurement_is_worth_as_much_as_in_a_replay(
    name: str,
) -> None:
    """One lag of one degree of turn: linearisation costs little, so what is exact in a linear model is close."""
    motion, rng = MOTIONS["ctra"], np.random.default_rng(12)
    measurements = [*in_sequence(rng, motion), late(rng, 1, motion=motion)]
    estimator, reference = (
        fed(started(name, motion), measurements),
        replayed(measurements, motion),
    )
    expected, found = last(reference), last(estimator)
    apart = np.abs(found.mean - expected.mean) / np.sqrt(np.diag(expected.covariance))
    close = apart.max() < 0.05
    assert close == (name in (*ONE_LAG, "b1", "bl1", "c"))


@pytest.mark.parametrize("name", FUSING)
def test_only_the_window_is_remembered(name: str) -> None:
    rng = np.random.default_rng(18)
    estimator = started(name, lag_s=0.5)
    sizes = []
    for k in range(1, 100):
        fed(estimator, [measured(rng, k * STEP_S), measured(rng, (k - 1.7) * STEP_S)])
        sizes.append(len(pickle.dumps(estimator)))
    assert max(sizes[50:]) <= max(sizes[15:50])
