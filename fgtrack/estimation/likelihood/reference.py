"""An EKF along each series at one vector of parameters: the trajectory about which the likelihood is linearised."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.linalg import congruence, mahalanobis_squared
from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import joseph, kalman_gain, linearised, propagated
from fgtrack.estimation.likelihood.contaminated import update
from fgtrack.estimation.likelihood.noise import NoiseSpace
from fgtrack.estimation.likelihood.series import Observation, Series
from fgtrack.models.correlated_errors import ColouredNoiseMeasurement
from fgtrack.models.measurement import MeasurementModel


@dataclass(frozen=True, slots=True)
class Step:
    """One observation on the way of the filter."""

    observation: Observation
    since_s: float
    """Since the observation before, or the first state."""
    before: FloatArray
    """State after the observation before, shape (n,)."""
    about: FloatArray
    """State about which the motion from there is linearised, shape (n,): `before`, or the nominal one."""
    predicted: FloatArray
    """State predicted from there, shape (n,)."""
    after: FloatArray
    """State after this observation, shape (n,), with a yaw that was not wrapped."""
    y: FloatArray
    """Innovation of the measured components, shape (d,)."""
    H: FloatArray
    """Jacobian of the measured components, shape (d, n)."""
    assumed_innovation: FloatArray
    """Innovation of the assumed components, shape (a,), at the predicted state."""
    assumed_jacobian: FloatArray
    """Their Jacobian, shape (a, n)."""
    assumed_covariance: FloatArray
    """Their covariance, shape (a, a)."""
    S: FloatArray
    """Covariance of the innovation where the error is nominal, shape (d, d)."""
    log_likelihood: float
    outlier: float
    """Probability that the error was not nominal."""

    @property
    def nis(self) -> float:
        """Normalised innovation squared."""
        return float(mahalanobis_squared(self.y, self.S))


def errors(observation: Observation, stds: FloatArray, odds: float) -> tuple[MeasurementModel, FloatArray]:
    """The measurement model, and the covariance (d, d) of the part of the sensor's own error that is new.

    `odds` are those of the part that lasts; see `split_error`.
    """
    model = observation.measurement.model
    if not observation.tuned:
        return model, observation.own
    R, share = congruence(observation.axes, np.diag(np.square(stds))), odds / (1.0 + odds)
    if not isinstance(model, ColouredNoiseMeasurement):
        return model, R
    gain = np.zeros_like(model.gain)
    gain[list(observation.measured)] = congruence(observation.axes, np.diag(math.sqrt(share) * stds))
    return replace(model, gain=gain), (1.0 - share) * R


def filtered(series: Series, space: NoiseSpace, values: Sequence[float] | FloatArray) -> list[Step]:
    """The steps of the filter along `series`; the noise of motion and measurements is that of `values`, shape (p,)."""
    motion = space.motion_model(values)
    yawed = "yaw_rad" in motion.state_names
    by_name = dict(zip(space.names, map(float, values), strict=True))
    x, P = initial_state(motion, series.start)
    stamp_ns = series.start.stamp_ns
    steps = []
    for place, observation in enumerate(series.observations):
        measurement = observation.measurement
        since_s = seconds(measurement.stamp_ns - stamp_ns)
        initial = place < series.num_initial
        about = series.nominal[place] if initial else x
        moved, F, Q = motion.transition(about, since_s)
        predicted = moved + F @ (x - about)
        P = propagated(F, P, Q)
        here, there = list(observation.measured), list(observation.assumed)
        sensor = observation.sensor
        stds = np.array([by_name[sensor, measurement.model.components[place]] for place in here])
        model, R = errors(observation, stds, by_name.get((sensor, "share"), 0.0))
        seen_from = series.nominal[place + 1] if initial else predicted
        y, H = linearised(measurement.z, seen_from, model, measurement.pose)
        y = y - H @ (predicted - seen_from)
        found = update(P, H[here], y[here], R, observation.foreign, np.array(by_name[sensor, ""]))
        after, P = predicted + found.step, found.covariance
        R_assumed = measurement.R[np.ix_(there, there)]
        if there:
            K, _ = kalman_gain(P, H[there], R_assumed)
            after = after + K @ (y[there] - H[there] @ found.step)
            P = joseph(P, K, H[there], R_assumed)
        steps.append(
            Step(
                observation,
                since_s,
                x,
                about,
                predicted,
                after,
                y[here],
                H[here],
                y[there],
                H[there],
                R_assumed,
                found.S,
                float(found.log_likelihood),
                float(found.outlier),
            )
        )
        x, stamp_ns = after.copy(), measurement.stamp_ns
        if yawed and place + 1 >= series.num_initial:  # until then it belongs to the nominal trajectory
            x[YAW] = wrap_angle(x[YAW])
    return steps
