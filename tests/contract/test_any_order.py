"""What every exact estimator promises: the order of arrival inside the window does not matter."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fgtrack.core.time import NS_PER_S
from fgtrack.estimation.base import BirthPrior, Estimator, Measurement, UpdateStatus
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel

LAG_S = 2.0
START_NS = 1_790_000_000_000_000_000


def prior() -> BirthPrior:
    return BirthPrior(START_NS, np.array([3.0, -2.0]), np.diag([0.5, 0.5]), 0.4, 0.3, 20.0, 3.0, 0.1, 0.3, 0.0, 1.0)


def replay(motion: MotionModel) -> Estimator:
    return ReplayEkf(motion, prior(), LAG_S)


EXACT: dict[str, Callable[[MotionModel], Estimator]] = {"ekf-replay": replay}
MOTIONS = {"cv": CV(), "ctrv": CTRV(), "ctra": CTRA()}


def measured(stamp_ns: int, motion: MotionModel, rng: np.random.Generator) -> Measurement:
    names = ("x_m", "y_m") if motion.linear or rng.random() < 0.5 else ("x_m", "y_m", "speed_mps")
    travelled_m = 20.0 * (stamp_ns - START_NS) / NS_PER_S
    truth = {"x_m": 3.0 + travelled_m * np.cos(0.4), "y_m": -2.0 + travelled_m * np.sin(0.4), "speed_mps": 20.0}
    std = np.full(len(names), 0.5)
    z = np.array([truth[name] for name in names]) + std * rng.standard_normal(len(names))
    return Measurement(stamp_ns, measurement_model(names, motion), z, np.diag(std**2))


@st.composite
def arrivals(draw: st.DrawFn) -> tuple[list[int], list[int], int]:
    """Offsets in ns inside the window (some equal, some 1 us apart), an order of arrival, a seed."""
    offsets = draw(st.lists(st.integers(1_000, int(LAG_S * NS_PER_S) - 1), min_size=2, max_size=10))
    near = [offset + 1_000 for offset in offsets if draw(st.booleans())]
    equal = [offset for offset in offsets if draw(st.integers(0, 3)) == 0]
    everything = [min(offset, int(LAG_S * NS_PER_S) - 1) for offset in offsets + near + equal]
    return everything, draw(st.permutations(range(len(everything)))), draw(st.integers(0, 2**31))


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("kind", MOTIONS)
@given(case=arrivals())
@settings(deadline=None, max_examples=40)
def test_any_order_of_arrival_inside_the_window_gives_the_state_of_the_time_order(name, kind, case):
    offsets, order, seed = case
    motion = MOTIONS[kind]
    rng = np.random.default_rng(seed)
    measurements = [measured(START_NS + offset, motion, rng) for offset in offsets]
    in_order, shuffled = EXACT[name](motion), EXACT[name](motion)
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        assert in_order.update(measurement).status is UpdateStatus.IN_SEQUENCE
    for index in order:
        assert shuffled.update(measurements[index]).status in (
            UpdateStatus.IN_SEQUENCE,
            UpdateStatus.OUT_OF_SEQUENCE,
        )
    newest = max(m.stamp_ns for m in measurements)
    for stamp_ns in (newest, newest + 100_000_000, START_NS + (newest - START_NS) // 2):
        expected, found = in_order.state_at(stamp_ns), shuffled.state_at(stamp_ns)
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("kind", MOTIONS)
def test_a_measurement_older_than_the_window_is_reported_and_changes_nothing(name, kind):
    motion, rng = MOTIONS[kind], np.random.default_rng(0)
    estimator = EXACT[name](motion)
    for k in range(1, 60):
        estimator.update(measured(START_NS + k * 100_000_000, motion, rng))
    start_ns, newest_ns = estimator.window_ns
    assert newest_ns - start_ns == int(LAG_S * NS_PER_S)
    before = estimator.state_at(newest_ns)
    assert estimator.update(measured(start_ns - 1, motion, rng)).status is UpdateStatus.TOO_OLD
    after = estimator.state_at(newest_ns)
    np.testing.assert_array_equal(before.mean, after.mean)
    np.testing.assert_array_equal(before.covariance, after.covariance)
    assert estimator.update(measured(start_ns, motion, rng)).status is UpdateStatus.OUT_OF_SEQUENCE


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("kind", MOTIONS)
def test_covariances_are_symmetric_and_positive_definite_at_every_stamp(name, kind):
    motion, rng = MOTIONS[kind], np.random.default_rng(1)
    estimator = EXACT[name](motion)
    for k in rng.permutation(np.arange(1, 40)):
        estimator.update(measured(START_NS + int(k) * 50_000_000, motion, rng))
    for k in range(45):
        covariance = estimator.state_at(START_NS + k * 50_000_000).covariance
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance).min() > 0.0


@pytest.mark.parametrize("name", EXACT)
def test_a_measurement_that_cannot_be_fused_fails_and_leaves_the_estimator_usable(name):
    motion, rng = CTRV(), np.random.default_rng(2)
    estimator = EXACT[name](motion)
    estimator.update(measured(START_NS + 100_000_000, motion, rng))
    before = estimator.state_at(START_NS + 200_000_000)
    model = measurement_model(("x_m", "y_m"), motion)
    broken = Measurement(START_NS + 50_000_000, model, np.array([np.nan, 0.0]), np.eye(2))
    assert estimator.update(broken).status is UpdateStatus.FAILED
    np.testing.assert_array_equal(estimator.state_at(START_NS + 200_000_000).mean, before.mean)
    good = estimator.update(measured(START_NS + 60_000_000, motion, rng))
    assert good.status is UpdateStatus.OUT_OF_SEQUENCE
    assert good.nis is not None


@pytest.mark.parametrize("name", EXACT)
def test_no_input_is_changed(name):
    motion, rng = CTRV(), np.random.default_rng(3)
    estimator = EXACT[name](motion)
    measurement = measured(START_NS + 100_000_000, motion, rng)
    z, R = measurement.z.copy(), measurement.R.copy()
    estimator.update(measurement)
    np.testing.assert_array_equal(measurement.z, z)
    np.testing.assert_array_equal(measurement.R, R)
