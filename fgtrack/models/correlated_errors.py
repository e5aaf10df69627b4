"""Time-correlated sensor errors, estimated together with the state of the object.

An estimator that treats correlated errors as white noise is overconfident. Smoothers
suffer most. Here the correlated part of the error is a first-order Gauss-Markov
process. It is appended to the state, so every estimator handles it in the same way.

Sources: Bryson and Henrikson, "Estimation using sampled data containing sequentially
correlated noise", 1968; Bar-Shalom, Li and Kirubarajan 2001, section 8.3.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.models.measurement import (
    AT_ORIGIN,
    MeasurementModel,
    SensorPose,
    position_gradient,
)
from fgtrack.models.motion import MotionModel
from fgtrack.models.sensors import SensorModel

# Largest exponent. An error that is predicted backwards in time grows, and would overflow.
_MAX_EXPONENT = 30.0


@dataclass(frozen=True)
class CorrelatedErrors(MotionModel):
    """Motion model of an object whose state also contains time-correlated sensor errors.

    Each error is a stationary first-order Gauss-Markov process with mean 0 and variance
    1: e(t + dt) = exp(-dt / T) e(t) + N(0, 1 - exp(-2 dt / T)). Its unit is the
    standard deviation of the correlated part of the measurement error.
    """

    base: MotionModel
    """Motion model of the object alone."""
    times_s: tuple[tuple[str, float], ...]
    """Name `sensor.component` and correlation time T [s] of each error, in state order.

    The errors follow the entries of `base` in the state.
    """

    def __post_init__(self) -> None:
        names = (*self.base.state_names, *(name for name, _ in self.times_s))
        # Other models have these two as class variables. Here they depend on the instance.
        object.__setattr__(self, "state_names", names)
        object.__setattr__(self, "linear", self.base.linear)

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.predict`."""
        moved = self.base.predict(x[..., : self.base.dim], dt_s)
        return np.concatenate(
            [moved, x[..., self.base.dim :] * np.exp(self._log_decays(dt_s))], axis=-1
        )

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.jacobian`."""
        return self._block_diagonal(
            self.base.jacobian(x[..., : self.base.dim], dt_s),
            np.exp(self._log_decays(dt_s)),
        )

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.process_noise`."""
        Q = self.base.process_noise(x[..., : self.base.dim], dt_s)
        return self._block_diagonal(Q, -np.expm1(2.0 * self._log_decays(dt_s)))

    def start_variance(self, name: str) -> float:
        """See `MotionModel.start_variance`; an error starts in its stationary distribution."""
        return self.base.start_variance(name) if name in self.base.state_names else 1.0

    @cached_property
    def _rates_hz(self) -> FloatArray:
        return np.array([1.0 / time_s for _, time_s in self.times_s])

    def _log_decays(self, dt_s: float | FloatArray) -> FloatArray:
        """Logarithm of the factor exp(-dt / T) by which each error decays, shape (..., errors)."""
        return np.minimum(
            -np.asarray(dt_s, dtype=np.float64)[..., None] * self._rates_hz,
            _MAX_EXPONENT,
        )

    def _block_diagonal(self, block: FloatArray, diagonal: FloatArray) -> FloatArray:
        """Block-diagonal matrix of `block` and `diagonal`, shape (..., n, n).

        `block` belongs to the object's own state; `diagonal` has the shape (...,
        errors).
        """
        matrix = np.zeros((*block.shape[:-2], self.dim, self.dim))
        matrix[..., : self.base.dim, : self.base.dim] = block
        indices = np.arange(self.base.dim, self.dim)
        matrix[..., indices, indices] = diagonal
        return matrix


@dataclass(frozen=True)
class ColouredNoiseMeasurement(MeasurementModel):
    """Measurement with a correlated error that is part of the state: z = h(x, pose) + gain e + noise."""

    columns: tuple[int, ...]
    """Indices of the errors e in the state."""
    gain: FloatArray
    """Derivative of the measurement by the errors, shape (k, number of errors)."""

    def part(self, rows: Sequence[int]) -> MeasurementModel:
        """See `MeasurementModel.part`."""
        components = tuple(self.components[row] for row in rows)
        return ColouredNoiseMeasurement(
            components, self.state_names, self.columns, self.gain[list(rows)]
        )

    def predict(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        """See `MeasurementModel.predict`."""
        return np.asarray(
            super().predict(x, pose) + x.take(self.columns, axis=-1) @ self.gain.T
        )

    def jacobian(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        """See `MeasurementModel.jacobian`."""
        H = super().jacobian(x, pose)
        if not self.linear:  # for a linear model H is `selection`, with the gain
            H[..., self.columns] = self.gain
        return H

    def selection(self, n: int) -> FloatArray:
        """See `MeasurementModel.selection`."""
        H = super().selection(n).copy()
        H[:, self.columns] = self.gain
        H.flags.writeable = False
        return H


def with_correlated_errors(
    motion: MotionModel, sensors: Mapping[str, SensorModel]
) -> MotionModel:
    """Return `motion` with one additional state per component of each sensor with correlated errors.

    Returns `motion` itself if no sensor has correlated errors.
    """
    times_s = [
        (f"{sensor}.{component}", model.correlation.time_s)
        for sensor, model in sensors.items()
        if model.correlation is not None
        for component in model.components
    ]
    return CorrelatedErrors(motion, tuple(times_s)) if times_s else motion


def split_error(
    sensor: str,
    model: SensorModel,
    measurement: MeasurementModel,
    R: FloatArray,
    state_names: Sequence[str],
) -> tuple[MeasurementModel, FloatArray]:
    """Return the measurement model with the correlated error as a part of the state, and the white rest of R.

    `R`, shape (k, k), is the covariance of the whole error. The share s = `model.correlation.share` of the block of the
    components that the sensor itself measures is correlated: z = h(x) + (s R)^1/2 e + N(0, (1 - s) R). So a single
    detection keeps the covariance R. The white rest is (1 - s) R in this block, shape (k, k).
    """
    if model.correlation is None:
        return measurement, R
    own = [row for row, name in enumerate(measurement.components) if name in model.std]
    block = np.ix_(own, own)
    share = model.correlation.share
    correlated = share * R[block]
    white = R.copy()
    white[block] -= correlated
    # The symmetric square root rotates with the axes of the covariance.
    gain = np.zeros((len(R), len(own)))
    values, vectors = np.linalg.eigh(correlated)
    gain[own] = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    columns = tuple(
        state_names.index(f"{sensor}.{measurement.components[row]}") for row in own
    )
    return ColouredNoiseMeasurement(
        measurement.components, measurement.state_names, columns, gain
    ), symmetrise(white)


def total_error(measurement: MeasurementModel, white: FloatArray) -> FloatArray:
    """Covariance of the whole measurement error, shape (k, k); inverts `split_error`.

    The result is the sum of the `white` covariance and the covariance of the correlated
    error.
    """
    if not isinstance(measurement, ColouredNoiseMeasurement):
        return white
    return white + measurement.gain @ measurement.gain.T


def position_cross(
    measurement: MeasurementModel, z: FloatArray, pose: SensorPose
) -> dict[str, tuple[float, float]]:
    """Cross-covariance of the measured position with each correlated error, by state name.

    The position is inverted from `z`, shape (k,): x = G (z - gain e). So the
    cross-covariance is -G gain. Empty if the measurement has no correlated error or
    gives no position.
    """
    if not isinstance(measurement, ColouredNoiseMeasurement):
        return {}
    G = position_gradient(measurement.components, z, pose)
    if G is None:
        return {}
    x_m, y_m = (-G @ measurement.gain).tolist()
    names = [measurement.state_names[column] for column in measurement.columns]
    return dict(zip(names, zip(x_m, y_m, strict=True), strict=True))


def component_cross(measurement: MeasurementModel, component: str) -> dict[str, float]:
    """Cross-covariance of the measured `component` with each correlated error, by state name.

    A new object starts with the state entry z - gain e. So the cross-covariance is the
    negative row of the gain. Empty if the measurement has no correlated error or lacks
    the component.
    """
    if (
        not isinstance(measurement, ColouredNoiseMeasurement)
        or component not in measurement.components
    ):
        return {}
    gains = measurement.gain[measurement.components.index(component)]
    names = [measurement.state_names[column] for column in measurement.columns]
    return dict(zip(names, (-gains).tolist(), strict=True))
