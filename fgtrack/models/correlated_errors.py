"""Errors of a sensor that are correlated in time, estimated with the state of the object.

An estimator that takes them for white is overconfident, a smoother most of all. The correlated part of the error is a
first-order Gauss-Markov process and a state (Bryson and Henrikson, "Estimation using sampled data containing
sequentially correlated noise", 1968; Bar-Shalom, Li, Kirubarajan 2001, section 8.3), in every estimator alike.
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

_MOST = 30.0  # exponent of an error that is moved back in time, in which it would grow beyond all numbers


@dataclass(frozen=True)
class CorrelatedErrors(MotionModel):
    """A motion model whose state also has the time-correlated errors of sensors about one object.
    Each is a stationary first-order Gauss-Markov process of mean 0 and variance 1,
    e(t + dt) = exp(-dt / T) e(t) + N(0, 1 - exp(-2 dt / T)), in standard deviations of the correlated part.
    """

    base: MotionModel
    """Motion model of the object."""
    times_s: tuple[tuple[str, float], ...]
    """Name `sensor.component` and correlation time T of every error, in the order of the state behind `base`."""

    def __post_init__(self) -> None:
        names = (*self.base.state_names, *(name for name, _ in self.times_s))
        object.__setattr__(
            self, "state_names", names
        )  # of the object: class variables where a model has no parts
        object.__setattr__(self, "linear", self.base.linear)

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.predict`."""
        moved = self.base.predict(x[..., : self.base.dim], dt_s)
        return np.concatenate(
            [moved, x[..., self.base.dim :] * np.exp(self._exponents(dt_s))], axis=-1
        )

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.jacobian`."""
        return self._beside(
            self.base.jacobian(x[..., : self.base.dim], dt_s),
            np.exp(self._exponents(dt_s)),
        )

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.process_noise`."""
        Q = self.base.process_noise(x[..., : self.base.dim], dt_s)
        return self._beside(Q, -np.expm1(2.0 * self._exponents(dt_s)))

    def start_variance(self, name: str) -> float:
        """See `MotionModel.start_variance`; an error is in its stationary state."""
        return self.base.start_variance(name) if name in self.base.state_names else 1.0

    @cached_property
    def _rates_hz(self) -> FloatArray:
        return np.array([1.0 / time_s for _, time_s in self.times_s])

    def _exponents(self, dt_s: float | FloatArray) -> FloatArray:
        """Logarithms of the decays, shape (..., errors)."""
        return np.minimum(
            -np.asarray(dt_s, dtype=np.float64)[..., None] * self._rates_hz, _MOST
        )

    def _beside(self, block: FloatArray, diagonal: FloatArray) -> FloatArray:
        """Block-diagonal matrix (..., n, n) of `block` and of `diagonal` (..., errors)."""
        matrix = np.zeros((*block.shape[:-2], self.dim, self.dim))
        matrix[..., : self.base.dim, : self.base.dim] = block
        indices = np.arange(self.base.dim, self.dim)
        matrix[..., indices, indices] = diagonal
        return matrix


@dataclass(frozen=True)
class ColouredNoiseMeasurement(MeasurementModel):
    """A measurement of which a part of the error is in the state: z = h(x, pose) + gain e + noise."""

    columns: tuple[int, ...]
    """Where the errors e are in the state."""
    gain: FloatArray
    """Shape (k, number of errors)."""

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
        H = super().jacobian(x, pose)  # that of a linear model is `selection`
        if not self.linear:
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
    """`motion` with a state for every component of the sensors with correlated errors; itself where there is none."""
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
    """The measurement model with the correlated part of the error, and the covariance (k, k) of the rest.
    Of the covariance R (k, k) of the components that the sensor measures, the share s = `model.correlation.share` is
    correlated: z = h(x) + (s R)^1/2 e + N(0, (1 - s) R), so that a detection alone has the covariance R.
    """
    if model.correlation is None:
        return measurement, R
    own = [row for row, name in enumerate(measurement.components) if name in model.std]
    block = np.ix_(own, own)
    share = model.correlation.share
    correlated = share * R[block]
    white = R.copy()
    white[block] -= correlated
    gain = np.zeros((len(R), len(own)))
    values, vectors = np.linalg.eigh(correlated)
    gain[own] = (
        vectors * np.sqrt(np.maximum(values, 0.0))
    ) @ vectors.T  # turns with the axes of the covariance
    columns = tuple(
        state_names.index(f"{sensor}.{measurement.components[row]}") for row in own
    )
    return ColouredNoiseMeasurement(
        measurement.components, measurement.state_names, columns, gain
    ), symmetrise(white)


def total_error(measurement: MeasurementModel, white: FloatArray) -> FloatArray:
    """Covariance R, shape (k, k), of the correlated error and the rest `white`: the inverse of `split_error`."""
    if not isinstance(measurement, ColouredNoiseMeasurement):
        return white
    return white + measurement.gain @ measurement.gain.T


def position_cross(
    measurement: MeasurementModel, z: FloatArray, pose: SensorPose
) -> dict[str, tuple[float, float]]:
    """Covariance of the position by z (k,) with the correlated errors, by name: -G gain, x = G (z - gain e)."""
    if not isinstance(measurement, ColouredNoiseMeasurement):
        return {}
    G = position_gradient(measurement.components, z, pose)
    if G is None:
        return {}
    x_m, y_m = (-G @ measurement.gain).tolist()
    names = [measurement.state_names[column] for column in measurement.columns]
    return dict(zip(names, zip(x_m, y_m, strict=True), strict=True))


def component_cross(measurement: MeasurementModel, component: str) -> dict[str, float]:
    """Covariance of an entry of the state that is measured as `component`, with the correlated errors, by name.

    The entry begins as the measured value, z - gain e, so the covariance is the negative row of the gain.
    """
    if (
        not isinstance(measurement, ColouredNoiseMeasurement)
        or component not in measurement.components
    ):
        return {}
    gains = measurement.gain[measurement.components.index(component)]
    names = [measurement.state_names[column] for column in measurement.columns]
    return dict(zip(names, (-gains).tolist(), strict=True))
