"""The reference trajectory of the likelihood: an EKF along each series at one parameter vector."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.linalg import congruence
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import propagated, updated_one
from fgtrack.noise.likelihood.contaminated import Update, update
from fgtrack.noise.likelihood.series import NoiseSpace, Observation, Series

# Number of successive innovations in a window, and the share of outliers above which the window is mixed.
_WINDOW = 20
_MAX_OUTLIERS = 0.5
# Observations within this time of a mixed window are excluded too.
_MARGIN_S = 1.0


@dataclass(frozen=True, slots=True)
class FilteredObservation:
    """An observation and the filter before and after it; d and a are its numbers of measured and assumed components."""

    observation: Observation
    since_s: float
    """Time since the previous observation, or since the first state."""
    before: FloatArray
    """State after the previous observation, shape (n,)."""
    about: FloatArray
    """State about which the motion is linearised, shape (n,): `before`, or the nominal state."""
    predicted: FloatArray
    """Predicted state, shape (n,)."""
    after: FloatArray
    """Updated state, shape (n,); the yaw is not wrapped."""
    y: FloatArray
    """Innovation of the measured components, shape (d,)."""
    H: FloatArray
    """Jacobian of the measured components, shape (d, n)."""
    assumed: tuple[FloatArray, FloatArray, FloatArray]
    """Innovation (a,), Jacobian (a, n) and covariance (a, a) of the assumed components.

    The innovation is taken at the predicted state.
    """
    update: Update


def filtered(
    series: Series, space: NoiseSpace, values: Sequence[float] | FloatArray
) -> list[FilteredObservation]:
    """Run the filter along `series` with the noise parameters `values`, shape (p,); return its steps."""
    motion = space.motion_model(values)
    yawed = "yaw_rad" in motion.state_names
    by_name = dict(zip(space.names, map(float, values), strict=True))
    x, P = initial_state(motion, series.start)
    stamp_ns = series.start.stamp_ns
    steps = []
    for k, observation in enumerate(series.observations):
        measurement = observation.measurement
        sensor = observation.sensor
        since_s = seconds(measurement.stamp_ns - stamp_ns)
        initial = k < series.num_initial
        about = series.nominal[k] if initial else x
        moved, F, Q = motion.transition(about, since_s)
        predicted = moved + F @ (x - about)
        P = propagated(F, P, Q)
        here = list(observation.measured)
        there = list(observation.assumed)
        R = observation.own
        if observation.tuned:
            stds = np.array([by_name[name] for name in observation.parameters])
            R = congruence(observation.axes, np.diag(np.square(stds)))
        seen_from = series.nominal[k + 1] if initial else predicted
        y, H = measurement.model.linearised(measurement.z, seen_from, measurement.pose)
        y = y - H @ (predicted - seen_from)
        result = update(
            P,
            H[here],
            y[here],
            R,
            observation.other_errors,
            np.array(by_name[sensor, ""]),
        )
        after = predicted + result.step
        P = result.covariance
        R_assumed = measurement.R[np.ix_(there, there)]
        if there:
            left = y[there] - H[there] @ result.step
            after, P = updated_one(after, P, left, H[there], R_assumed)[:2]
        assumed = y[there], H[there], R_assumed
        steps.append(
            FilteredObservation(
                observation,
                since_s,
                x,
                about,
                predicted,
                after,
                y[here],
                H[here],
                assumed,
                result,
            )
        )
        x = after.copy()
        stamp_ns = measurement.stamp_ns
        # Before, the yaw belongs to the nominal trajectory and must not jump.
        if yawed and k + 1 >= series.num_initial:
            x[YAW] = wrap_angle(x[YAW])
    return steps


def with_mixed_marked(series: Series, space: NoiseSpace, values: FloatArray) -> Series:
    """Return `series` with the observations marked as mixed that seem to belong to several objects.

    Stretches are mixed where most of 20 successive innovations are outliers at the
    parameters `values`, shape (p,). There the track has switched to another object, or
    mixes two objects that pass each other. The distribution in `contaminated` does not
    describe this.
    """
    outlier = np.array(
        [step.update.outlier for step in filtered(series, space, values)]
    )
    stamps_ns = np.array([item.measurement.stamp_ns for item in series.observations])
    size = min(_WINDOW, len(outlier))
    margin_ns = nanoseconds(_MARGIN_S)
    means = np.convolve(outlier, np.full(size, 1.0 / size), mode="valid")
    mixed = np.zeros(len(outlier), dtype=np.bool_)
    for first in np.flatnonzero(means > _MAX_OUTLIERS).tolist():
        mixed |= (stamps_ns >= stamps_ns[first] - margin_ns) & (
            stamps_ns <= stamps_ns[first + size - 1] + margin_ns
        )
    return replace(series, mixed=frozenset(np.flatnonzero(mixed).tolist()))
