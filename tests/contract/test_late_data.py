"""What lies in the past of a window: late policies, states behind it, and the ones it hands out as final."""

import numpy as np
import pytest
from arrivals import MS, Arrivals, arrivals, in_time_order, measured, middles
from estimators import BACKENDS, MOTIONS, SMOOTHERS, START_NS, SUBJECTS, Late, prior, settings, smoother
from hypothesis import given
from hypothesis import settings as hypothesis_settings

from fgtrack.core.errors import DataError
from fgtrack.estimation.base import Estimator, Measurement, UpdateStatus
from fgtrack.estimation.dense_joint import dense_joint, difference
from fgtrack.estimation.factor_graph import FixedLagSmoother
from fgtrack.models.motion import CV, MotionModel

LAG_S = 0.3
MORE = 5


def started(name: str, motion: MotionModel, late: Late = "fuse", lag_s: float = LAG_S) -> FixedLagSmoother:
    return smoother(motion, settings(lag_s, late), BACKENDS[name])


def everything(estimator: Estimator, stamps_ns: list[int]) -> list[bytes]:
    states = [estimator.state_at(stamp_ns) for stamp_ns in stamps_ns]
    return [state.mean.tobytes() + state.covariance.tobytes() for state in states]


def check_accepted(name: str, case: Arrivals, late: Late, ring_s: float) -> None:
    """Whatever was accepted is in the answer, exactly, and nothing else."""
    motion, subject = CV(), SUBJECTS[name]
    estimator = subject.start(motion, settings(LAG_S, late, ring_s))
    accepted: list[Measurement] = []
    bar = subject.bar(motion, case.stamps_ns)
    for measurement in case.measurements(motion):
        start_ns = estimator.window_ns[0]
        status = estimator.update(measurement).status
        assert (status == UpdateStatus.TOO_OLD) == (measurement.stamp_ns < start_ns)
        if status != UpdateStatus.TOO_OLD:
            accepted.append(measurement)
    start_ns, newest_ns = estimator.window_ns
    stamps_ns = [newest_ns, newest_ns + 100 * MS]
    if subject.smooths:
        nodes_ns = [m.stamp_ns for m in accepted]
        stamps_ns += [stamp_ns for stamp_ns in (start_ns, *nodes_ns, *middles(nodes_ns)) if stamp_ns >= start_ns]
    for stamp_ns, expected in dense_joint(motion, prior(), accepted, stamps_ns).items():
        assert max(difference(estimator.state_at(stamp_ns), expected)) < bar


@pytest.mark.parametrize(("late", "ring_s"), [("fuse", 10.0), ("fuse", 0.5), ("drop", 10.0)], ids=str)
@pytest.mark.parametrize("name", SUBJECTS)
def test_in_a_linear_model_the_state_at_every_stamp_is_the_dense_joint_of_all_that_was_accepted(
    name: str, late: Late, ring_s: float
) -> None:
    @given(case=arrivals(close=True))
    @hypothesis_settings(deadline=None, max_examples=SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        check_accepted(name, case, late, ring_s)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("close", [False, True], ids=["apart", "1 us apart"])
@pytest.mark.parametrize("name", SUBJECTS)
def test_what_was_accepted_is_in_the_answer_for_many_long_streams(name: str, close: bool) -> None:
    @given(case=arrivals(span_s=4.0, close=close, max_size=40, min_size=10))
    @hypothesis_settings(deadline=None, max_examples=MORE * SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        check_accepted(name, case, "fuse", 10.0)

    check()


@pytest.mark.parametrize("name", SMOOTHERS)
def test_final_states_are_the_dense_joint_of_what_had_arrived_when_the_node_left(name: str) -> None:
    @given(case=arrivals(max_size=14))
    @hypothesis_settings(deadline=None, max_examples=SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        motion, bar = CV(), SUBJECTS[name].bar(CV(), case.stamps_ns)
        estimator, arrived, stamps_ns = started(name, motion), [], []
        for measurement in case.measurements(motion):
            estimator.update(measurement)
            final = estimator.take_final()
            joint = dense_joint(motion, prior(), arrived, [state.stamp_ns for state in final])
            for state in final:
                assert max(difference(state, joint[state.stamp_ns])) < bar
            arrived.append(measurement)
            stamps_ns += [state.stamp_ns for state in final]
        rest = estimator.take_rest()
        joint = dense_joint(motion, prior(), arrived, [state.stamp_ns for state in rest])
        for state in rest:
            assert max(difference(state, joint[state.stamp_ns])) < bar
        stamps_ns += [state.stamp_ns for state in rest]
        assert stamps_ns == sorted(set(stamps_ns))
        assert set(stamps_ns) <= {START_NS, *case.stamps_ns}

    check()


@pytest.mark.parametrize("name", SMOOTHERS)
def test_several_at_once_are_the_same_as_one_by_one_in_a_linear_model(name: str) -> None:
    @given(case=arrivals(max_size=14))
    @hypothesis_settings(deadline=None, max_examples=SUBJECTS[name].examples)
    def check(case: Arrivals) -> None:
        motion, bar = CV(), SUBJECTS[name].bar(CV(), case.stamps_ns)
        measurements = case.measurements(motion)
        together, alone = started(name, motion), started(name, motion)
        for first in range(0, len(measurements), 3):
            group = measurements[first : first + 3]
            assert len(together.update_all(group)) == len(group)
            for measurement in group:
                alone.update(measurement)
        for stamp_ns in (alone.window_ns[0], *case.stamps_ns, max(case.stamps_ns) + 100 * MS):
            if stamp_ns >= max(together.window_ns[0], alone.window_ns[0]):
                assert max(difference(together.state_at(stamp_ns), alone.state_at(stamp_ns))) < bar

    check()


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_measurement_that_is_too_old_is_reported_and_changes_nothing(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(0)
    estimator = SUBJECTS[name].start(motion, settings(LAG_S, "drop"))
    before_first = measured(START_NS - 1, motion, rng)
    assert estimator.update(before_first).status is UpdateStatus.TOO_OLD
    for k in range(1, 12):
        estimator.update(measured(START_NS + k * 50 * MS, motion, rng))
    start_ns, newest_ns = estimator.window_ns
    stamps_ns = list(range(start_ns, newest_ns + 100 * MS, 17 * MS))
    before = everything(estimator, stamps_ns)
    for stamp_ns in (start_ns - 1, START_NS, START_NS - 1):
        result = estimator.update(measured(stamp_ns, motion, rng))
        assert result.status is UpdateStatus.TOO_OLD
        assert result.nis is None
    assert everything(estimator, stamps_ns) == before
    assert estimator.update(measured(start_ns, motion, rng)).status is UpdateStatus.OUT_OF_SEQUENCE


@pytest.mark.parametrize("name", SMOOTHERS)
def test_fusing_late_data_reaches_as_far_as_the_ring_and_says_so(name: str) -> None:
    motion, rng = CV(), np.random.default_rng(0)
    estimator = smoother(motion, settings(LAG_S, "fuse", 0.2), BACKENDS[name])
    for k in range(1, 21):
        estimator.update(measured(START_NS + k * 50 * MS, motion, rng))
    assert estimator.window_ns == (START_NS + 500 * MS, START_NS + 1000 * MS)
    found = [estimator.update(measured(START_NS + ms * MS, motion, rng)).status for ms in (499, 500, 699, 700)]
    too_old, beyond = UpdateStatus.TOO_OLD, UpdateStatus.BEYOND_WINDOW
    assert found == [too_old, beyond, beyond, UpdateStatus.OUT_OF_SEQUENCE]


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SMOOTHERS)
def test_late_data_may_be_an_error_and_the_estimator_stays_as_it_was(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(0)
    estimator = started(name, motion, "raise")
    for k in range(1, 12):
        estimator.update(measured(START_NS + k * 50 * MS, motion, rng))
    start_ns, newest_ns = estimator.window_ns
    before = everything(estimator, [start_ns, newest_ns])
    with pytest.raises(DataError, match=r"0\.01 s older than the window: lengthen smoother\.lag_s"):
        estimator.update(measured(start_ns - 10 * MS, motion, rng))
    assert everything(estimator, [start_ns, newest_ns]) == before
    assert estimator.update(measured(start_ns, motion, rng)).status is UpdateStatus.OUT_OF_SEQUENCE


@pytest.mark.parametrize("late", ["fuse", "drop", "raise"])
@pytest.mark.parametrize("offset_ms", [5, 100, 299])
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_measurement_inside_the_lag_is_exact_though_every_node_before_it_is_older_than_the_window(
    name: str, offset_ms: int, late: Late
) -> None:
    """The clock has moved the window past its newest node; then a measurement comes at the window's start or later."""
    motion, rng = CV(), np.random.default_rng(5)
    estimator = SUBJECTS[name].start(motion, settings(LAG_S, late))
    accepted = [measured(START_NS + k * 50 * MS, motion, rng) for k in range(1, 10)]
    for measurement in accepted:
        estimator.update(measurement)
    now_ns = START_NS + 2000 * MS
    estimator.advance(now_ns)
    newest = measured(now_ns - 50 * MS, motion, rng)
    inside = measured(now_ns - 300 * MS + offset_ms * MS, motion, rng)
    assert estimator.update(newest).status is UpdateStatus.IN_SEQUENCE
    estimator.update(inside)
    accepted += [newest, inside]
    later = measured(now_ns + 400 * MS, motion, rng)
    for at_ns in (newest.stamp_ns, later.stamp_ns):
        if at_ns == later.stamp_ns:
            estimator.update(later)
            accepted.append(later)
        known = [m for m in accepted if SUBJECTS[name].smooths or m.stamp_ns <= at_ns]
        expected = dense_joint(motion, prior(), known, [at_ns])[at_ns]
        assert max(difference(estimator.state_at(at_ns), expected)) < SUBJECTS[name].linear_bar


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
def test_the_clock_moves_the_window_and_nothing_else(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(6)
    estimator = SUBJECTS[name].start(motion, settings(LAG_S, "drop"))
    for k in range(1, 10):
        estimator.update(measured(START_NS + k * 50 * MS, motion, rng))
    newest_ns = START_NS + 450 * MS
    before = everything(estimator, [newest_ns, newest_ns + 100 * MS])
    estimator.advance(newest_ns + 100 * MS)
    assert estimator.window_ns == (newest_ns - 200 * MS, newest_ns)
    assert everything(estimator, [newest_ns, newest_ns + 100 * MS]) == before
    estimator.advance(newest_ns)
    assert estimator.window_ns == (newest_ns - 200 * MS, newest_ns)


@pytest.mark.parametrize("kind", ["ctrv", "ctra"])
@pytest.mark.parametrize("name", SMOOTHERS)
def test_in_a_nonlinear_model_late_data_beyond_the_window_costs_little(name: str, kind: str) -> None:
    """Marginalised nodes keep their linearisation: most of what the detection says arrives, not all."""
    motion, rng = MOTIONS[kind], np.random.default_rng(7)
    measurements = [measured(START_NS + k * 50 * MS, motion, rng) for k in range(1, 30)]
    late = measurements[10]
    in_order, beyond = started(name, motion), started(name, motion)
    for measurement in in_time_order(measurements):
        in_order.update(measurement)
        if measurement is not late:
            beyond.update(measurement)
    newest_ns = START_NS + 1450 * MS
    without, expected = beyond.state_at(newest_ns), in_order.state_at(newest_ns)
    assert beyond.update(late).status is UpdateStatus.BEYOND_WINDOW
    remaining = difference(beyond.state_at(newest_ns), expected).mean_sigma
    assert remaining < 0.2 * difference(without, expected).mean_sigma
