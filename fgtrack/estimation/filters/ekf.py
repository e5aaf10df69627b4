"""The two steps of the extended Kalman filter, predict and correct, on stacks of independent states."""

import math
from functools import partial
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from fgtrack.core.linalg import (
    congruence,
    kernels,
    stacked,
    symmetrise,
)
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import Measurement
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import compiled_form
from fgtrack.models.sensors import RobustLoss

T = TypeVar("T", float, FloatArray)
_copied = partial(np.array, dtype=np.float64, order="C")
_KALMAN = "fgtrack.estimation.kernels.kalman"


def propagated(F: FloatArray, P: FloatArray, Q: FloatArray) -> FloatArray:
    """Return the covariance F P F' + Q of F x + w, where x has the covariance P and w has Q, shape (..., m, m)."""
    return symmetrise(congruence(F, P) + Q)


def robust_weight(
    loss: RobustLoss | None, y: FloatArray, spread: FloatArray, R: FloatArray
) -> float:
    """Return the weight under a robust loss of an innovation y (k,) with covariance `spread` + R, both (k, k).

    The weight is 1 without a loss. See `fgtrack.estimation.kernels.kalman.robust_weight`. Raises
    `numpy.linalg.LinAlgError` if the covariance is not positive definite.
    """
    if loss is None:
        return 1.0
    found: float = kernels(_KALMAN).robust_weight_of(
        *(np.ascontiguousarray(each, dtype=np.float64) for each in (spread, R, y)),
        *compiled_form(loss, len(y)),
    )
    if math.isnan(found):
        raise np.linalg.LinAlgError("innovation covariance not positive definite")
    return found


class Correction(NamedTuple, Generic[T]):
    """Result of the correction of one state. For m states each array has m as first dimension."""

    mean: FloatArray
    """Posterior mean, shape (n,); angles are not wrapped."""
    covariance: FloatArray
    """Posterior covariance, shape (n, n)."""
    innovation: FloatArray
    """Measured minus predicted values, shape (k,)."""
    nis: T
    """Normalised innovation squared."""
    weight: T
    """Weight of the measurement under its loss, at most 1."""
    S: FloatArray
    """Covariance of the innovation, shape (k, k), before any loss."""
    fused: BoolArray = np.ones(1, dtype=bool)
    """True where S was positive definite and the posterior is finite, shape (m,)."""


OneCorrection = Correction[float]


class Prediction(NamedTuple):
    """A predicted state, or a stack of predicted states, with its covariance with the state before."""

    mean: FloatArray
    """Shape (..., n); angles are not wrapped."""
    covariance: FloatArray
    """Shape (..., n, n)."""
    cross: FloatArray
    """Covariance of the predicted state (rows) with the state before (columns), F P to first order; shape (..., n,
    n).
    """


def predict(
    mean: FloatArray,
    covariance: FloatArray,
    motion: MotionModel,
    dt_s: FloatArray | float,
) -> tuple[FloatArray, FloatArray]:
    """Return the mean f(x) (..., n) and the covariance F P F' + Q (..., n, n) after `dt_s` (...).

    Source: Karle et al. 2023, eqs. 3 and 4.
    """
    return predict_across(mean, covariance, motion, dt_s)[:2]


def predict_across(
    mean: FloatArray,
    covariance: FloatArray,
    motion: MotionModel,
    dt_s: FloatArray | float,
) -> Prediction:
    """Return the prediction of `predict`, with the cross-covariance F P of the predicted state and the state before."""
    after, F, Q = motion.transition(mean, dt_s)
    shape, n = Q.shape, Q.shape[-1]
    F, P, Q = (
        np.array(each, order="C") for each in (F, np.broadcast_to(covariance, shape), Q)
    )
    _, cross = kernels(_KALMAN).predict(*(each.reshape(-1, n, n) for each in (F, P, Q)))
    return Prediction(after, Q, cross.reshape(shape))


def correct(
    mean: FloatArray,
    covariance: FloatArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    measured: IntArray | None = None,
    loss: RobustLoss | None = None,
) -> Correction[FloatArray]:
    """Fuse innovations y (m, k), with Jacobians H (m, k, n) or (k, n) and covariances R (m, k, k), into m states.

    `measured` has the indices of the components that count for the NIS, see `Measurement.measured`. `loss` is the
    robust loss of all measurements, see `robust_weight`. Source: Karle et al. 2023, eqs. 5 to 9.
    """
    rows = np.arange(y.shape[-1]) if measured is None else measured
    m, x, P, H = len(mean), _copied(mean), _copied(covariance), stacked(H)
    y, R = np.ascontiguousarray(y), np.ascontiguousarray(R)
    S, nis, w = np.empty(R.shape), np.empty(m), np.empty(m)
    kernels(_KALMAN).correct(
        x, P, y, H, R, rows, *compiled_form(loss, y.shape[1]), S, nis, w
    )
    return Correction(x, P, y, nis, w, S, ~np.isnan(w))


def updated_one(
    mean: FloatArray,
    covariance: FloatArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    loss: RobustLoss | None = None,
    measured: IntArray | None = None,
) -> OneCorrection:
    """Return one state, (n,) and (n, n), after the innovation y (k,) of a measurement with H (k, n) and R (k, k).

    Raises `numpy.linalg.LinAlgError` if the measurement cannot be fused.
    """
    x, P, y, nis, w, S, fused = correct(
        mean[None], covariance[None], y[None], H, R[None], measured, loss
    )
    if not fused[0]:
        raise np.linalg.LinAlgError(
            "innovation covariance not positive definite, or posterior not finite"
        )
    return Correction(x[0], P[0], y[0], float(nis[0]), float(w[0]), S[0])


def correct_one(
    mean: FloatArray, covariance: FloatArray, measurement: Measurement
) -> OneCorrection:
    """Return one state, shapes (n,) and (n, n), after `measurement`. Raises the exceptions of `updated_one`."""
    y, H = measurement.model.linearised(measurement.z, mean, measurement.pose)
    return updated_one(
        mean, covariance, y, H, measurement.R, measurement.loss, measurement.measured
    )
