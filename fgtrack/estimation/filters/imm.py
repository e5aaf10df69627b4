"""The interacting multiple model filter in continuous time, so that it can roll back to a late measurement."""

import math
from dataclasses import fields, replace

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import congruence, identity, mahalanobis_squared, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import (
    OneCorrection,
    Prediction,
    correct_one,
    predict,
)
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.estimation.filters.replay import Mixture, ReplayEkf, Step
from fgtrack.estimation.registry import motion_model
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.motion import CT, CTRA, CTRV, CV, MotionModel
from fgtrack.models.robust import penalty

#: Smallest probability of a model, so that the model can become probable again.
_LEAST = 1e-12


class ImmReplay(ReplayEkf):
    """Interacting multiple model filter with replay: `motion` and another model, weighted by their likelihoods.

    Blom and Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching coefficients,
    IEEE Transactions on Automatic Control 33(8), 1988, with a Markov chain in continuous time (see `transition`). Each
    step of the window keeps the states of both models and their probabilities, so the order of arrival does not matter.
    With one model the filter is `ReplayEkf`. The innovation of a late measurement is predicted from the earlier
    measurements alone.

    `other` is a model or its name. The default is CTRA with the noise of `motion` beside CTRV, CTRV beside CTRA, and CV
    beside CT. `stay_s` is the mean sojourn time in each model.
    """

    spreads = mixes = True
    retrodicts = False

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        other: str | MotionModel = "",
        stay_s: float = 5.0,
        initiation: str = DEFAULT,
    ) -> None:
        super().__init__(motion, prior, lag_s, initiation)
        if not 0.0 < stay_s < math.inf:
            raise ValueError(f"stay_s: must be positive and finite, is {stay_s}")
        beside = _beside(motion, other)
        self._models = (motion,) if beside is None else (motion, beside)
        self._rate_hz = len(self._models) / stay_s
        means, covariances = zip(
            *(initial_state(model, prior) for model in self._models), strict=True
        )
        self.steps = [
            replace(
                self.steps[0],
                mixture=Mixture(
                    means, covariances, np.full(len(means), 1.0 / len(means))
                ),
            )
        ]

    def transition(self, dt_s: float) -> FloatArray:
        """Return the probability of model j (columns) `dt_s` after model i (rows), shape (m, m). The matrices
        compose.

        exp(G dt) = exp(-r dt) I + (1 - exp(-r dt)) / m, with r = m over the mean sojourn time.
        """
        m, same = len(self._models), math.exp(-self._rate_hz * dt_s)
        return np.asarray(same * identity(m) + (1.0 - same) / m)

    def _ahead(self, before: Step, stamp_ns: int) -> Prediction:
        """See `ReplayEkf._ahead`. The cross-covariance is not used; the covariance stands for it."""
        mixture = self._mixed(before, stamp_ns)
        mean, covariance = self._moments(mixture, mixture.probabilities, self._motion)
        return Prediction(mean, covariance, covariance)

    def _step(
        self, before: Step, measurement: Measurement
    ) -> tuple[Step, OneCorrection]:
        prior = self._mixed(before, measurement.stamp_ns)
        mean, covariance = self._moments(prior, prior.probabilities, self._motion)
        corrected = [
            correct_one(mean, covariance, measurement.seen_by(model))
            for model, mean, covariance in zip(
                self._models, prior.means, prior.covariances, strict=True
            )
        ]
        logs = np.log(np.maximum(prior.probabilities, _LEAST))
        logs += [_log_likelihood(each, measurement) for each in corrected]
        likelihoods = np.maximum(np.exp(logs - logs.max()), _LEAST)
        posterior = Mixture(
            tuple(
                wrapped(model, each.mean)
                for model, each in zip(self._models, corrected, strict=True)
            ),
            tuple(each.covariance for each in corrected),
            likelihoods / likelihoods.sum(),
        )
        x, P = self._moments(posterior, posterior.probabilities, self._motion)
        weight = float(posterior.probabilities @ [each.weight for each in corrected])
        correction = correct_one(mean, covariance, measurement)._replace(
            mean=x, covariance=P, weight=weight
        )
        step = self._concluded(
            before, measurement, Prediction(mean, covariance, covariance), correction
        )
        if (
            step.search is not None and step.search.line is not None
        ):  # the state comes from the line, by `motion`
            alike = [
                _converted(self._motion, model, step.mean, step.covariance)
                for model in self._models
            ]
            means, covariances = zip(*alike, strict=True)
            posterior = posterior._replace(means=means, covariances=covariances)
        return replace(step, mixture=posterior), correction

    def _mixed(self, before: Step, stamp_ns: int) -> Mixture:
        """Return the mixture at `stamp_ns`, after mixing: for each model, the Gaussian given that the object
        follows this model now.
        """
        old = before.mixture
        assert old is not None  # every step of this filter has a mixture
        if stamp_ns == before.stamp_ns:
            return old
        dt_s = seconds(stamp_ns - before.stamp_ns)
        joint = old.probabilities[:, None] * self.transition(dt_s)
        probabilities = joint.sum(axis=0)
        states = [
            predict(*self._moments(old, shares / total, model), model, dt_s)
            for model, shares, total in zip(
                self._models, joint.T, probabilities, strict=True
            )
        ]
        means, covariances = zip(*states, strict=True)
        return Mixture(means, covariances, probabilities)

    def _moments(
        self, mixture: Mixture, weights: FloatArray, model: MotionModel
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and covariance of the Gaussians of `mixture` with other `weights`, in the state of `model`."""
        states = [
            _converted(each, model, mean, covariance)
            for each, mean, covariance in zip(
                self._models, mixture.means, mixture.covariances, strict=True
            )
        ]
        if len(states) == 1:
            return states[0]
        reference = states[int(weights.argmax())][0]
        apart = [wrapped(model, mean - reference) for mean, _ in states]
        offset = weights @ np.array(apart)
        spread = [
            P + np.outer(d - offset, d - offset)
            for d, (_, P) in zip(apart, states, strict=True)
        ]
        return reference + offset, symmetrise(
            np.tensordot(weights, np.array(spread), axes=1)
        )


def _converted(
    model: MotionModel, wanted: MotionModel, mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a state of `model` as a state of the model `wanted`."""
    if model.state_names == wanted.state_names:
        return mean, covariance
    if model.cartesian and wanted.cartesian:
        selection = np.array(
            [[float(a == b) for b in model.state_names] for a in wanted.state_names]
        )
        missing = [
            0.0 if row.any() else wanted.start_variance(wanted.state_names[k])
            for k, row in enumerate(selection)
        ]
        return selection @ mean, congruence(selection, covariance) + np.diag(missing)
    return wanted.from_kinematic(*model.kinematic(mean, covariance))


def _beside(motion: MotionModel, other: str | MotionModel) -> MotionModel | None:
    """Return the second model. Raises `CallError` if its name is unknown, or if `motion` cannot be one of two
    models.
    """
    if isinstance(motion, CorrelatedErrors):
        raise CallError("takes no sensors with correlated errors")
    if isinstance(other, MotionModel):
        return other
    if isinstance(motion, CT) and not other:
        return CV(motion.velocity_density_m2ps3)
    default = (
        "ctrv"
        if isinstance(motion, CTRA)
        else "ctra"
        if isinstance(motion, CTRV)
        else ""
    )
    if not (other or default):
        return None
    alike = isinstance(motion, CTRV) and other in ("", default)
    same = (
        {each.name: getattr(motion, each.name) for each in fields(CTRV)}
        if alike
        else {}
    )
    return motion_model(other or default, same)


def _log_likelihood(corrected: OneCorrection, measurement: Measurement) -> float:
    """Return the log-likelihood of the innovation by one model, under the loss of the measurement.

    Terms that all models share are left out.
    """
    distance = math.sqrt(
        max(float(mahalanobis_squared(corrected.innovation, corrected.S)), 0.0)
    )
    return -penalty(measurement.loss, distance, len(measurement.R)) - 0.5 * float(
        np.linalg.slogdet(corrected.S)[1]
    )
