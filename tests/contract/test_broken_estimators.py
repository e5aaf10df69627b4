"""An estimator that breaks one promise is found out by that promise, with measurements that show it."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.cases import each_once

from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import (
    Measurement,
    Start,
    StatesAt,
    UpdateResult,
    UpdateStatus,
)
from fgtrack.estimation.filters.ekf import correct_one
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.models.measurement import AT_ORIGIN, MeasurementModel
from fgtrack.models.motion import MotionModel
from fgtrack.testing import BrokenPromiseError, check_estimator, estimator_checks

ANY_ORDER = "gives the dense joint posterior in any order"
NEAR = "gives the posterior of a nonlinear model"
SEVERAL = "gives each of several objects what it gives one alone"


class DropsLateData(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        if self.window_ns[0] <= measurement.stamp_ns < self.window_ns[1]:
            return UpdateResult(
                UpdateStatus.OUT_OF_SEQUENCE, np.zeros(len(measurement.z)), 0.0
            )
        return super().update(measurement)


class ForgetsEqualStamps(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        if (
            measurement.stamp_ns == self.window_ns[1] > self.window_ns[0]
            and np.isfinite(measurement.z).all()
        ):
            return UpdateResult(
                UpdateStatus.IN_SEQUENCE, np.zeros(len(measurement.z)), 0.0
            )
        return super().update(measurement)


class DoublesTheNoise(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        return super().update(replace(measurement, R=2.0 * measurement.R))


class SaysInSequence(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        result = super().update(measurement)
        return (
            result
            if result.nis is None
            else replace(result, status=UpdateStatus.IN_SEQUENCE)
        )


class TakesLatencyForDisorder(ReplayEkf):
    """Calls a measurement out of sequence where the clock is far ahead of its stamp."""

    now_ns = 0

    def advance(self, now_ns: int) -> None:
        super().advance(now_ns)
        self.now_ns = now_ns

    def update(self, measurement: Measurement) -> UpdateResult:
        now_ns, result = self.now_ns, super().update(measurement)
        is_in_sequence = result.status is UpdateStatus.IN_SEQUENCE
        if is_in_sequence and now_ns - measurement.stamp_ns > 300_000_000:
            return replace(result, status=UpdateStatus.OUT_OF_SEQUENCE)
        return result


class Lopsided(ReplayEkf):
    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        return replace(
            state, covariance=state.covariance + 1e-9 * np.eye(len(state.mean), k=1)
        )


class Random(ReplayEkf):
    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        return replace(
            state, mean=state.mean + 1e-14 * np.random.default_rng().standard_normal()
        )


class SharesItsState(ReplayEkf):
    def __init__(self, motion: MotionModel, start: Start, lag_s: float) -> None:
        super().__init__(motion, start, lag_s)
        self.shared = np.zeros(motion.dim)

    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        self.shared[:] = state.mean
        return replace(state, mean=self.shared)


class FusesWhatIsTooOld(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        old_ns = self.window_ns[0]
        if measurement.stamp_ns < old_ns:
            super().update(replace(measurement, stamp_ns=old_ns))
            return UpdateResult(UpdateStatus.TOO_OLD)
        return super().update(measurement)


class FusesWhatIsNoNumber(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        return super().update(replace(measurement, z=np.nan_to_num(measurement.z)))


class ForgetsWithTheClock(ReplayEkf):
    def advance(self, now_ns: int) -> None:
        super().advance(now_ns)
        if now_ns > self.window_ns[1]:
            self.steps[-1] = replace(self.steps[-1], mean=self.steps[-1].mean + 1e-3)


class StandsStill(ReplayEkf):
    def state_at(self, stamp_ns: int) -> TrackState:
        return replace(
            super().state_at(min(stamp_ns, self.window_ns[1])), stamp_ns=stamp_ns
        )


class Sees(ReplayEkf):
    """Fuses another measurement in a nonlinear model; linear ones it takes as they are."""

    def update(self, measurement: Measurement) -> UpdateResult:
        known = (
            self.window_ns[0] <= measurement.stamp_ns
            and np.isfinite(measurement.z).all()
        )
        before = self.state_at(measurement.stamp_ns) if known else None
        late = measurement.stamp_ns <= self.window_ns[1]
        result = super().update(
            measurement if self._motion.linear else self.seen(measurement)
        )
        if result.nis is None or before is None or late:
            return result
        said = correct_one(
            before.mean, before.covariance, measurement.seen_by(self._motion)
        )
        return replace(
            result,
            innovation=said.innovation,
            nis=said.nis,
            innovation_covariance=said.S,
        )

    def seen(self, measurement: Measurement) -> Measurement:
        return measurement


class WithQuadrupleNoise(Sees):
    def seen(self, measurement: Measurement) -> Measurement:
        return replace(measurement, R=4.0 * measurement.R)


class WithoutPose(Sees):
    def seen(self, measurement: Measurement) -> Measurement:
        return replace(measurement, pose=type(measurement.pose)())


class WithoutLoss(Sees):
    def seen(self, measurement: Measurement) -> Measurement:
        return replace(measurement, loss=None)


class SaysAnotherCovariance(ReplayEkf):
    def update(self, measurement: Measurement) -> UpdateResult:
        result = super().update(measurement)
        S = result.innovation_covariance
        return result if S is None else replace(result, innovation_covariance=1.1 * S)


class FilterBank(ObjectBank[ReplayEkf]):
    """What the broken banks are made of."""

    bank = True

    def __init__(self, motion: MotionModel, lag_s: float) -> None:
        super().__init__(motion, lambda start: ReplayEkf(motion, start, lag_s), lag_s)


class RemovesTheNext(FilterBank):
    def remove(self, track_id: int) -> None:
        super().remove(track_id + 1)


class ShowsAnother(FilterBank):
    def present(self) -> list[TrackState]:
        return list(super().present())[::-1]


class GivesOneForAll(FilterBank):
    def states_at(self, stamp_ns: int) -> StatesAt:
        states = super().states_at(stamp_ns)
        return replace(
            states, means=np.repeat(states.means[:1], len(states.means), axis=0)
        )


#: Each broken estimator, the promise that it breaks, and the fault that the promise must name.
BROKEN = (
    (DropsLateData, ANY_ORDER, "differs from the dense joint posterior"),
    (
        DropsLateData,
        "gives the estimate of the time order in any order",
        "differs from that of the time order",
    ),
    (
        DropsLateData,
        "keeps all that it accepts and nothing else",
        "differs from that of these",
    ),
    (ForgetsEqualStamps, ANY_ORDER, "differs from the dense joint posterior"),
    (
        DoublesTheNoise,
        "is the kalman filter in sequence",
        "differs from the Kalman filter's",
    ),
    (
        DoublesTheNoise,
        "reports the innovation against all that it has fused",
        r"the innovation .* off by",
    ),
    (SaysInSequence, "counts each measurement as what it is", "late, is in_sequence"),
    (
        TakesLatencyForDisorder,
        "counts each measurement as what it is",
        "in sequence, is out_of_sequence",
    ),
    (Lopsided, "gives symmetric positive definite covariances", "is not symmetric"),
    (Random, "gives the same bits for the same input", "states differ"),
    (SharesItsState, "changes no input and no output later", "changes later"),
    (
        FusesWhatIsTooOld,
        "reports what is too old and stays as it was",
        "a stamp before .* changes the state",
    ),
    (
        FusesWhatIsNoNumber,
        "stays as it was after a failure and fuses the next",
        "that is not a number is ",
    ),
    (
        ForgetsWithTheClock,
        "moves only the window with the clock",
        "differs from that before the clock moved",
    ),
    (
        StandsStill,
        "predicts ahead by the motion model",
        "differs from the prediction of the newest one",
    ),
    (WithQuadrupleNoise, NEAR, "differs from that of a plain calculation"),
    (WithoutPose, NEAR, "differs from that of a plain calculation"),
    (WithoutLoss, NEAR, "differs from that of a plain calculation"),
    (
        SaysAnotherCovariance,
        "counts each measurement as what it is",
        "the NIS is .* by the covariance",
    ),
    (RemovesTheNext, SEVERAL, r"its objects are \(0, 1, 2, 4"),
    (ShowsAnother, SEVERAL, "the present state of object 0 is "),
    (GivesOneForAll, SEVERAL, "the state of object 1 .* differs from what it is alone"),
)


#: The nonlinear promise finds it as it finds another pose, or a loss that is left out.
SLOW = (WithQuadrupleNoise,)


@pytest.mark.parametrize(
    ("broken", "promise", "fault"),
    [
        pytest.param(*case, marks=pytest.mark.slow if case[0] in SLOW else ())
        for case in BROKEN
    ],
)
def test_a_broken_estimator_is_found_out_by_the_promise_that_it_breaks(
    broken: type, promise: str, fault: str
) -> None:
    """An exception of the broken estimator would be a fault of this test: its text begins with the exception's name."""
    with pytest.raises(
        BrokenPromiseError, match="measurements in the order of arrival"
    ) as error:
        estimator_checks(broken)[promise]()
    assert list(error.value.promises) == [promise]
    said = error.value.promises[promise]
    assert re.search(fault, said.partition("measurements in the order")[0])
    assert not re.match(r"\w+(Error|Exception): ", said)


def test_every_broken_estimator_of_this_file_is_tested() -> None:
    bases = {Sees, FilterBank}
    broken = {
        each
        for each in globals().values()
        if isinstance(each, type) and each.__module__ == __name__
    } - bases
    assert broken == {each for each, _, _ in BROKEN}


@cache
def kept_promise(name: str) -> Callable[[], None]:
    """Return the check of the nonlinear promise, which the shipped estimator passes."""
    check = estimator_checks(name)[NEAR]
    check()
    return check


#: Components of which the derivative is negated.
ROWS = (
    "range_m",
    "bearing_rad",
    "range_rate_mps",
    "x_m",
    "y_m",
    "yaw_rad",
    "speed_mps",
)


@pytest.mark.parametrize(
    ("name", "row"),
    each_once(["ekf-replay", "iekf-replay", "ekf-backward-forward"], ROWS),
)
def test_a_wrong_sign_in_a_row_of_the_measurement_jacobian_breaks_the_nonlinear_promise(
    monkeypatch: pytest.MonkeyPatch, name: str, row: str
) -> None:
    """The estimator and all of its streams are as they are; the shipped measurement model alone is wrong."""
    check = kept_promise(name)
    negate_row(monkeypatch, row)
    with pytest.raises(BrokenPromiseError) as error:
        check()
    assert list(error.value.promises) == [NEAR]
    off = re.match(
        r"the state at .* differs from that of a plain calculation by (\S+) standard",
        error.value.promises[NEAR],
    )
    assert off is not None
    assert (
        float(off[1]) > 0.01
    )  # a thousand times the tolerance, which is 1e-7, or 1e-5 of the filter that iterates


def negate_row(monkeypatch: pytest.MonkeyPatch, row: str) -> None:
    """Negate the derivative of the component `row` in every shipped measurement model, as a plug-in would have it."""
    linear, nonlinear = MeasurementModel.selection, MeasurementModel.jacobian

    def sign(model: MeasurementModel) -> FloatArray:
        return np.where([name == row for name in model.components], -1.0, 1.0)[:, None]

    monkeypatch.setattr(MeasurementModel, "is_compiled", False)
    monkeypatch.setattr(
        MeasurementModel, "selection", lambda model, n: sign(model) * linear(model, n)
    )
    monkeypatch.setattr(
        MeasurementModel,
        "jacobian",
        lambda model, x, pose=AT_ORIGIN: sign(model) * nonlinear(model, x, pose),
    )


@pytest.mark.parametrize("kind", [Sees, FilterBank])
def test_what_they_are_made_of_keeps_the_contract(kind: type) -> None:
    check_estimator(kind, num_streams=2)


def test_the_smallest_stream_that_shows_it_is_given() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        estimator_checks(DropsLateData)[ANY_ORDER]()
    text = error.value.promises[ANY_ORDER]
    assert "differs from the dense joint posterior by" in text
    assert text.count(" s: x_m = ") == 2  # one, and one that comes late


def test_what_is_not_claimed_is_not_checked() -> None:
    check_estimator(ReplayEkf, exact=False, num_streams=2)
    checks = estimator_checks(DropsLateData, exact=False)
    assert ANY_ORDER not in checks
    assert "fuses a late measurement exactly" in estimator_checks("rts")
    with pytest.raises(BrokenPromiseError):
        check_estimator("rts", exact=True)


def test_all_that_is_broken_is_said_at_once() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        check_estimator(DropsLateData)
    assert len(error.value.promises) >= 3
    assert (
        "DropsLateData: broken promise: it keeps all that it accepts and nothing else\n"
        in str(error.value)
    )
