"""The out-of-sequence methods: which are exact when, what they forget, and what every estimator promises."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest

from fgtrack.core.errors import CallError
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import TrackState
from fgtrack.estimation.base import BirthPrior, Estimator, Measurement, UpdateStatus
from fgtrack.estimation.dense_joint import dense_joint
from fgtrack.estimation.oosm import (
    A1,
    OOSM_METHODS,
    CovarianceIntersection,
    DelayedHorizon,
    ReorderBuffer,
    determinant,
    trace,
)
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel

START_NS = 1_790_000_000_000_000_000
LAG_S = 5.0
STEP_S = 0.1
NUM_STEPS = 20
LINEAR = CV(velocity_density_m2ps3=5.0)
MOTIONS = {"cv": LINEAR, "ctrv": CTRV(), "ctra": CTRA()}

ANY_LAG = ("rts", "zlz", "asd")
ONE_LAG = (*ANY_LAG, "a1", "al1", "fpfd")
IGNORING = ("drop",)
HOLDING = ("delayed-horizon", "reorder-buffer")
FUSING = tuple(name for name in OOSM_METHODS if name not in (*IGNORING, *HOLDING))


def stamp(at_s: float) -> int:
    return START_NS + nanoseconds(at_s)


def prior(yaw_rad: float = 0.4) -> BirthPrior:
    position = np.array([3.0, -2.0])
    return BirthPrior(START_NS, position, np.diag([0.5, 0.5]), yaw_rad, 0.3, 20.0, 3.0, 0.1, 0.3, 0.0, 1.0)


def started(name: str, motion: MotionModel = LINEAR, lag_s: float = LAG_S) -> Estimator:
    return OOSM_METHODS[name].start(motion, prior(), lag_s)


def measured(
    rng: np.random.Generator, at_s: float, motion: MotionModel = LINEAR, std: float = 1.0, speed: bool = False
) -> Measurement:
    truth = {"x_m": 3.0 + 20.0 * at_s * np.cos(0.4), "y_m": -2.0 + 20.0 * at_s * np.sin(0.4), "speed_mps": 20.0}
    names = tuple(truth) if speed else ("x_m", "y_m")
    z = np.array([truth[name] for name in names]) + std * rng.standard_normal(len(names))
    return Measurement(stamp(at_s), measurement_model(names, motion), z, std**2 * np.eye(len(names)))


def in_sequence(rng: np.random.Generator, motion: MotionModel = LINEAR) -> list[Measurement]:
    return [measured(rng, k * STEP_S, motion) for k in range(1, NUM_STEPS + 1)]


def late(rng: np.random.Generator, lag: int, part: float = 0.3, motion: MotionModel = LINEAR) -> Measurement:
    """Between the steps `lag` and `lag - 1` before the last one."""
    return measured(rng, (NUM_STEPS - lag + part) * STEP_S, motion, 0.3)


def fed(estimator: Estimator, measurements: Sequence[Measurement]) -> Estimator:
    for measurement in measurements:
        estimator.update(measurement)
    return estimator


def replayed(measurements: Sequence[Measurement], motion: MotionModel = LINEAR) -> Estimator:
    return fed(ReplayEkf(motion, prior(), LAG_S), measurements)


def assert_same(found: TrackState, expected: TrackState, tolerance: float = 1e-9) -> None:
    scale = np.sqrt(np.diag(expected.covariance))
    np.testing.assert_allclose((found.mean - expected.mean) / scale, 0.0, atol=tolerance)
    difference = (found.covariance - expected.covariance) / np.outer(scale, scale)
    np.testing.assert_allclose(difference, 0.0, atol=tolerance)


def last(estimator: Estimator) -> TrackState:
    return estimator.state_at(stamp(NUM_STEPS * STEP_S))


@pytest.mark.parametrize("part", [0.0, 1e-8, 0.3, 0.999999])
@pytest.mark.parametrize(
    ("name", "lag"), [*((name, 1) for name in ONE_LAG), *itertools.product(ANY_LAG, [2, 3, 10, NUM_STEPS])]
)
def test_an_exact_method_gives_the_answer_of_the_time_order_after_one_late_measurement(
    name: str, lag: int, part: float
) -> None:
    rng = np.random.default_rng(lag)
    measurements = [*in_sequence(rng), late(rng, lag, part)]
    estimator = fed(started(name), measurements)
    assert_same(last(estimator), last(replayed(measurements)))


@pytest.mark.parametrize("name", sorted(set(FUSING) - set(ANY_LAG)))
def test_the_other_methods_do_not_at_ten_lags(name: str) -> None:
    rng = np.random.default_rng(10)
    measurements = [*in_sequence(rng), late(rng, 10)]
    with pytest.raises(AssertionError):
        assert_same(last(fed(started(name), measurements)), last(replayed(measurements)))


@pytest.mark.parametrize("name", ANY_LAG)
def test_an_exact_method_stays_exact_when_the_next_late_measurement_is_newer_than_the_step_that_fused_the_last(
    name: str,
) -> None:
    rng = np.random.default_rng(2)
    steps = in_sequence(rng)
    measurements = [*steps[:10], measured(rng, 0.63), *steps[10:], measured(rng, 1.37), measured(rng, 2.05)]
    estimator = fed(started(name), measurements)
    assert_same(estimator.state_at(stamp(2.2)), replayed(measurements).state_at(stamp(2.2)))


@pytest.mark.parametrize("seed", range(10))
def test_the_accumulated_density_gives_the_answer_of_the_time_order_for_any_arrival(seed: int) -> None:
    rng = np.random.default_rng(seed)
    stamps_s = np.round(rng.uniform(0.001, 2.0, 15), 6)
    several = [measured(rng, at_s) for at_s in [*stamps_s, *stamps_s[:3], *(stamps_s[3:6] + 1e-6)]]
    order = [several[i] for i in rng.permutation(len(several))]
    assert_same(last(fed(started("asd"), order)), last(replayed(order)))


def test_the_accumulated_density_knows_the_smoothed_past() -> None:
    rng = np.random.default_rng(3)
    measurements = [*in_sequence(rng), late(rng, 4), late(rng, 7)]
    estimator = fed(started("asd"), measurements)
    stamps_ns = [stamp(at_s) for at_s in (0.0, 0.55, 1.33, 1.5, 2.0, 2.4)]
    for stamp_ns, expected in dense_joint(LINEAR, prior(), measurements, stamps_ns).items():
        assert_same(estimator.state_at(stamp_ns), expected)


def test_what_leaves_the_window_of_the_accumulated_density_stays_in_the_present() -> None:
    rng = np.random.default_rng(4)
    estimator, measurements = started("asd", lag_s=0.45), in_sequence(rng)
    fed(estimator, measurements)
    assert estimator.window_ns == (stamp(1.55), stamp(2.0))
    more = [late(rng, 2), late(rng, 3)]
    fed(estimator, more)
    assert_same(last(estimator), last(replayed([*measurements, *more])))


@pytest.mark.parametrize("name", ["c", "rts", "zlz"])
def test_without_process_noise_nothing_is_lost_by_any_number_of_late_measurements(name: str) -> None:
    motion, rng = CV(velocity_density_m2ps3=0.0), np.random.default_rng(5)
    measurements = [*in_sequence(rng, motion), late(rng, 5), late(rng, 9), late(rng, 1), late(rng, 5)]
    estimator = fed(started(name, motion), measurements)
    assert_same(last(estimator), last(replayed(measurements, motion)))


@pytest.mark.parametrize("lag", [1, 3, 10])
def test_al1_and_fpfd_are_the_same_also_for_a_second_late_measurement(lag: int) -> None:
    rng = np.random.default_rng(lag)
    measurements = [*in_sequence(rng), late(rng, lag), late(rng, lag + 2)]
    for count in (1, 2):
        arrived = measurements[: NUM_STEPS + count]
        assert_same(last(fed(started("al1"), arrived)), last(fed(started("fpfd"), arrived)))


def test_at_one_lag_several_lags_in_one_step_are_the_algorithms_for_one() -> None:
    rng = np.random.default_rng(1)
    measurements = [*in_sequence(rng), late(rng, 1)]
    assert_same(last(fed(started("a1"), measurements)), last(fed(started("al1"), measurements)))
    assert_same(last(fed(started("b1"), measurements)), last(fed(started("bl1"), measurements)))


@pytest.mark.parametrize("name", ["a1", "al1", "fpfd"])
def test_two_measurements_of_the_newest_stamp_are_one_lag(name: str) -> None:
    rng = np.random.default_rng(6)
    measurements = [*in_sequence(rng), measured(rng, NUM_STEPS * STEP_S, std=0.5), late(rng, 1)]
    assert_same(last(fed(started(name), measurements)), last(replayed(measurements)))


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
    estimator = fed(started("backward-forward"), [*steps, more])
    assert_same(last(estimator), dense_joint(LINEAR, prior(), [*kept, more], [stamp(2.0)])[stamp(2.0)])
    assert estimator.window_ns[1] == stamp(2.0)
    between = measured(rng, 1.995)
    assert estimator.update(between).status is UpdateStatus.OUT_OF_SEQUENCE
    assert_same(last(estimator), last(replayed([*kept, more, between])))


def test_drop_ignores_what_is_late() -> None:
    rng = np.random.default_rng(7)
    steps = in_sequence(rng)
    estimator = fed(started("drop"), steps)
    assert estimator.update(late(rng, 2)).status is UpdateStatus.TOO_OLD
    assert_same(last(estimator), last(replayed(steps)))


def test_as_current_takes_a_late_measurement_at_the_newest_stamp() -> None:
    rng = np.random.default_rng(8)
    steps, more = in_sequence(rng), late(rng, 2)
    estimator = fed(started("as-current"), steps)
    assert estimator.update(more).status is UpdateStatus.OUT_OF_SEQUENCE
    moved = Measurement(stamp(2.0), more.model, more.z, more.R)
    assert_same(last(estimator), last(replayed([*steps, moved])))


def test_the_delayed_horizon_is_the_replay_up_to_the_horizon_and_prediction_after() -> None:
    rng = np.random.default_rng(9)
    steps = in_sequence(rng)
    estimator = fed(DelayedHorizon(LINEAR, prior(), LAG_S, 0.35), steps)
    estimator.advance(stamp(2.1))
    assert estimator.update(measured(rng, 1.7)).status is UpdateStatus.TOO_OLD
    in_time = measured(rng, 1.76, std=0.1)
    assert estimator.update(in_time).status is UpdateStatus.OUT_OF_SEQUENCE
    assert_same(estimator.state_at(stamp(2.1)), replayed(steps[:17]).state_at(stamp(2.1)))
    estimator.advance(stamp(2.2))
    assert_same(estimator.state_at(stamp(2.2)), replayed([*steps[:18], in_time]).state_at(stamp(2.2)))
    assert_same(estimator.state_at(stamp(1.0)), replayed(steps).state_at(stamp(1.0)))


def test_the_reorder_buffer_is_pushed_by_stamps_and_not_by_the_clock() -> None:
    rng = np.random.default_rng(10)
    steps = in_sequence(rng)
    estimator = fed(ReorderBuffer(LINEAR, prior(), LAG_S, 0.25), steps)
    estimator.advance(stamp(4.0))
    in_time = measured(rng, 1.76, std=0.1)
    assert estimator.update(in_time).status is UpdateStatus.OUT_OF_SEQUENCE
    assert estimator.update(measured(rng, 1.74)).status is UpdateStatus.TOO_OLD
    assert_same(estimator.state_at(stamp(4.0)), replayed(steps[:17]).state_at(stamp(4.0)))
    newer = measured(rng, 2.02)
    estimator.update(newer)
    assert_same(estimator.state_at(stamp(4.0)), replayed([*steps[:17], in_time]).state_at(stamp(4.0)))


@pytest.mark.parametrize("hold_s", [-0.1, 1.1, float("nan")])
@pytest.mark.parametrize("kind", [DelayedHorizon, ReorderBuffer])
def test_measurements_cannot_be_held_longer_than_the_window(kind, hold_s: float) -> None:
    with pytest.raises(CallError, match="give a time from 0 to the window"):
        kind(LINEAR, prior(), 1.0, hold_s)


@pytest.mark.parametrize(("size", "takes_late"), [(trace, False), (determinant, True)])
def test_covariance_intersection_makes_small_what_it_is_told_to(size, takes_late: bool) -> None:
    rng = np.random.default_rng(3)
    steps, more = [measured(rng, k * STEP_S) for k in range(1, 41)], measured(rng, 3.75, std=0.3)
    start = BirthPrior(START_NS, np.zeros(2), np.eye(2), None, 0.0, 0.0, 10.0, 0.0, 0.0, 0.0, 0.0)
    estimator = fed(CovarianceIntersection(LINEAR, start, LAG_S, size), [*steps, more])
    other = OOSM_METHODS["backward-forward" if takes_late else "drop"].start(LINEAR, start, LAG_S)
    assert_same(estimator.state_at(stamp(4.0)), fed(other, [*steps, more]).state_at(stamp(4.0)))


def test_covariance_intersection_weighs_where_neither_estimate_is_better_in_all() -> None:
    rng = np.random.default_rng(3)
    model = measurement_model(("x_m",), LINEAR)
    one_axis = [Measurement(m.stamp_ns, model, m.z[:1], m.R[:1, :1]) for m in in_sequence(rng)]
    late_y = Measurement(stamp(1.85), measurement_model(("y_m",), LINEAR), np.array([20.0]), np.eye(1))
    arrived = [*one_axis, late_y]
    now, found = (last(fed(started(name), arrived)).covariance for name in ("drop", "ci"))
    late_only = last(fed(started("backward-forward"), arrived)).covariance

    def mixed(w: float) -> np.ndarray:
        return np.linalg.inv(w * np.linalg.inv(now) + (1.0 - w) * np.linalg.inv(late_only))

    weights = np.linspace(0.0, 1.0, 2001)
    best = min(weights, key=lambda w: np.trace(mixed(w)))
    assert 0.01 < best < 0.99
    np.testing.assert_allclose(np.trace(found), np.trace(mixed(best)), rtol=1e-6)
    assert np.trace(found) <= np.trace(mixed(best))


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", OOSM_METHODS)
def test_in_sequence_every_method_is_the_ekf(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(11)
    measurements = in_sequence(rng, motion)
    estimator = started(name, motion)
    for measurement in measurements:
        result = estimator.update(measurement)
        assert result.status is UpdateStatus.IN_SEQUENCE
        assert result.nis is not None
    at_s = 1.5 if name in HOLDING else 2.0
    if name == "asd":  # its states before the present are smoothed
        at_s = 2.3
    assert_same(estimator.state_at(stamp(at_s)), replayed(measurements, motion).state_at(stamp(at_s)))


@pytest.mark.parametrize("kind", ["ctrv", "ctra"])
@pytest.mark.parametrize("name", FUSING)
def test_in_a_bend_a_late_measurement_is_worth_as_much_as_in_a_replay(name: str, kind: str) -> None:
    """One lag of one degree of turn: linearisation costs little, so what is exact in a linear model is close."""
    motion, rng = MOTIONS[kind], np.random.default_rng(12)
    measurements = [*in_sequence(rng, motion), late(rng, 1, motion=motion)]
    estimator, reference = fed(started(name, motion), measurements), replayed(measurements, motion)
    expected, found = last(reference), last(estimator)
    apart = np.abs(found.mean - expected.mean) / np.sqrt(np.diag(expected.covariance))
    close = apart.max() < 0.05
    assert close == (name in (*ONE_LAG, "b1", "bl1", "c"))


@pytest.mark.parametrize("name", FUSING)
def test_a_heading_that_passes_half_a_turn_stays_on_its_branch(name: str) -> None:
    motion, rng = CTRV(), np.random.default_rng(13)
    model = measurement_model(("x_m", "y_m", "yaw_rad"), motion)
    start = prior(yaw_rad=np.pi - 0.12)
    truth = np.array([3.0, -2.0, np.pi - 0.12, 20.0, 0.1])
    items = []
    for at_s in (*np.arange(1, 21) * STEP_S, 1.93, 1.91):
        z = model.predict(motion.predict(truth, at_s)) + 0.02 * rng.standard_normal(3)
        z[2] = (z[2] + np.pi) % (2.0 * np.pi) - np.pi
        items.append(Measurement(stamp(at_s), model, z, 0.02**2 * np.eye(3)))
    estimator = OOSM_METHODS[name].start(motion, start, LAG_S)
    for measurement in items:
        result = estimator.update(measurement)
        assert result.status in (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE)
        if name != "as-current":
            assert result.nis is not None
            assert result.nis < 20.0
    yaw_rad = estimator.state_at(stamp(2.0)).mean[2]
    assert -np.pi < yaw_rad <= np.pi
    assert abs((yaw_rad - truth[2] - 0.2 + np.pi) % (2.0 * np.pi) - np.pi) < 0.1


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", OOSM_METHODS)
def test_a_measurement_older_than_the_window_is_too_old_and_changes_nothing(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(14)
    estimator = fed(started(name, motion, 1.0), in_sequence(rng, motion))
    assert estimator.window_ns == (stamp(1.0), stamp(2.0))
    before = last(estimator)
    assert estimator.update(measured(rng, 1.0 - 1e-9, motion)).status is UpdateStatus.TOO_OLD
    np.testing.assert_array_equal(last(estimator).mean, before.mean)
    estimator.advance(stamp(2.5))
    assert estimator.window_ns == (stamp(1.5), stamp(2.0))
    for at_s in (1.5, 1.77, 2.0, 2.5):
        assert np.isfinite(estimator.state_at(stamp(at_s)).mean).all()


def shuffled(rng: np.random.Generator, motion: MotionModel) -> list[Measurement]:
    """About half of them come up to 8 places late; some share a stamp or are 1 us apart."""
    stamps_s = np.arange(1, 41) * 0.05
    items = [measured(rng, at_s, motion, speed=not motion.linear and k % 2 == 0) for k, at_s in enumerate(stamps_s)]
    items += [measured(rng, stamps_s[k], motion) for k in (5, 17)] + [measured(rng, stamps_s[9] + 1e-6, motion)]
    made_s = np.array([(m.stamp_ns - START_NS) / NS_PER_S for m in items])
    late_s = 0.05 * rng.integers(0, 9, len(items)) * rng.integers(0, 2, len(items))
    return [items[i] for i in np.argsort(made_s + late_s)]


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", OOSM_METHODS)
def test_covariances_are_symmetric_and_positive_definite_and_the_same_input_gives_the_same_bits(
    name: str, kind: str
) -> None:
    motion = MOTIONS[kind]
    for seed in range(3):
        items = shuffled(np.random.default_rng([15, seed]), motion)
        one, other = started(name, motion), started(name, motion)
        fused = 0
        for measurement in items:
            z, R = measurement.z.copy(), measurement.R.copy()
            result = one.update(measurement)
            np.testing.assert_array_equal(measurement.z, z)
            np.testing.assert_array_equal(measurement.R, R)
            assert repr(result) == repr(other.update(measurement))
            taken = result.status in (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE)
            fused += taken
            assert taken == (result.nis is not None) == (result.innovation is not None)
            assert result.nis is None or result.nis >= 0.0
        assert fused > len(items) // 4
        for k in range(45):
            state, again = one.state_at(stamp(k * 0.05)), other.state_at(stamp(k * 0.05))
            np.testing.assert_array_equal(state.covariance, state.covariance.T)
            assert np.linalg.eigvalsh(state.covariance).min() > 0.0
            assert state.mean.tobytes() == again.mean.tobytes()
            assert state.covariance.tobytes() == again.covariance.tobytes()


@pytest.mark.parametrize("broken", ["z", "R"])
@pytest.mark.parametrize("at_s", [1.95, 2.05])
@pytest.mark.parametrize("name", OOSM_METHODS)
def test_a_measurement_that_cannot_be_fused_fails_and_leaves_the_estimator_usable(
    name: str, at_s: float, broken: str
) -> None:
    motion, rng = CTRV(), np.random.default_rng(16)
    estimator = fed(started(name, motion), in_sequence(rng, motion))
    before = estimator.state_at(stamp(2.2))
    z, R = np.array([np.nan if broken == "z" else 0.0, 0.0]), np.diag([np.nan if broken == "R" else 1.0, 1.0])
    bad = Measurement(stamp(at_s), measurement_model(("x_m", "y_m"), motion), z, R)
    ignored = name in IGNORING and at_s < 2.0
    assert estimator.update(bad).status is (UpdateStatus.TOO_OLD if ignored else UpdateStatus.FAILED)
    after = estimator.state_at(stamp(2.2))
    np.testing.assert_array_equal(after.mean, before.mean)
    np.testing.assert_array_equal(after.covariance, before.covariance)
    assert estimator.update(measured(rng, 2.1, motion)).status is UpdateStatus.IN_SEQUENCE
