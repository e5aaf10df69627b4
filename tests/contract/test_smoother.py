"""What the fixed-lag smoother promises beyond the contract of all estimators, with either backend."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, UpdateStatus
from fgtrack.estimation.factor_graph import BatchBackend, FixedLagSmoother, IncrementalBackend, SmootherSettings
from fgtrack.estimation.factor_graph.backends.base import Backend, Change
from fgtrack.estimation.failures import Failure
from fgtrack.models.motion import CTRV, CV, MotionModel
from fgtrack.testing.references import dense_joint, difference
from fgtrack.testing.streams import COMPONENTS, MS, START, US, Stream, measured, shuffled

START_NS = START.stamp_ns
LAG_S = 0.3
MakeBackend = Callable[[], Backend]
BACKENDS: dict[str, MakeBackend] = {"incremental": IncrementalBackend, "batch": BatchBackend}
TOLERANCES = {"incremental": 1e-9, "batch": 1e-6}
NUM_STREAMS = {"incremental": 15, "batch": 4}
every_backend = pytest.mark.parametrize("name", BACKENDS)


def smoother(
    motion: MotionModel, make: MakeBackend, lag_s: float = LAG_S, late: Literal["fuse", "drop", "raise"] = "fuse"
) -> FixedLagSmoother:
    return FixedLagSmoother(motion, START, SmootherSettings(lag_s=lag_s, late=late, ring_s=10.0, lagged_s=()), make)


def fill(motion: MotionModel, rng: np.random.Generator, *estimators: Estimator, num: int = 9) -> None:
    for k in range(1, num + 1):
        measurement = measured(rng, motion, k * 50 * MS)
        for estimator in estimators:
            estimator.update(measurement)


def apart(first: Estimator, second: Estimator) -> float:
    stamps_ns = [START_NS + ms * MS for ms in (0, 120, 345, 450, 475, 500, 600)]
    return max(max(difference(first.state_at(at), second.state_at(at))) for at in stamps_ns)


When = Literal["before", "after"]


class Flaky:
    """A backend whose next update raises once its fuse is lit, before the update is applied or after it."""

    damped = False

    def __init__(self, inner: Backend, fuse: "Fuse") -> None:
        self._inner, self._fuse = inner, fuse

    def update(self, change: Change) -> list[int]:
        if self._fuse.when == "before":
            self._fuse.blow()
        slots = self._inner.update(change)
        if self._fuse.when == "after":
            self._fuse.blow()
        return slots

    def means(self, keys: Sequence[int]) -> FloatArray:
        return self._inner.means(keys)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        return self._inner.covariance(keys)


class Fuse:
    """Blows once when lit."""

    def __init__(self) -> None:
        self.when: When | None = None

    def blow(self) -> None:
        self.when = None
        raise RuntimeError("the solver gave up")


def flaky(name: str, motion: MotionModel) -> tuple[FixedLagSmoother, Fuse]:
    fuse = Fuse()
    return smoother(motion, lambda: Flaky(BACKENDS[name](), fuse)), fuse


@pytest.mark.parametrize("when", ["before", "after"])
@every_backend
def test_a_solver_that_gives_up_once_fails_one_measurement_and_the_rest_is_as_if_nothing_had_happened(
    name: str, when: When
) -> None:
    """The measurement comes ahead, on the newest node, into a segment, beyond the window, or moves the window on."""
    motion, tolerance = CV(), TOLERANCES[name]
    for ms in (500, 475, 450, 345, 120, 1000):
        rng = np.random.default_rng(8)
        (hit, fuse), (spared, _) = flaky(name, motion), flaky(name, motion)
        fill(motion, rng, hit, spared)
        left = [state.stamp_ns for state in spared.take_final()]
        assert [state.stamp_ns for state in hit.take_final()] == left

        fuse.when = when
        assert hit.update(measured(rng, motion, ms * MS)).status is UpdateStatus.FAILED
        assert fuse.when is None
        assert hit.failures.counts == {Failure.GRAPH_REBUILT: 1}
        assert hit.window_ns == spared.window_ns
        assert apart(hit, spared) < tolerance

        for late_ms in (500, 320, 130, 900, 650):
            measurement = measured(rng, motion, late_ms * MS)
            assert hit.update(measurement).status is spared.update(measurement).status
            assert apart(hit, spared) < tolerance
        assert hit.failures.counts == {Failure.GRAPH_REBUILT: 1}
        for found, expected in zip(hit.take_rest(), spared.take_rest(), strict=True):
            assert found.stamp_ns == expected.stamp_ns
            assert max(difference(found, expected)) < tolerance


@every_backend
def test_after_a_rebuild_a_nonlinear_model_stands_where_it_stood(name: str) -> None:
    motion, rng = CTRV(), np.random.default_rng(9)
    (hit, fuse), (spared, _) = flaky(name, motion), flaky(name, motion)
    fill(motion, rng, hit, spared)
    fuse.when = "after"
    assert hit.update(measured(rng, motion, 345 * MS)).status is UpdateStatus.FAILED
    hit.converge()
    spared.converge()
    assert apart(hit, spared) < 1e-2


@every_backend
def test_of_several_measurements_the_one_that_is_no_number_fails_alone(name: str) -> None:
    motion, rng = CV(), np.random.default_rng(2)
    with_broken, without = (smoother(motion, BACKENDS[name]) for _ in range(2))
    good = [measured(rng, motion, k * 50 * MS) for k in (2, 1)]
    broken = replace(good[0], z=np.full(2, np.nan))
    found = [result.status for result in with_broken.update_all([good[0], broken, good[1]])]
    assert found == [UpdateStatus.IN_SEQUENCE, UpdateStatus.FAILED, UpdateStatus.IN_SEQUENCE]
    without.update_all(good)
    assert apart(with_broken, without) == 0.0


@every_backend
def test_a_covariance_that_is_none_fails_and_the_next_measurement_is_fused(name: str) -> None:
    motion, rng = CV(), np.random.default_rng(10)
    estimator, spared = (smoother(motion, BACKENDS[name]) for _ in range(2))
    first, second = (measured(rng, motion, k * 50 * MS) for k in (1, 2))
    estimator.update(first)
    assert estimator.update(replace(second, R=-10.0 * np.eye(2))).status is UpdateStatus.FAILED
    assert estimator.update(second).status is UpdateStatus.IN_SEQUENCE
    spared.update(first)
    spared.update(second)
    assert apart(estimator, spared) < TOLERANCES[name]


def streams(name: str) -> list[Stream]:
    """Without the measurements that come 1 us after another, which cost digits."""
    drawn = [shuffled(CV(), np.random.default_rng([11, k]), span_s=2.0) for k in range(NUM_STREAMS[name])]
    even = [tuple(m for m in stream.measurements if (m.stamp_ns - START_NS) % (2 * MS) == 0) for stream in drawn]
    return [replace(stream, measurements=kept) for stream, kept in zip(drawn, even, strict=True)]


@every_backend
def test_final_states_are_the_dense_joint_of_what_had_arrived_when_the_node_left(name: str) -> None:
    motion = CV()
    for stream in streams(name):
        estimator, arrived, stamps_ns = smoother(motion, BACKENDS[name]), [], []
        for measurement in (*stream.measurements, None):
            if measurement is not None:
                estimator.update(measurement)
            states = estimator.take_rest() if measurement is None else estimator.take_final()
            joint = dense_joint(motion, START, arrived, [state.stamp_ns for state in states])
            for state in states:
                assert max(difference(state, joint[state.stamp_ns])) < TOLERANCES[name]
            stamps_ns += [state.stamp_ns for state in states]
            arrived += [measurement]
        assert stamps_ns == sorted(set(stamps_ns))
        assert set(stamps_ns) <= set(stream.stamps_ns)


@every_backend
def test_several_at_once_are_the_same_as_one_by_one_in_a_linear_model(name: str) -> None:
    motion = CV()
    for stream in streams(name):
        together, alone = smoother(motion, BACKENDS[name]), smoother(motion, BACKENDS[name])
        for first in range(0, len(stream.measurements), 3):
            group = stream.measurements[first : first + 3]
            assert len(together.update_all(group)) == len(group)
            for measurement in group:
                alone.update(measurement)
        for stamp_ns in (alone.window_ns[0], *stream.stamps_ns, stream.newest_ns + 100 * MS):
            if stamp_ns >= max(together.window_ns[0], alone.window_ns[0]):
                assert max(difference(together.state_at(stamp_ns), alone.state_at(stamp_ns))) < TOLERANCES[name]


@every_backend
def test_states_between_which_gauss_newton_oscillates_converge(name: str) -> None:
    """Two clusters of positions: the noise of the motion between them follows the state before it, and so on."""
    motion, rng = CTRV(), np.random.default_rng(295)
    offsets_ns = (1422 * MS, 1422 * MS + US, 2 * MS, 2 * MS + US)
    measurements = [measured(rng, motion, ns, COMPONENTS[rng.integers(4)]) for ns in offsets_ns]
    shuffled_one, in_order = (smoother(motion, BACKENDS[name], lag_s=2.0) for _ in range(2))
    for place in range(4):
        shuffled_one.update(measurements[place])
        in_order.update(measurements[3 - place])
    for estimator in (shuffled_one, in_order):
        estimator.converge(20)
    for ns in (0, 2 * MS, 700 * MS, 1422 * MS):
        assert max(difference(shuffled_one.state_at(START_NS + ns), in_order.state_at(START_NS + ns))) < 1e-5


def test_fusing_late_data_reaches_as_far_as_the_ring_and_says_so() -> None:
    motion, rng = CV(), np.random.default_rng(0)
    settings = SmootherSettings(lag_s=LAG_S, ring_s=0.2, lagged_s=())
    estimator = FixedLagSmoother(motion, START, settings, IncrementalBackend)
    fill(motion, rng, estimator, num=20)
    assert estimator.window_ns == (START_NS + 500 * MS, START_NS + 1000 * MS)
    found = [estimator.update(measured(rng, motion, ms * MS)).status for ms in (499, 500, 699, 700)]
    too_old, beyond = UpdateStatus.TOO_OLD, UpdateStatus.BEYOND_WINDOW
    assert found == [too_old, beyond, beyond, UpdateStatus.OUT_OF_SEQUENCE]


@every_backend
def test_late_data_may_be_an_error_and_the_estimator_stays_as_it_was(name: str) -> None:
    motion, rng = CTRV(), np.random.default_rng(0)
    estimator = smoother(motion, BACKENDS[name], late="raise")
    fill(motion, rng, estimator, num=11)
    start_ns, newest_ns = estimator.window_ns
    before = [repr(estimator.state_at(stamp_ns)) for stamp_ns in (start_ns, newest_ns)]
    with pytest.raises(DataError, match=r"0\.01 s older than the window: lengthen smoother\.lag_s"):
        estimator.update(measured(rng, motion, start_ns - START_NS - 10 * MS))
    assert [repr(estimator.state_at(stamp_ns)) for stamp_ns in (start_ns, newest_ns)] == before
    assert estimator.update(measured(rng, motion, start_ns - START_NS)).status is UpdateStatus.OUT_OF_SEQUENCE


@every_backend
def test_in_a_nonlinear_model_late_data_beyond_the_window_costs_little(name: str) -> None:
    """Marginalised nodes keep their linearisation: most of what the detection says arrives, not all."""
    motion, rng = CTRV(), np.random.default_rng(7)
    measurements = [measured(rng, motion, k * 50 * MS) for k in range(1, 30)]
    late = measurements[10]
    in_order, beyond = smoother(motion, BACKENDS[name]), smoother(motion, BACKENDS[name])
    for measurement in measurements:
        in_order.update(measurement)
        if measurement is not late:
            beyond.update(measurement)
    newest_ns = START_NS + 1450 * MS
    without, expected = beyond.state_at(newest_ns), in_order.state_at(newest_ns)
    assert beyond.update(late).status is UpdateStatus.BEYOND_WINDOW
    remaining = difference(beyond.state_at(newest_ns), expected).mean_sigma
    assert remaining < 0.2 * difference(without, expected).mean_sigma
