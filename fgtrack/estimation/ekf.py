"""The extended Kalman filter's two steps, on stacks of independent states and on one state."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgesv, dgetrs

from fgtrack.core.linalg import identity, psd_solve, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.models.measurement import MeasurementModel, SensorPose
from fgtrack.models.motion import MotionModel


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


def predict(
    mean: FloatArray, covariance: FloatArray, motion: MotionModel, dt_s: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance after `dt_s`: x' = f(x), P' = F P F' + Q (Karle et al. 2023, eqs. 3 and 4).

    Shapes (..., n) and (..., n, n); `dt_s` a number or of shape (...).
    """
    F = motion.jacobian(mean, dt_s)
    spread = F @ covariance @ F.mT + motion.process_noise(mean, dt_s)
    return motion.predict(mean, dt_s), symmetrise(spread)


def correct(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    R: FloatArray,
    model: MeasurementModel,
    pose: SensorPose,
    residual: Callable[[FloatArray, FloatArray], FloatArray] | None = None,
) -> Correction:
    """Fuse z (m, k) with covariance R (m, k, k) into m states (Karle et al. 2023, eqs. 5 to 9).

    `residual` may take the place of the model's own. The posterior covariance is in Joseph form. Raises
    `numpy.linalg.LinAlgError` for a singular S.
    """
    y = (residual or model.residual)(z, model.predict(mean, pose))
    H = model.selection(mean.shape[-1]) if model.linear else model.jacobian(mean, pose)
    return correct_with_innovation(mean, covariance, y, R, H)


def correct_with_innovation(
    mean: FloatArray, covariance: FloatArray, y: FloatArray, R: FloatArray, H: FloatArray
) -> Correction:
    """Fuse the innovations y (m, k) of measurements with Jacobians H (m, k, n) or (k, n)."""
    HP = H @ covariance
    S = HP @ H.mT + R
    solved = psd_solve(S, np.concatenate([HP, y[..., None]], axis=-1))
    K = solved[..., :-1].mT
    A = identity(mean.shape[-1]) - K @ H
    posterior = A @ covariance @ A.mT + K @ R @ K.mT
    nis = np.vecdot(y, solved[..., -1])
    return Correction(mean + np.vecdot(K, y[..., None, :]), symmetrise(posterior), y, np.asarray(nis))


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


def predict_one(
    mean: FloatArray, covariance: FloatArray, motion: MotionModel, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """`predict` of one state, shapes (n,) and (n, n), without the price of a stack."""
    after, F, Q = motion.step(mean.tolist(), dt_s)
    return np.array(after), symmetrise(F.dot(covariance).dot(F.T) + Q)


def correct_one(
    mean: FloatArray, covariance: FloatArray, z: FloatArray, R: FloatArray, model: MeasurementModel, pose: SensorPose
) -> OneCorrection:
    """`correct` of one state, shapes (n,) and (n, n), by one z (k,) with R (k, k), without the price of a stack."""
    y = model.residual(z, model.predict(mean, pose))
    H = model.selection(len(mean)) if model.linear else model.jacobian(mean, pose)
    HP = H.dot(covariance)
    factors, pivots, solved, singular = dgesv(HP.dot(H.T) + R, HP)
    if singular:
        raise np.linalg.LinAlgError("singular matrix")
    weighted, _ = dgetrs(factors, pivots, y)
    K = solved.T
    A = identity(len(mean)) - K.dot(H)
    posterior = A.dot(covariance).dot(A.T) + K.dot(R).dot(K.T)
    return OneCorrection(mean + K.dot(y), symmetrise(posterior), y, float(y.dot(weighted)))
