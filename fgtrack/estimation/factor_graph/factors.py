"""gtsam factors that call the motion and measurement models; no equation of their own.

Errors are whitened here, because a motion factor's noise follows the state that it starts from.
"""

from collections.abc import Callable, Mapping

import gtsam
import numpy as np
from gtsam.noiseModel import mEstimator
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.factor_graph.terms import EquivalentMeasurement, MeasurementTerm, linearised
from fgtrack.models.motion import MotionModel
from fgtrack.models.sensors import RobustLoss

_Loss = mEstimator.Huber | mEstimator.Cauchy | mEstimator.Tukey | mEstimator.GemanMcClure | mEstimator.DCS

_LOSSES: Mapping[str, Callable[[float], _Loss]] = {
    "huber": mEstimator.Huber.Create,
    "cauchy": mEstimator.Cauchy.Create,
    "tukey": mEstimator.Tukey.Create,
    "geman_mcclure": mEstimator.GemanMcClure.Create,
    "dcs": lambda width: mEstimator.DCS.Create(width * width),  # gtsam's is in squared deviations
}


def prior_factor(key: int, mean: FloatArray, covariance: FloatArray) -> gtsam.NonlinearFactor:
    """N(mean, covariance) of the state at `key`; shapes (n,) and (n, n)."""
    return gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Gaussian.Covariance(covariance))


def motion_factor(motion: MotionModel, left: int, right: int, dt_s: float) -> gtsam.NonlinearFactor:
    """The state at `right` is that at `left` moved by `dt_s`, with the process noise of that time.

    The error is L^-1 (x_right - f(x_left)), with L L' = Q(x_left, dt) taken at the same state: no derivative of L is
    taken, so this is Gauss-Newton with reweighting. Where it converges its answer does not depend on where it began;
    over long gaps whole steps may swing between two answers (see `Window.converge_damped`).
    """
    n = motion.dim
    both = np.zeros((n, 2 * n + 1), order="F")
    both[:, n : 2 * n] = np.eye(n)
    flow, error_column = both[:, :n], both[:, 2 * n]
    kept: list[FloatArray] = []  # L of the last linearisation: a line search compares errors of one and the same noise

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        step = motion.step(values.atVector(left).tolist(), dt_s)
        if jacobians is not None or not kept:
            kept[:] = [_root(step.Q)]
        np.subtract(values.atVector(right), step.mean, out=error_column)
        if jacobians is None:
            return _whitened(kept[0], both)[:, 2 * n]
        np.negative(step.F, out=flow)
        whitened = _whitened(kept[0], both)
        jacobians[0], jacobians[1] = whitened[:, :n], whitened[:, n : 2 * n]
        return whitened[:, 2 * n]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(n), [left, right], error)


def measurement_factor(key: int, term: MeasurementTerm, mean: FloatArray) -> gtsam.NonlinearFactor:
    """What `term` says of the state at `key`, presently near `mean` (n,).

    A linear model with a Gaussian needs no callback; its angles are taken on the branch next to `mean`. Raises
    `numpy.linalg.LinAlgError` for a covariance that is not positive definite.
    """
    if isinstance(term, EquivalentMeasurement) or (term.model.linear and term.loss is None):
        y, H, R = linearised(term, mean)
        return _linear_factor(key, mean, y, H, _root(R))
    return _callback_factor(key, term)


def _linear_factor(
    key: int, origin: FloatArray, y: FloatArray, H: FloatArray, root: FloatArray
) -> gtsam.NonlinearFactor:
    k = len(y)
    whitened = _whitened(root, np.column_stack([H, y]))
    linear = gtsam.JacobianFactor(key, whitened[:, :-1], whitened[:, -1], gtsam.noiseModel.Unit.Create(k))
    at = gtsam.Values()
    at.insert(key, origin)
    return gtsam.LinearContainerFactor(linear, at)


def _callback_factor(key: int, measurement: Measurement) -> gtsam.NonlinearFactor:
    model, z, pose = measurement.model, measurement.z, measurement.pose
    root = _root(measurement.R)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        x = values.atVector(key)
        if jacobians is not None:
            jacobians[0] = _whitened(root, model.jacobian(x, pose))
        return _whitened(root, -model.residual(z, model.predict(x, pose))[:, None])[:, 0]

    return gtsam.CustomFactor(_noise(measurement.loss, len(z)), [key], error)


def weight(loss: RobustLoss, distance: float) -> float:
    """What a measurement counts under `loss`, 1 for all of it, at a whitened residual of length `distance`."""
    return _LOSSES[loss.kind](loss.width).weight(distance)


def _noise(loss: RobustLoss | None, k: int) -> gtsam.noiseModel.Base:
    unit = gtsam.noiseModel.Unit.Create(k)
    return unit if loss is None else gtsam.noiseModel.Robust.Create(_LOSSES[loss.kind](loss.width), unit)


def _whitened(root: FloatArray, columns: FloatArray) -> FloatArray:
    """L^-1 times `columns` (k, m); by BLAS, because LAPACK's dtrtrs starts threads for the smallest matrix."""
    return np.asarray(dtrsm(1.0, root, columns, lower=1))


def _root(covariance: FloatArray) -> FloatArray:
    """Lower Cholesky factor, shape (k, k)."""
    root: FloatArray
    root, info = dpotrf(covariance, lower=1)
    if info:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return root
