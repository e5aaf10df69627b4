"""What is wrong in a nonlinear model alone, or with several objects, is found out as well."""

from dataclasses import replace

import numpy as np
import pytest

from fgtrack.core.types import TrackState
from fgtrack.estimation.base import Measurement, StatesAt, UpdateResult
from fgtrack.estimation.filters.ekf import correct_one
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.models.motion import MotionModel
from fgtrack.testing import BrokenPromiseError, check_estimator, estimator_checks

NEAR = "comes near the posterior of a nonlinear model"
SEVERAL = "gives each of several objects what it gives one alone"
COUNTS = "counts each measurement as what it is"


class Sees(ReplayEkf):
    """Fuses another measurement in a nonlinear model; linear ones it takes as they are."""

    def update(self, measurement: Measurement) -> UpdateResult:
        known = self.window_ns[0] <= measurement.stamp_ns and np.isfinite(measurement.z).all()
        before = self.state_at(measurement.stamp_ns) if known else None
        late = measurement.stamp_ns <= self.window_ns[1]
        result = super().update(measurement if self._motion.linear else self.seen(measurement))
        if result.nis is None or before is None or late:
            return result
        said = correct_one(before.mean, before.covariance, measurement.seen_by(self._motion))
        return replace(result, innovation=said.innovation, nis=said.nis, innovation_covariance=said.S)

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
        return super().present()[::-1]


class GivesOneForAll(FilterBank):
    def states_at(self, stamp_ns: int) -> StatesAt:
        states = super().states_at(stamp_ns)
        return replace(states, means=np.repeat(states.means[:1], len(states.means), axis=0))


@pytest.mark.parametrize(
    ("broken", "promise"),
    [
        (WithQuadrupleNoise, NEAR),
        (WithoutPose, NEAR),
        (WithoutLoss, NEAR),
        (SaysAnotherCovariance, COUNTS),
        (RemovesTheNext, SEVERAL),
        (ShowsAnother, SEVERAL),
        (GivesOneForAll, SEVERAL),
    ],
)
def test_what_is_broken_is_found_out_by_its_promise(broken: type, promise: str) -> None:
    with pytest.raises(BrokenPromiseError, match="measurements in the order of arrival") as error:
        estimator_checks(broken)[promise]()
    assert list(error.value.promises) == [promise]


@pytest.mark.parametrize("kind", [Sees, FilterBank])
def test_what_they_are_made_of_keeps_the_contract(kind: type) -> None:
    check_estimator(kind, num_streams=2)
