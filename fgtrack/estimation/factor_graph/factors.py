"""gtsam factors that call the motion and measurement models, for an optimiser that tries states; no equation of their
own."""

from collections.abc import Callable, Mapping

import gtsam
import numpy as np
from gtsam.noiseModel import mEstimator

from fgtrack.core.linalg import identity, inverse_roots, noise_roots
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.terms import EquivalentMeasurement, Linearised, MeasurementTerm, linearised
from fgtrack.models.motion import MotionModel

_Loss = mEstimator.Huber | mEstimator.Cauchy | mEstimator.Tukey | mEstimator.GemanMcClure | mEstimator.DCS

_LOSSES: Mapping[str, Callable[[float], _Loss]] = {
    "huber": mEstimator.Huber.Create,
    "cauchy": mEstimator.Cauchy.Create,
    "tukey": mEstimator.Tukey.Create,
    "geman_mcclure": mEstimator.GemanMcClure.Create,
    "dcs": lambda width: mEstimator.DCS.Create(width * width),  # gtsam's is in squared standard deviations
}


def prior_factor(key: int, mean: FloatArray, covariance: FloatArray) -> gtsam.NonlinearFactor:
    """N(mean, covariance) of the state at `key`; shapes (n,) and (n, n)."""
    return gtsam.PriorFactorVector(key, mean, gtsam.noiseModel.Gaussian.Covariance(covariance))


def motion_factor(motion: MotionModel, left: int, right: int, dt_s: float, at: FloatArray) -> gtsam.NonlinearFactor:
    """The state at `right` is that at `left` moved by `dt_s`, with the process noise Q(`at`, dt_s).

    `at`, shape (n,), is the linearisation point of `left`. No derivative of Q is taken: where the factor is replaced
    when that point moves, this is Gauss-Newton with reweighting.
    """
    at = at.copy()
    step, still = motion.transition(at, dt_s), identity(motion.dim)

    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        x = values.atVector(left)
        moved = step if np.array_equal(x, at) else motion.transition(x, dt_s)  # the former in nearly every call
        if jacobians is not None:
            jacobians[0], jacobians[1] = -moved.F, still
        return np.subtract(values.atVector(right), moved.mean)

    return gtsam.CustomFactor(_gaussian(noise_roots(step.Q)), [left, right], error)


def measurement_factor(key: int, term: MeasurementTerm, mean: FloatArray) -> gtsam.NonlinearFactor:
    """The factor of `term` on the state at `key`, presently near `mean` (n,).

    A linear model with a Gaussian needs no callback; its angles are taken on the branch next to `mean`. Raises
    `numpy.linalg.LinAlgError` for a covariance that is not positive definite.
    """
    if isinstance(term, EquivalentMeasurement) or (term.model.linear and term.loss is None):
        return _linear_factor(key, mean, linearised(term, mean))
    return _callback_factor(key, term)


def _linear_factor(key: int, origin: FloatArray, term: Linearised) -> gtsam.NonlinearFactor:
    W = inverse_roots(term.R)
    linear = gtsam.JacobianFactor(key, W @ term.H, W @ term.y, gtsam.noiseModel.Unit.Create(len(term.y)))
    at = gtsam.Values()
    at.insert(key, origin)
    return gtsam.LinearContainerFactor(linear, at)


def _callback_factor(key: int, measurement: Measurement) -> gtsam.NonlinearFactor:
    def error(this: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        y, H, _ = linearised(measurement, values.atVector(key))
        if jacobians is not None:
            jacobians[0] = H
        return -y

    noise, loss = _gaussian(inverse_roots(measurement.R)), measurement.loss
    if loss is not None:
        noise = gtsam.noiseModel.Robust.Create(_LOSSES[loss.kind](loss.width), noise)
    return gtsam.CustomFactor(noise, [key], error)


def _gaussian(root: FloatArray) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Gaussian.SqrtInformation(root, smart=False)
