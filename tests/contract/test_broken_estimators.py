"""An estimator that breaks one promise is found out by that promise, with measurements that show it."""

import numpy as np
import pytest

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement, Start, UpdateResult, UpdateStatus
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.models.motion import MotionModel
from fgtrack.testing import BrokenPromiseError, check_estimator, estimator_checks


class Sound(ReplayEkf):
    """What the broken ones are made of."""

    def __init__(self, motion: MotionModel, start: Start, lag_s: float) -> None:
        super().__init__(motion, start, lag_s)
        self.motion, self.start = motion, start

    def late(self, measurement: Measurement) -> bool:
        return measurement.stamp_ns < self.window_ns[1]


class DropsLateData(Sound):
    def update(self, measurement: Measurement) -> UpdateResult:
        if self.late(measurement) and measurement.stamp_ns >= self.window_ns[0]:
            return UpdateResult(UpdateStatus.OUT_OF_SEQUENCE, np.zeros(len(measurement.z)), 0.0)
        return super().update(measurement)


class ForgetsEqualStamps(Sound):
    def update(self, measurement: Measurement) -> UpdateResult:
        if measurement.stamp_ns == self.window_ns[1] > self.start.stamp_ns and np.isfinite(measurement.z).all():
            return UpdateResult(UpdateStatus.IN_SEQUENCE, np.zeros(len(measurement.z)), 0.0)
        return super().update(measurement)


class DoublesTheNoise(Sound):
    def update(self, measurement: Measurement) -> UpdateResult:
        return super().update(Measurement(measurement.stamp_ns, measurement.model, measurement.z, 2.0 * measurement.R))


class SaysInSequence(Sound):
    def update(self, measurement: Measurement) -> UpdateResult:
        result = super().update(measurement)
        fused = result.nis is not None
        return UpdateResult(UpdateStatus.IN_SEQUENCE, result.innovation, result.nis) if fused else result


class Lopsided(Sound):
    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        covariance = state.covariance.copy()
        covariance[0, 1] += 1e-9
        return TrackState(stamp_ns, state.mean, covariance)


class Random(Sound):
    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        return TrackState(stamp_ns, state.mean + 1e-14 * np.random.default_rng().standard_normal(), state.covariance)


class SharesItsState(Sound):
    def __init__(self, motion: MotionModel, start: Start, lag_s: float) -> None:
        super().__init__(motion, start, lag_s)
        self.shared = np.zeros(motion.dim)

    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(stamp_ns)
        self.shared[:] = state.mean
        return TrackState(stamp_ns, self.shared, state.covariance)


class FusesWhatIsTooOld(Sound):
    def update(self, measurement: Measurement) -> UpdateResult:
        old_ns = self.window_ns[0]
        if measurement.stamp_ns < old_ns:
            super().update(Measurement(old_ns, measurement.model, measurement.z, measurement.R))
            return UpdateResult(UpdateStatus.TOO_OLD)
        return super().update(measurement)


class FusesWhatIsNoNumber(Sound):
    def update(self, measurement: Measurement) -> UpdateResult:
        z = np.nan_to_num(measurement.z)
        return super().update(Measurement(measurement.stamp_ns, measurement.model, z, measurement.R))


class ForgetsWithTheClock(Sound):
    def advance(self, now_ns: int) -> None:
        super().advance(now_ns)
        if now_ns > self.window_ns[1] and self._steps:
            self._steps[-1].mean = self._steps[-1].mean + 1e-3


class StandsStill(Sound):
    def state_at(self, stamp_ns: int) -> TrackState:
        state = super().state_at(min(stamp_ns, self.window_ns[1]))
        return TrackState(stamp_ns, state.mean, state.covariance)


@pytest.mark.parametrize(
    ("broken", "promise"),
    [
        (DropsLateData, "gives the dense joint posterior in any order"),
        (DropsLateData, "gives the estimate of the time order in any order"),
        (DropsLateData, "keeps all that it accepts and nothing else"),
        (ForgetsEqualStamps, "gives the dense joint posterior in any order"),
        (DoublesTheNoise, "is the kalman filter in sequence"),
        (DoublesTheNoise, "reports the innovation against all that it has fused"),
        (SaysInSequence, "counts each measurement as what it is"),
        (Lopsided, "gives symmetric positive definite covariances"),
        (Random, "gives the same bits for the same input"),
        (SharesItsState, "changes no input and no output later"),
        (FusesWhatIsTooOld, "reports what is too old and stays as it was"),
        (FusesWhatIsNoNumber, "stays as it was after a failure and fuses the next"),
        (ForgetsWithTheClock, "moves only the window with the clock"),
        (StandsStill, "predicts ahead by the motion model"),
    ],
)
def test_a_broken_estimator_is_found_out(broken: type[Sound], promise: str) -> None:
    with pytest.raises(BrokenPromiseError, match="measurements in the order of arrival") as error:
        estimator_checks(broken)[promise]()
    assert list(error.value.promises) == [promise]


def test_the_smallest_stream_that_shows_it_is_given() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        estimator_checks(DropsLateData)["gives the dense joint posterior in any order"]()
    text = error.value.promises["gives the dense joint posterior in any order"]
    assert "differs from the dense joint posterior by" in text
    assert text.count(" s: x_m = ") == 2  # one, and one that comes late


def test_what_is_not_claimed_is_not_checked() -> None:
    check_estimator(Sound, exact=False, num_streams=2)
    checks = estimator_checks(DropsLateData, exact=False)
    assert "gives the dense joint posterior in any order" not in checks
    assert "fuses a late measurement exactly" in estimator_checks("rts")
    with pytest.raises(BrokenPromiseError):
        check_estimator("rts", exact=True)


def test_all_that_is_broken_is_said_at_once() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        check_estimator(DropsLateData)
    assert len(error.value.promises) >= 3
    assert "DropsLateData: broken promise: it keeps all that it accepts and nothing else\n" in str(error.value)
