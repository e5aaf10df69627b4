"""The extended Kalman filter's two steps, on stacks of independent states and on one state."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import (
    applied,
    congruence,
    identity,
    mahalanobis_squared,
    product,
    psd_solve,
    symmetrise,
    times_transposed,
)
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement
from fgtrack.models.measurement import MeasurementModel, SensorPose
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import weight
from fgtrack.models.sensors import RobustLoss

_MAX_REWEIGHTINGS = 50
_REWEIGHTING_TOLERANCE = 1e-9


def propagated(F: FloatArray, P: FloatArray, Q: FloatArray) -> FloatArray:
    """Covariance F P F' + Q of F x + N(0, Q), shape (..., m, m)."""
    return symmetrise(congruence(F, P) + Q)


def kalman_gain(P: FloatArray, H: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gain K = P H' S^-1, shape (..., n, k), and covariance S = H P H' + R of the innovation, (..., k, k).

    Raises `numpy.linalg.LinAlgError` for a singular S.
    """
    S, solved = _solved(P, H, R)
    return solved.mT, S


def _solved(P: FloatArray, H: FloatArray, R: FloatArray, *columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """S, and S^-1 times H P and further columns."""
    HP = product(H, P)
    S = times_transposed(HP, H) + R
    return S, psd_solve(S, np.concatenate([HP, *columns], axis=-1) if columns else HP)


def joseph(P: FloatArray, K: FloatArray, H: FloatArray, R: FloatArray) -> FloatArray:
    """Covariance (I - K H) P (I - K H)' + K R K' after a measurement H x + N(0, R) with any gain K, (..., n, n)."""
    A = identity(P.shape[-1]) - product(K, H)
    return symmetrise(congruence(A, P) + congruence(K, R))


def linearised(
    z: FloatArray,
    x: FloatArray,
    model: MeasurementModel,
    pose: SensorPose,
    residual: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Innovation y (..., k) of z (..., k) at the states x (..., n), and its Jacobian H (k, n) or (..., k, n).

    `residual` may take the place of the model's own.
    """
    y = (residual or model.residual)(z, model.predict(x, pose))
    return y, model.selection(x.shape[-1]) if model.linear else model.jacobian(x, pose)


def robust_weight(loss: RobustLoss | None, y: FloatArray, spread: FloatArray, R: FloatArray) -> float:
    """Weight w of an innovation y (k,) with covariance `spread` + R, both (k, k), under a robust loss.

    At w the correction with R / w minimises prior plus loss of the residual r that is left of y: r = R / w S^-1 y with
    S = `spread` + R / w, and w is the loss's weight at sqrt(r' R^-1 r). Reweighting from w = 1 on never lets w grow, so
    it ends at the largest such weight: the minimum that is reached from the estimate without a loss. 1 without a
    `loss`. Raises `numpy.linalg.LinAlgError` for a singular S.
    """
    w = 1.0
    if loss is None:
        return w
    for _ in range(_MAX_REWEIGHTINGS):
        solved = psd_solve(spread + R / w, y)
        new = weight(loss, math.sqrt(max(float(solved.dot(R.dot(solved))), 0.0)) / w)
        if not new < w * (1.0 - _REWEIGHTING_TOLERANCE):
            break
        w = new
    return w


class Correction(NamedTuple):
    """Result of `correct` for m independent states."""

    mean: FloatArray
    """Posterior means, shape (m, n); angles are not wrapped."""
    covariance: FloatArray
    """Posterior covariances, shape (m, n, n)."""
    innovation: FloatArray
    """Shape (m, k)."""
    nis: FloatArray
    """Normalised innovation squared, shape (m,)."""
    S: FloatArray
    """Covariances of the innovations, shape (m, k, k), before any loss."""


class Prediction(NamedTuple):
    """A state after some time, or a stack of them, and how it depends on that before."""

    mean: FloatArray
    """Shape (..., n); angles are not wrapped."""
    covariance: FloatArray
    """Shape (..., n, n)."""
    cross: FloatArray
    """Covariance of the state after (rows) and before (columns), of first order F P; shape (..., n, n)."""

    def at(self, rows: IntArray | slice) -> "Prediction":
        """Those at `rows` of a stack."""
        return Prediction(self.mean[rows], self.covariance[rows], self.cross[rows])


def predict(
    mean: FloatArray, covariance: FloatArray, motion: MotionModel, dt_s: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance after `dt_s`: x' = f(x), P' = F P F' + Q (Karle et al. 2023, eqs. 3 and 4).

    Shapes (..., n) and (..., n, n); `dt_s` a number or of shape (...).
    """
    return predict_across(mean, covariance, motion, dt_s)[:2]


def correct(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    R: FloatArray,
    model: MeasurementModel,
    pose: SensorPose,
    residual: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
    measured: Sequence[int] | None = None,
    losses: Sequence[RobustLoss | None] = (),
) -> Correction:
    """Fuse z (m, k) with covariance R (m, k, k) into m states (Karle et al. 2023, eqs. 5 to 9).

    `residual` may take the place of the model's own; `measured` is `Measurement.measured`, for the NIS; `losses`, none
    or m of them, are those of the measurements (see `robust_weight`). The posterior covariance is in Joseph form.
    Raises `numpy.linalg.LinAlgError` for a singular S.
    """
    y, H = linearised(z, mean, model, pose, residual)
    found = correct_with_innovation(mean, covariance, y, R, H, measured)
    if not any(losses):
        return found
    parts = zip(losses, y, congruence(H, covariance), R, strict=True)
    w = np.array([robust_weight(*part) for part in parts])
    return correct_with_innovation(mean, covariance, y, R / w[:, None, None], H)._replace(nis=found.nis, S=found.S)


def correct_with_innovation(
    mean: FloatArray,
    covariance: FloatArray,
    y: FloatArray,
    R: FloatArray,
    H: FloatArray,
    measured: Sequence[int] | None = None,
) -> Correction:
    """Fuse the innovations y (m, k) of measurements with Jacobians H (m, k, n) or (k, n)."""
    S, solved = _solved(covariance, H, R, y[..., None])
    K = solved[..., :-1].mT
    nis = np.vecdot(y, solved[..., -1]) if measured is None else mahalanobis_squared(y, S, measured)
    return Correction(mean + applied(K, y), joseph(covariance, K, H, R), y, np.asarray(nis), S)


class OneCorrection(NamedTuple):
    """Result of `correct_one`."""

    mean: FloatArray
    """Posterior mean, shape (n,); angles are not wrapped."""
    covariance: FloatArray
    """Posterior covariance, shape (n, n)."""
    innovation: FloatArray
    """Shape (k,)."""
    nis: float
    """Normalised innovation squared."""
    weight: float = 1.0
    """What the measurement counted under its loss; 1 for all of it."""
    S: FloatArray | None = None
    """Covariance of the innovation, shape (k, k), before any loss."""


def predict_across(
    mean: FloatArray, covariance: FloatArray, motion: MotionModel, dt_s: FloatArray | float
) -> Prediction:
    """`predict`, and the cross-covariance of both states, which is half way to the covariance."""
    after, F, Q = motion.transition(mean, dt_s)
    FP = product(F, covariance)
    return Prediction(after, symmetrise(times_transposed(FP, F) + Q), FP)


class Update(NamedTuple):
    """Result of `updated_one`."""

    mean: FloatArray
    """Posterior mean, shape (n,); angles are not wrapped."""
    covariance: FloatArray
    """Posterior covariance, shape (n, n)."""
    S: FloatArray
    """Covariance of the innovation without a loss, shape (k, k)."""
    weight: float
    """See `robust_weight`."""


def updated_one(
    mean: FloatArray,
    covariance: FloatArray,
    y: FloatArray,
    H: FloatArray,
    R: FloatArray,
    loss: RobustLoss | None = None,
) -> Update:
    """One state, (n,) and (n, n), after the innovation y (k,) of a measurement with Jacobian H (k, n), noise R (k, k).

    Raises `numpy.linalg.LinAlgError` for a singular S.
    """
    K, S = kalman_gain(covariance, H, R)
    w = 1.0
    if loss is not None:
        w = robust_weight(loss, y, congruence(H, covariance), R)
        R = R / w
        K, _ = kalman_gain(covariance, H, R)
    return Update(mean + K.dot(y), joseph(covariance, K, H, R), S, w)


def correct_one(mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> OneCorrection:
    """`correct` of one state, shapes (n,) and (n, n), without the price of a stack."""
    y, H = linearised(measurement.z, mean, measurement.model, measurement.pose)
    after, P, S, w = updated_one(mean, covariance, y, H, measurement.R, measurement.loss)
    return OneCorrection(after, P, y, measurement.nis(y, S), w, S)


class Innovation(NamedTuple):
    """What a measurement says that was not expected."""

    innovation: FloatArray
    """Shape (k,)."""
    nis: float
    S: FloatArray
    """Covariance of the innovation, shape (k, k)."""


def innovations(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    R: FloatArray,
    model: MeasurementModel,
    pose: SensorPose,
    measured: Sequence[int] | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Innovation (..., k), NIS (...) and S (..., k, k) of `correct` alone; of one state or a stack of them."""
    y, H = linearised(z, mean, model, pose)
    S = congruence(H, covariance) + R
    return y, mahalanobis_squared(y, S, measured), S


def innovation_one(mean: FloatArray, covariance: FloatArray, measurement: Measurement) -> Innovation:
    """The innovation of `measurement` at one state, shapes (n,) and (n, n), which stays as it is."""
    own = measurement
    y, nis, S = innovations(mean, covariance, own.z, own.R, own.model, own.pose, own.measured)
    return Innovation(y, float(nis), S)
