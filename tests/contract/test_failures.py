"""An estimator stays usable after a failure: as it was before, and ready for the next measurement."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from arrivals import MS, measured
from estimators import BACKENDS, MOTIONS, SMOOTHERS, START_NS, SUBJECTS, settings, smoother

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, UpdateStatus
from fgtrack.estimation.dense_joint import difference
from fgtrack.estimation.factor_graph import FixedLagSmoother
from fgtrack.estimation.factor_graph.backends.base import Backend, Change
from fgtrack.models.motion import CV, MotionModel

When = Literal["before", "after"]


class Flaky:
    """A backend whose next update raises once its fuse is lit, before the update is applied or after it."""

    def __init__(self, inner: Backend, fuse: "Fuse") -> None:
        self._inner, self._fuse = inner, fuse

    def update(self, change: Change) -> list[int]:
        if self._fuse.when == "before":
            self._fuse.blow()
        slots = self._inner.update(change)
        if self._fuse.when == "after":
            self._fuse.blow()
        return slots

    def mean(self, key: int) -> FloatArray:
        return self._inner.mean(key)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        return self._inner.covariance(keys)

    def moves(self, keys: Sequence[int]) -> FloatArray:
        return self._inner.moves(keys)


class Fuse:
    """Blows once when lit."""

    def __init__(self) -> None:
        self.when: When | None = None

    def blow(self) -> None:
        self.when = None
        raise RuntimeError("the solver gave up")


def flaky(name: str, motion: MotionModel) -> tuple[FixedLagSmoother, Fuse]:
    fuse = Fuse()
    return smoother(motion, settings(lag_s=0.3), lambda thresholds: Flaky(BACKENDS[name](thresholds), fuse)), fuse


STAMPS_NS = [START_NS + ms * MS for ms in (0, 120, 345, 450, 475, 500, 600)]


def apart(first: Estimator, second: Estimator) -> float:
    return max(max(difference(first.state_at(at), second.state_at(at))) for at in STAMPS_NS)


@pytest.mark.parametrize("kind", MOTIONS)
@pytest.mark.parametrize("name", SUBJECTS)
def test_a_measurement_that_is_no_number_fails_and_changes_nothing(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(2)
    estimator = SUBJECTS[name].start(motion, settings())
    for k in (1, 2, 4):
        estimator.update(measured(START_NS + k * 50 * MS, motion, rng))
    stamps_ns = [START_NS + ms * MS for ms in (0, 75, 200, 250)]
    before = [estimator.state_at(stamp_ns) for stamp_ns in stamps_ns]
    for ms in (20, 50, 300):
        good = measured(START_NS + ms * MS, motion, rng)
        broken = replace(good, z=np.where(np.arange(len(good.z)) == 0, np.nan, good.z))
        result = estimator.update(broken)
        assert result.status is UpdateStatus.FAILED
        assert result.nis is None
    for stamp_ns, state in zip(stamps_ns, before, strict=True):
        found = estimator.state_at(stamp_ns)
        np.testing.assert_array_equal(found.mean, state.mean)
        np.testing.assert_array_equal(found.covariance, state.covariance)
    assert estimator.window_ns == (START_NS, START_NS + 200 * MS)
    assert estimator.update(measured(START_NS + 60 * MS, motion, rng)).status is UpdateStatus.OUT_OF_SEQUENCE


@pytest.mark.parametrize("name", SMOOTHERS)
def test_of_several_measurements_the_one_that_is_no_number_fails_alone(name: str) -> None:
    motion, rng = CV(), np.random.default_rng(2)
    with_broken, without = (SUBJECTS[name].start(motion, settings()) for _ in range(2))
    good = [measured(START_NS + k * 50 * MS, motion, rng) for k in (2, 1)]
    broken = replace(good[0], z=np.full(2, np.nan))
    found = [result.status for result in with_broken.update_all([good[0], broken, good[1]])]
    assert found == [UpdateStatus.IN_SEQUENCE, UpdateStatus.FAILED, UpdateStatus.IN_SEQUENCE]
    without.update_all(good)
    assert apart(with_broken, without) == 0.0


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("ms", [500, 475, 450, 345, 120, 1000], ids=str)
@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_solver_that_gives_up_once_fails_one_measurement_and_the_rest_is_as_if_nothing_had_happened(
    name: str, ms: int, when: When
) -> None:
    """The measurement comes ahead, on the newest node, into a segment, beyond the window, or moves the window on."""
    motion, rng, bar = CV(), np.random.default_rng(8), SUBJECTS[name].linear_bar
    (hit, fuse), (spared, _) = flaky(name, motion), flaky(name, motion)
    for k in range(1, 10):
        measurement = measured(START_NS + k * 50 * MS, motion, rng)
        hit.update(measurement)
        spared.update(measurement)
    left = [state.stamp_ns for state in spared.take_final()]
    assert [state.stamp_ns for state in hit.take_final()] == left

    fuse.when = when
    assert hit.update(measured(START_NS + ms * MS, motion, rng)).status is UpdateStatus.FAILED
    assert fuse.when is None
    assert hit.num_rebuilt == 1
    assert hit.window_ns == spared.window_ns
    assert apart(hit, spared) < bar

    for late_ms in (500, 320, 130, 900, 650):
        measurement = measured(START_NS + late_ms * MS, motion, rng)
        assert hit.update(measurement).status is spared.update(measurement).status
        assert apart(hit, spared) < bar
    assert hit.num_rebuilt == 1
    for found, expected in zip(hit.take_rest(), spared.take_rest(), strict=True):
        assert found.stamp_ns == expected.stamp_ns
        assert max(difference(found, expected)) < bar


@pytest.mark.parametrize("kind", ["ctrv", "ctra"])
@pytest.mark.parametrize("name", SMOOTHERS)
def test_after_a_rebuild_a_nonlinear_model_stands_where_it_stood(name: str, kind: str) -> None:
    motion, rng = MOTIONS[kind], np.random.default_rng(9)
    (hit, fuse), (spared, _) = flaky(name, motion), flaky(name, motion)
    for k in range(1, 10):
        measurement = measured(START_NS + k * 50 * MS, motion, rng)
        hit.update(measurement)
        spared.update(measurement)
    fuse.when = "after"
    assert hit.update(measured(START_NS + 345 * MS, motion, rng)).status is UpdateStatus.FAILED
    hit.converge()
    spared.converge()
    assert apart(hit, spared) < 1e-2


@pytest.mark.parametrize("name", SMOOTHERS)
def test_a_covariance_that_is_none_fails_and_the_next_measurement_is_fused(name: str) -> None:
    motion, rng = CV(), np.random.default_rng(10)
    estimator, spared = (SUBJECTS[name].start(motion, settings()) for _ in range(2))
    first, second = (measured(START_NS + k * 50 * MS, motion, rng) for k in (1, 2))
    estimator.update(first)
    assert estimator.update(replace(second, R=-10.0 * np.eye(2))).status is UpdateStatus.FAILED
    assert estimator.update(second).status is UpdateStatus.IN_SEQUENCE
    spared.update(first)
    spared.update(second)
    assert apart(estimator, spared) < SUBJECTS[name].linear_bar
