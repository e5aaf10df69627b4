"""Every registered motion model keeps the contract of `fgtrack.testing`, and a wrong one does not."""

import numpy as np
import pytest

from fgtrack.core.types import FloatArray
from fgtrack.estimation.registry import MOTION_MODELS
from fgtrack.models.motion import CTRV, CV, MotionModel
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


class _OtherStep(CTRV):
    def flow(self, x, dt_s):
        mean, F = super().flow(x, dt_s)
        return [mean[0] + 0.1, *mean[1:]], F


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


@pytest.mark.parametrize(
    ("model", "promise"),
    [
        (_EulerNoise(), "has noise that composes"),
        (_WrongJacobian(), "has the jacobian of its prediction"),
        (_OneStateOnly(), "takes arrays of states and durations"),
        (_InPlace(), "keeps its inputs"),
        (_SaysLinear(), "has the same jacobian everywhere if linear"),
        (_Forwards(), "refuses noise of a negative duration"),
        (_OtherStep(), "steps one state as it predicts arrays"),
        (_Lopsided(), "has noise that is symmetric and positive definite"),
        (_Jumps(), "flows on where it stopped"),
        (_Polar(), "has a state that measurements know"),
        (_Offset(), "is as it was after a kinematic state"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, MotionModel) else "",
)
def test_a_broken_model_is_found_out_by_the_promise_that_it_breaks(model: MotionModel, promise: str) -> None:
    with pytest.raises(BrokenPromiseError, match=r"(?s)x = \[.*dt_s = 0\.") as error:
        motion_model_checks(model)[promise]()
    assert list(error.value.promises) == [promise]


def test_all_that_is_broken_is_said_at_once() -> None:
    with pytest.raises(BrokenPromiseError) as error:
        check_motion_model(_WrongJacobian())
    assert set(error.value.promises) >= {"has the jacobian of its prediction", "steps one state as it predicts arrays"}
