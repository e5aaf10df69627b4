"""The order of arrival inside the window does not matter: against the dense joint, and against the time order."""

import numpy as np
import pytest
from arrivals import MS, US, Arrivals, arrivals, in_time_order, measured, middles
from estimators import MOTIONS, NONLINEAR, SMOOTHERS, START_NS, SUBJECTS, converged, prior, settings
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Estimator, Measurement, UpdateStatus
from fgtrack.estimation.dense_joint import dense_joint, difference
from fgtrack.models.motion import CV, MotionModel

FUSED = (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE)
CONVERGED_BAR = 1e-5
ORDERLY = [name for name, subject in SUBJECTS.items() if subject.nonlinear != "never"]
MORE = 5


def fused(name: str, motion: MotionModel, measurements: list[Measurement]) -> Estimator:
    """An estimator that took all of `measurements`, all inside its window."""
    estimator = SUBJECTS[name].start(motion, settings())
    for measurement in measurements:
        assert estimator.update(measurement).status in FUSED
    return estimator


def expected_states(
    motion: MotionModel, measurements: list[Measurement], stamps_ns: list[int], smooths: bool
) -> dict[int, TrackState]:
    """The dense joint of all measurements; for a filter of those up to each stamp."""
    if smooths:
        return dense_joint(motion, prior(), measurements, stamps_ns)
    known = {stamp_ns: [m for m in measurements if m.stamp_ns <= stamp_ns] for stamp_ns in stamps_ns}
    return {stamp_ns: dense_joint(motion, prior(), known[stamp_ns], [stamp_ns])[stamp_ns] for stamp_ns in stamps_ns}


def check_dense_joint(name: str, case: Arrivals) -> None:
    motion, subject = CV(), SUBJECTS[name]
    measurements = case.measurements(motion)
    estimator = fused(name, motion, measurements)
    newest_ns = max(case.stamps_ns)
    stamps_ns = [START_NS, newest_ns + 100 * MS, *case.stamps_ns, *middles(case.stamps_ns)]
    bar = subject.bar(motion, case.stamps_ns)
    for stamp_ns, expected in expected_states(motion, measurements, stamps_ns, subject.smooths).items():
        assert max(difference(estimator.state_at(stamp_ns), expected)) < bar


def check_time_order(name: str, kind: str, case: Arrivals) -> None:
    motion = MOTIONS[kind]
    measurements = case.measurements(motion)
    in_order, shuffled = fused(name, motion, in_time_order(measurements)), fused(name, motion, measurements)
    bar = 1e-9
    if SUBJECTS[name].nonlinear == "at convergence":
        in_order, shuffled, bar = converged(in_order), converged(shuffled), CONVERGED_BAR
    newest_ns = max(case.stamps_ns)
    for stamp_ns in (START_NS, newest_ns, newest_ns + 100 * MS, START_NS + (newest_ns - START_NS) // 2):
        assert max(difference(shuffled.state_at(stamp_ns), in_order.state_at(stamp_ns))) < bar


@pytest.mark.parametrize("close", [False, True], ids=["apart", "1 us apart"])
@pytest.mark.parametrize("name", SUBJECTS)
def test_in_a_linear_model_any_order_gives_the_dense_joint_at_every_stamp(name: str, close: bool) -> None:
    @given(case=arrivals(close=close))
    @hypothesis_settings(deadline=None, max_examples=SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        check_dense_joint(name, case)

    check()


@pytest.mark.parametrize("kind", NONLINEAR)
@pytest.mark.parametrize("name", ORDERLY)
def test_in_a_nonlinear_model_any_order_gives_the_answer_of_the_time_order(name: str, kind: str) -> None:
    @given(case=arrivals(close=True))
    @hypothesis_settings(deadline=None, max_examples=SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        check_time_order(name, kind, case)

    check()


@pytest.mark.parametrize("gap_ms", [1422, 1444])
@pytest.mark.parametrize("name", SMOOTHERS)
def test_states_that_whole_steps_swing_about_converge(name: str, gap_ms: int) -> None:
    """Two clusters of positions: the noise of the motion between them follows the state before it, and so on."""
    check_time_order(name, "ctrv", Arrivals((gap_ms * MS, gap_ms * MS + US, 2 * MS, 2 * MS + US), seed=295))


@pytest.mark.slow
@pytest.mark.parametrize("name", SUBJECTS)
def test_any_order_gives_the_dense_joint_for_many_long_streams(name: str) -> None:
    @given(case=arrivals(close=True, max_size=40, min_size=10))
    @hypothesis_settings(deadline=None, max_examples=MORE * SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        check_dense_joint(name, case)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("kind", NONLINEAR)
@pytest.mark.parametrize("name", ORDERLY)
def test_any_order_gives_the_answer_of_the_time_order_for_many_long_streams(name: str, kind: str) -> None:
    @given(case=arrivals(close=True, max_size=40, min_size=10))
    @hypothesis_settings(deadline=None, max_examples=MORE * SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        check_time_order(name, kind, case)

    check()


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
def test_the_status_tells_in_from_out_of_sequence(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(0)
    estimator = SUBJECTS[name].start(motion, settings())
    offsets_ms = (100, 300, 300, 200, 0, 400)
    found = [estimator.update(measured(START_NS + ms * MS, motion, rng)) for ms in offsets_ms]
    inside, late = FUSED
    assert [one.status for one in found] == [inside, inside, inside, late, late, inside]
    assert estimator.window_ns == (START_NS, START_NS + 400 * MS)


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
@pytest.mark.parametrize("offset_ns", [0, 50 * MS, 51 * MS, 130 * MS], ids=["first", "node", "segment", "ahead"])
def test_innovation_and_nis_are_those_of_the_state_before_at_the_measurement_s_own_stamp(
    name: str, kind: str, offset_ns: int
) -> None:
    if offset_ns == 50 * MS and not SUBJECTS[name].smooths:
        pytest.skip("a filter puts measurements of one stamp into an order of its own")
    motion, rng = MOTIONS[kind], np.random.default_rng(1)
    estimator = SUBJECTS[name].start(motion, settings())
    for ms in (50, 100):
        estimator.update(measured(START_NS + ms * MS, motion, rng))
    new = measured(START_NS + offset_ns, motion, rng)
    state = estimator.state_at(new.stamp_ns)
    H = new.model.jacobian(state.mean, new.pose)
    y = new.model.residual(new.z, new.model.predict(state.mean, new.pose))
    found = estimator.update(new)
    np.testing.assert_allclose(found.innovation, y, rtol=0.0, atol=1e-9)
    assert found.nis == pytest.approx(y @ np.linalg.solve(H @ state.covariance @ H.T + new.R, y), rel=1e-9)


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
@given(seed=st.integers(0, 2**31))
@hypothesis_settings(deadline=None, max_examples=3)
def test_covariances_are_symmetric_and_positive_definite_at_every_stamp(name: str, kind: str, seed: int) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(seed)
    estimator = SUBJECTS[name].start(motion, settings(lag_s=0.5))
    for k in rng.permutation(np.arange(1, 25)):
        estimator.update(measured(START_NS + int(k) * 40 * MS, motion, rng))
    start_ns, newest_ns = estimator.window_ns
    for stamp_ns in range(start_ns, newest_ns + 100 * MS, 13 * MS):
        covariance = estimator.state_at(stamp_ns).covariance
        np.testing.assert_array_equal(covariance, covariance.T)
        scale = np.sqrt(np.diag(covariance))
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 0.0


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
def test_the_same_input_gives_the_same_bits(name: str, kind: str) -> None:
    def run() -> bytes:
        motion, rng = MOTIONS[kind], np.random.default_rng(4)
        estimator = SUBJECTS[name].start(motion, settings(lag_s=0.4))
        said = []
        for k in rng.permutation(np.arange(1, 25)):
            said.append(repr(estimator.update(measured(START_NS + int(k) * 40 * MS, motion, rng))))
        states = [estimator.state_at(stamp_ns) for stamp_ns in range(*estimator.window_ns, 9 * MS)]
        return repr(said).encode() + b"".join(s.mean.tobytes() + s.covariance.tobytes() for s in states)

    assert run() == run()


@pytest.mark.parametrize("name", SUBJECTS)
def test_no_input_is_changed_and_no_output_changes_later(name: str) -> None:
    motion, rng = MOTIONS["ctrv"], np.random.default_rng(3)
    estimator = SUBJECTS[name].start(motion, settings())
    measurements = [measured(START_NS + k * 100 * MS, motion, rng) for k in (1, 3, 2, 2)]
    inputs = [(m.z.copy(), m.R.copy()) for m in measurements]
    estimator.update(measurements[0])
    results = [
        (at, at.mean.copy(), at.covariance.copy())
        for at in map(estimator.state_at, range(START_NS, START_NS + 300 * MS, 50 * MS))
    ]
    for measurement in measurements[1:]:
        estimator.update(measurement)
    for measurement, (z, R) in zip(measurements, inputs, strict=True):
        np.testing.assert_array_equal(measurement.z, z)
        np.testing.assert_array_equal(measurement.R, R)
    for state, mean, covariance in results:
        np.testing.assert_array_equal(state.mean, mean)
        np.testing.assert_array_equal(state.covariance, covariance)


@pytest.mark.parametrize("name", SUBJECTS)
def test_the_window_is_as_long_as_it_says(name: str) -> None:
    motion, rng = CV(), np.random.default_rng(0)
    estimator = SUBJECTS[name].start(motion, settings(0.5, "drop"))
    for k in range(1, 12):
        estimator.update(measured(START_NS + k * 100 * MS, motion, rng))
    assert estimator.window_ns == (START_NS + 600 * MS, START_NS + 1100 * MS)
    estimator.advance(START_NS + 1300 * MS)
    assert estimator.window_ns == (START_NS + 800 * MS, START_NS + 1100 * MS)
