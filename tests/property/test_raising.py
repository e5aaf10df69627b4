"""Whatever raises inside: a failure ends its own update alone, and the report of a tick agrees with the states."""

import random
from collections.abc import Callable
from contextlib import ExitStack
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.raising import ERRORS, Fault, Outcome, Point, make, points, problems, run

from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.models.measurement import MeasurementModel

#: Estimators that keep their windows as they are solved compare by rounding where measurements are fused one by one.
ROUNDING = 1e-7
#: Two banks in arrays, a bank of objects that replay, and one that keeps a grid.
SOME = ("ekf-replay", "smoother-banded", "iekf-replay", "ekf-backward-forward")


def _tolerance(estimator: str) -> float:
    return ROUNDING if Claims.of(ESTIMATORS.load(estimator)).smooths else 0.0


def _with_fault(
    estimator: str, name: str, at: int, error: type[BaseException]
) -> tuple[Outcome, Fault]:
    tracker = make(estimator)
    point = next(each for each in points(tracker) if str(each) == name)
    with Fault(point, at, error) as fault:
        return run(tracker, fault), fault


@cache
def _reference(estimator: str) -> Outcome:
    """The run without a fault, for reading only."""
    return run(make(estimator))


def _early_calls(estimator: str) -> dict[str, int]:
    """Number of calls of each method before the last ticks, counted in one run."""
    tracker = make(estimator)
    with ExitStack() as stack:
        faults = [stack.enter_context(Fault(each, 0)) for each in points(tracker)]
        run(tracker, *faults)
    return {str(fault.point): fault.early_calls for fault in faults}


def _findings(
    estimator: str, chosen: Callable[[list[str]], list[str]], seed: int
) -> list[str]:
    """Let each of the `chosen` methods raise once, at a random call, and return what is wrong."""
    rng, reference = random.Random(f"{estimator} {seed}"), _reference(estimator)
    assert not reference.lies
    assert not reference.failures
    findings, early_calls = [], _early_calls(estimator)
    for name in chosen(list(early_calls)):
        calls = early_calls[name]
        if calls:
            at, error = rng.randint(1, calls), rng.choice((*ERRORS, KeyboardInterrupt))
            faulty, fault = _with_fault(estimator, name, at, error)
            wrong = problems(reference, faulty, fault, _tolerance(estimator))
            findings += [
                f"{name}, call {at} of {calls}, {error.__name__}: {each}"
                for each in wrong
            ]
    return findings


@pytest.mark.long
@pytest.mark.parametrize(
    "estimator",
    [*SOME[:2], *(pytest.param(name, marks=pytest.mark.slow) for name in SOME[2:])],
)
def test_a_call_that_raises_ends_its_own_update_alone(estimator: str) -> None:
    def chosen(names: list[str]) -> list[str]:
        rest = [name for name in names if ".update" not in name and "Bank" not in name]
        return [name for name in names if name not in rest] + random.Random(
            estimator
        ).sample(rest, 8)

    assert not _findings(estimator, chosen, 0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("estimator", list(ESTIMATORS))
def test_a_call_of_any_method_of_any_estimator_may_raise(
    estimator: str, seed: int
) -> None:
    assert not _findings(estimator, lambda names: names, seed)


def _stubborn(
    estimator: str, error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> Outcome:
    """Run a tracker whose measurement models raise in every update of the object at y = -300 m."""
    tracker = make(estimator)
    bank, is_active = tracker._tracker._parts.bank._bank, [False]
    own, update = MeasurementModel.linearised, bank.update

    def linearised(model: Any, z: Any, mean: Any, *more: Any) -> Any:
        if is_active[0] and np.any(np.atleast_2d(mean)[:, 1] < -200.0):
            raise error("injected")
        return own(model, z, mean, *more)

    def active(*arguments: Any) -> Any:
        is_active[0] = True
        try:
            return update(*arguments)
        finally:
            is_active[0] = False

    monkeypatch.setattr(MeasurementModel, "linearised", linearised)
    monkeypatch.setattr(bank, "update", active)
    return run(tracker)


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimator", "error"),
    [
        ("smoother-banded", ValueError),
        ("smoother-banded", MemoryError),
        ("smoother-banded", np.linalg.LinAlgError),
        ("smoother", ValueError),
        ("iekf-replay", MemoryError),
        ("ukf-replay", np.linalg.LinAlgError),
    ],
)
def test_a_model_that_always_raises_for_one_object_disturbs_no_other(
    estimator: str, error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    reference = _reference(estimator)
    faulty = _stubborn(estimator, error, monkeypatch)
    assert not faulty.raised
    assert not faulty.lies
    assert {each for each, _ in faulty.rows} == {each for each, _ in reference.rows}
    assert faulty.failures["update failed"] > 0
    for number in (1, 2, 3):
        assert faulty.of(number) == reference.of(number)
        for own, other in zip(reference.states, faulty.states, strict=True):
            assert own is not None
            assert other is not None
            if number in own:
                for a, b in zip(own[number], other[number], strict=True):
                    np.testing.assert_allclose(
                        b, a, rtol=_tolerance(estimator), atol=_tolerance(estimator)
                    )


def test_an_interrupt_loses_no_detection_and_the_next_tick_goes_on() -> None:
    reference = _reference("ekf-replay")
    for name in (
        "Preprocess.together",
        "GatedMahalanobis.__call__",
        "ExistenceLifecycle.born",
        "ReplayBank.present",
    ):
        faulty, fault = _with_fault("ekf-replay", name, 3, KeyboardInterrupt)
        assert fault.raised
        assert [each.split()[1] for each in faulty.raised] == ["KeyboardInterrupt:"]
        assert {each for each, _ in faulty.rows} == {each for each, _ in reference.rows}
        assert len(faulty.rows) == len(reference.rows)


def test_a_point_is_restored_after_its_fault() -> None:
    tracker = make("ekf-replay")
    bank = tracker._tracker._parts.bank._bank
    before = dict(vars(bank))
    with (
        Fault(Point(bank, "advance"), 1, ValueError),
        pytest.raises(ValueError, match="injected"),
    ):
        bank.advance(0)
    assert vars(bank) == before
