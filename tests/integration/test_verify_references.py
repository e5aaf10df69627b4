"""`fgtrack verify` holds every filter and smoother to its own equations, and what works on many objects to one of them.

Each of these sabotages leaves linear models, and the comparison of an estimator with itself, as they are.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fgtrack.estimation import iekf, imm, sigma_points
from fgtrack.estimation.base import Measurement, UpdateResult
from fgtrack.estimation.ekf import Update
from fgtrack.estimation.registry import Claims
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.estimation.replayed_steps import ReplayedSteps
from fgtrack.estimation.sigma_points import Regression
from fgtrack.pipeline import verify as pipeline
from fgtrack.pipeline import verify_streams
from fgtrack.pipeline.certificate import Check, Subject
from fgtrack.pipeline.verify import one_estimator
from fgtrack.pipeline.verify_banks import bank_checks
from fgtrack.pipeline.verify_streams import Stream

Break = Callable[[pytest.MonkeyPatch], None]
Draw = Callable[[np.random.Generator], Stream]


def checks_of(name: str, draw: Draw) -> list[Check]:
    """Those of an estimator on one stream, in the order of the stamps and in random order."""
    stream = draw(np.random.default_rng(1))
    orders = {order: stream.orders[order] for order in ("time", "random")}
    [(_, tolerance)] = [pair for pair in pipeline._NONLINEAR if pair[0] is draw]
    return pipeline._nonlinear(replace(stream, orders=orders), name, one_estimator(name)[name], tolerance)


def slopes_halved(patch: pytest.MonkeyPatch) -> None:
    right = sigma_points.regression

    def wrong(*given: Any) -> Regression:
        found = right(*given)
        return Regression(found.mean, 0.5 * found.A, 100.0 * found.noise)

    patch.setattr(sigma_points, "regression", wrong)


def updates_moved(patch: pytest.MonkeyPatch) -> None:
    right, cost = iekf.reweighted, iekf.negative_log_posterior

    def wrong(*given: Any) -> Update:
        found = right(*given)
        return found._replace(mean=found.mean + 1.0, covariance=0.1 * found.covariance)

    patch.setattr(iekf, "reweighted", wrong)
    patch.setattr(iekf, "negative_log_posterior", lambda *given: -cost(*given))


def too_sure(patch: pytest.MonkeyPatch) -> None:
    right = iekf.reweighted
    patch.setattr(iekf, "reweighted", lambda *given: right(*given)._replace(covariance=0.9 * right(*given).covariance))


def unlikely_is_likely(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(imm, "_log_likelihood", lambda found, measurement: 5.0 * float(found.nis))


def likelihood_without_determinant(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(imm, "_log_likelihood", lambda found, measurement: -0.5 * float(found.nis))


def chain_too_fast(patch: pytest.MonkeyPatch) -> None:
    right = imm.Sojourns.transition
    patch.setattr(imm.Sojourns, "transition", lambda self, dt_s: right(self, 1.1 * dt_s))


BROKEN: dict[str, tuple[Break, Draw, tuple[str, ...]]] = {
    "slopes over sigma points": (slopes_halved, verify_streams.whole, ("ukf-replay", "iplf-replay")),
    "updates of the iterated filter": (updates_moved, verify_streams.observed, ("iekf-replay",)),
    "covariance of the iterated filter": (too_sure, verify_streams.observed, ("iekf-replay",)),
    "likelihood of a model": (unlikely_is_likely, verify_streams.whole, ("imm-replay",)),
    "determinant of a likelihood": (likelihood_without_determinant, verify_streams.observed, ("imm-replay",)),
    "chain of the models": (chain_too_fast, verify_streams.whole, ("imm-replay",)),
}


@pytest.mark.parametrize("what", BROKEN)
def test_an_equation_of_one_estimator_alone_is_found_out(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    broken, draw, names = BROKEN[what]
    for name in names:
        assert all(check.met for check in checks_of(name, draw)), name
    broken(monkeypatch)
    for name in names:
        assert not all(check.met for check in checks_of(name, draw)), name


def fused_elsewhere(patch: pytest.MonkeyPatch) -> None:
    right = ReplayedSteps.corrected

    def wrong(self: ReplayedSteps, *given: Any) -> Any:
        mean, covariance, said = right(self, *given)
        return mean + 1.0, 0.25 * covariance, said

    patch.setattr(ReplayedSteps, "corrected", wrong)


def first_of_all(patch: pytest.MonkeyPatch) -> None:
    right = ReplayedSteps.reserve
    patch.setattr(ReplayedSteps, "reserve", lambda self, tracks, given: right(self, tracks, [given[0]] * len(given)))


def removed_too_many(patch: pytest.MonkeyPatch) -> None:
    right = ReplayedSteps.begin

    def wrong(self: ReplayedSteps, track: int, stamp_ns: int, mean: Any, covariance: Any) -> None:
        right(self, track, stamp_ns, mean, covariance)
        if track > 1:
            right(self, track - 1, stamp_ns, mean, covariance)

    patch.setattr(ReplayedSteps, "begin", wrong)


@pytest.mark.parametrize("broken", [fused_elsewhere, first_of_all, removed_too_many])
def test_what_the_arrays_of_many_objects_do_is_found_out(broken: Break, monkeypatch: pytest.MonkeyPatch) -> None:
    subject = one_estimator("ekf-replay")["ekf-replay"]
    sound = bank_checks(np.random.default_rng(1), "ekf-replay", subject)
    assert len(sound) == 2
    assert all(check.met for check in sound)
    broken(monkeypatch)
    assert not any(check.met for check in bank_checks(np.random.default_rng(1), "ekf-replay", subject))


class Unsaid(ReplayEkf):
    """Says nothing of what it solves."""

    solves = ""  # type: ignore[assignment]  # any of those of `Claims`

    def seen(self, measurement: Measurement) -> Measurement:
        return measurement

    def update(self, measurement: Measurement) -> UpdateResult:
        return super().update(self.seen(measurement))


class DoublesTheDeviation(Unsaid):
    def seen(self, measurement: Measurement) -> Measurement:
        return replace(measurement, R=(1.0 if measurement.model.linear else 4.0) * measurement.R)


class WithoutPose(Unsaid):
    def seen(self, measurement: Measurement) -> Measurement:
        return replace(measurement, pose=type(measurement.pose)())


class WithoutLoss(Unsaid):
    def seen(self, measurement: Measurement) -> Measurement:
        return replace(measurement, loss=None)


@pytest.mark.parametrize(
    ("kind", "missed"),
    [
        (Unsaid, set()),
        (DoublesTheDeviation, {"CTRV, mildly nonlinear"}),
        (WithoutPose, {"CTRV, mildly nonlinear"}),
        (WithoutLoss, {"CTRV, mild, Huber loss"}),
    ],
)
def test_one_that_does_not_say_what_it_solves_must_come_near(kind: type[Unsaid], missed: set[str]) -> None:
    rng, subject = np.random.default_rng(1), Subject(kind, Claims.of(kind))
    checks = [check for draw in pipeline._MILD for check in pipeline._nearby(draw(rng), "unsaid", subject)]
    assert {check.stream for check in checks if not check.met} == missed
    assert len(checks) == 2
