"""What every out-of-sequence method promises, in linear and nonlinear models."""

import pickle

import numpy as np
import pytest
from support.oosm import (
    FUSING,
    HOLDING,
    IGNORING,
    LAG_S,
    METHODS,
    MOTIONS,
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

from fgtrack.core.time import NS_PER_S
from fgtrack.estimation.base import Measurement, UpdateStatus
from fgtrack.estimation.registry import estimator
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, MotionModel


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", METHODS)
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
    one = estimator(name, motion, start, lag_s=LAG_S)
    for measurement in items:
        result = one.update(measurement)
        assert result.status in (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE)
        if name != "as-current":
            assert result.nis is not None
            assert result.nis < 20.0
    yaw_rad = one.state_at(stamp(2.0)).mean[2]
    assert -np.pi < yaw_rad <= np.pi
    assert abs((yaw_rad - truth[2] - 0.2 + np.pi) % (2.0 * np.pi) - np.pi) < 0.1


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", METHODS)
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
@pytest.mark.parametrize("name", METHODS)
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
@pytest.mark.parametrize("name", METHODS)
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


@pytest.mark.parametrize("name", FUSING)
def test_only_the_window_is_remembered(name: str) -> None:
    rng = np.random.default_rng(18)
    estimator = started(name, lag_s=0.5)
    sizes = []
    for k in range(1, 200):
        fed(estimator, [measured(rng, k * STEP_S), measured(rng, (k - 1.7) * STEP_S)])
        sizes.append(len(pickle.dumps(estimator)))
    assert max(sizes[100:]) <= max(sizes[20:100])
