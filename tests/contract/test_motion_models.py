"""Every registered motion model keeps the contract of `fgtrack.testing`, and a wrong one does not."""

import numpy as np
import pytest

from fgtrack.core.types import FloatArray
from fgtrack.estimation.registry import MOTION_MODELS
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel, Transition
from fgtrack.testing import BrokenPromiseError, check_motion_model, motion_model_checks


@pytest.mark.parametrize("kind", MOTION_MODELS)
def test_every_motion_model_keeps_the_contract(kind: str) -> None:
    check_motion_model(MOTION_MODELS.load(kind)())


class _EulerNoise(CTRV):
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return np.eye(5) * np.asarray(dt_s)[..., None, None]


class _WrongJacobian(CV):
    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return super().jacobian(x, 1.01 * np.asarray(dt_s))


class _OneStateOnly(CV):
    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return super().predict(x.reshape(-1, 4)[0], float(np.ravel(dt_s)[0]))


class _InPlace(CV):
    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        x += 0.0 if np.ndim(dt_s) else 1e-3 * float(dt_s)
        return super().predict(x, dt_s)


class _SaysLinear(CTRV):
    linear = True


class _Forwards(CV):
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return super().process_noise(x, np.abs(dt_s))


class _Lopsided(CV):
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        Q = super().process_noise(x, dt_s)
        Q[..., 0, 3] += 1e-12
        return Q


class _Jumps(CV):
    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        after = super().predict(x, dt_s)
        after[..., 0] += np.asarray(dt_s) ** 2
        return after


class _Polar(CV):
    state_names = ("x_m", "y_m", "speed_mps", "yaw_rad")


class _Offset(CTRV):
    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        return x + 1.0, P


class _TooSure(CV):
    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, covariance = super().kinematic(x, P)
        return mean, 1e-4 * covariance


class _Whirls(CV):
    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, covariance = super().kinematic(x, P)
        return mean + 5.0 * (np.arange(mean.shape[-1]) >= 4), covariance


class _NoNumber(CV):
    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, covariance = super().kinematic(x, P)
        return mean, np.nan * covariance


class _NegativeBirth(CV):
    def from_kinematic(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        x, P = super().from_kinematic(mean, covariance)
        return x, -P


class _NegativeStart(CTRA):
    def start_variance(self, name: str) -> float:
        return -3.0


class _OtherTransitionOfMany(CTRV):
    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        found = super().transition(x, dt_s)
        return found._replace(Q=found.Q * (2.0 if len(x) > 3 else 1.0))


class _NegativeBeyondHalfASecond(CTRV):
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        Q = super().process_noise(x, dt_s)
        return Q * np.where(np.asarray(dt_s) > 0.5, -1.0, 1.0)[..., None, None]


@pytest.mark.parametrize(
    ("model", "promise"),
    [
        (_EulerNoise(), "has noise that composes"),
        (_WrongJacobian(), "has the jacobian of its prediction"),
        (_OneStateOnly(), "takes arrays of states and durations"),
        (_InPlace(), "keeps its inputs"),
        (_SaysLinear(), "has the same jacobian everywhere if linear"),
        (_Forwards(), "refuses noise of a negative duration"),
        (_Lopsided(), "has noise that is symmetric and positive definite"),
        (_Jumps(), "flows on where it stopped"),
        (_Polar(), "has a state that measurements know"),
        (_Offset(), "is as it was after a kinematic state"),
        (_TooSure(), "publishes the entries of its state"),
        (_Whirls(), "publishes the entries of its state"),
        (_NoNumber(), "publishes the entries of its state"),
        (_NegativeBirth(), "is as it was after a kinematic state"),
        (_NegativeBirth(), "begins with a sound covariance"),
        (_NegativeStart(), "begins with a sound covariance"),
        (_OtherTransitionOfMany(), "has the transition of its functions"),
        (_NegativeBeyondHalfASecond(), "has noise that is symmetric and positive definite"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, MotionModel) else "",
)
def test_a_broken_model_is_found_out_by_the_promise_that_it_breaks(model: MotionModel, promise: str) -> None:
    with pytest.raises(BrokenPromiseError, match=r"(?s)x = \[.*dt_s = \d") as error:
        motion_model_checks(model)[promise]()
    assert list(error.value.promises) == [promise]


def test_all_that_is_broken_is_said_at_once() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        check_motion_model(_WrongJacobian())
    assert set(error.value.promises) >= {"has the jacobian of its prediction", "has the transition of its functions"}
