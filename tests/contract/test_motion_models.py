"""Every registered motion model keeps the contract of `fgtrack.testing`, and a wrong one does not."""

import numpy as np
import pytest

from fgtrack.core.types import FloatArray
from fgtrack.estimation.registry import MOTION_MODELS
from fgtrack.models.motion import CTRV, CV, MotionModel, Transition
from fgtrack.testing import BrokenPromiseError, check_motion_model, motion_model_checks


@pytest.mark.parametrize("kind", list(MOTION_MODELS))
def test_every_motion_model_keeps_the_contract(kind: str) -> None:
    check_motion_model(MOTION_MODELS.load(kind)())


class _EulerNoise(CTRV):
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return np.eye(5) * np.asarray(dt_s)[..., None, None]


class _WrongJacobian(CV):
    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return super().jacobian(x, 1.01 * np.asarray(dt_s))


class _InPlace(CV):
    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        x += 0.0 if np.ndim(dt_s) else 1e-3 * float(dt_s)
        return super().predict(x, dt_s)


class _Forwards(CV):
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        return super().process_noise(x, np.abs(dt_s))


class _Polar(CV):
    state_names = ("x_m", "y_m", "speed_mps", "yaw_rad")


class _TooSure(CV):
    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, covariance = super().kinematic(x, P)
        return mean, 1e-4 * covariance


class _Whirls(CV):
    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        mean, covariance = super().kinematic(x, P)
        return mean + 5.0 * (np.arange(mean.shape[-1]) >= 4), covariance


class _NegativeBirth(CV):
    def from_kinematic(
        self, mean: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        x, P = super().from_kinematic(mean, covariance)
        return x, -P


class _OtherTransitionOfMany(CTRV):
    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        found = super().transition(x, dt_s)
        return found._replace(Q=found.Q * (2.0 if len(x) > 3 else 1.0))


@pytest.mark.parametrize(
    ("model", "promise"),
    [
        (_EulerNoise(), "has noise that composes"),
        (_WrongJacobian(), "has the jacobian of its prediction"),
        (_InPlace(), "keeps its inputs"),
        (_Forwards(), "refuses noise of a negative duration"),
        (_Polar(), "has a state that measurements determine"),
        (_TooSure(), "publishes the entries of its state"),
        (_Whirls(), "publishes the entries of its state"),
        (_NegativeBirth(), "is as it was after a kinematic state"),
        (_NegativeBirth(), "begins with a sound covariance"),
        (_OtherTransitionOfMany(), "has the transition of its functions"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, MotionModel) else "",
)
def test_a_broken_model_is_found_out_by_the_promise_that_it_breaks(
    model: MotionModel, promise: str
) -> None:
    with pytest.raises(BrokenPromiseError, match=r"(?s)x = \[.*dt_s = \d") as error:
        motion_model_checks(model)[promise]()
    assert list(error.value.promises) == [promise]


def test_all_that_is_broken_is_said_at_once() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        check_motion_model(_WrongJacobian())
    assert set(error.value.promises) >= {
        "has the jacobian of its prediction",
        "has the transition of its functions",
    }
