"""Motion models: exact flow, Jacobian and composing process noise of CTRV, CTRA and CV.

All functions take a state `x`, shape (..., n), and a duration `dt_s`, a float or an array of shape (...), and
broadcast the two. A duration may be 0. For `predict` and `jacobian` it may be negative: the flow runs
backwards. `predict` does not wrap the yaw; `MeasurementModel.residual` does.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import ACCEL, SPEED, STATE_NAMES, YAW, YAW_RATE, FloatArray, X, Y

ComplexArray = npt.NDArray[np.complex128]

#: The gradient of a heading by the velocity grows as 1 / speed; below this speed it stays as it is there.
MIN_SPEED_MPS = 1e-3

# Gauss-Legendre rule on [0, 1].
_LEGENDRE_NODES, _LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(12)
_NODES: FloatArray = 0.5 * (1.0 + _LEGENDRE_NODES)
_WEIGHTS: FloatArray = 0.5 * _LEGENDRE_WEIGHTS
_ORDERS = np.arange(3)
_MOMENT_WEIGHTS: FloatArray = _WEIGHTS[:, None] * _NODES[:, None] ** _ORDERS
_MAX_QUADRATURE_TURN_RAD = 4.0


@runtime_checkable
class MotionModel(Protocol):
    """How an object moves between two stamps, and how uncertain that is."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the n entries of the state."""

    @property
    def dim(self) -> int:
        """Number n of entries of the state."""

    @property
    def linear(self) -> bool:
        """Whether the Jacobian is the same at every state."""

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s`, shape (..., n); the yaw is not wrapped."""

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., n, n)."""

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Covariance Q of the noise gathered over `dt_s`, shape (..., n, n).

        Composes: Q(x, a + b) = F(x_a, b) Q(x, a) F(x_a, b)' + Q(x_a, b) with x_a = predict(x, a), so a late
        detection may split a segment. Raises `CallError` where `dt_s` is negative.
        """

    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (..., m), and covariance, (..., m, m), of the leading m entries of `STATE_NAMES`."""

    def from_kinematic(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """State and covariance P of this model from what `kinematic` of any model gives."""


@dataclass(frozen=True)
class _WhiteNoise:
    """Noise parameters: spectral densities, in fields `<what>_density_<unit>` in the order of the state."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"{field.name}: must be finite and not negative, is {value}")

    @classmethod
    def from_std_per_step(cls, std: Mapping[str, float], frequency_hz: float) -> Self:
        """Model as noisy as a filter that adds the variance (std / frequency_hz)^2 in each of its steps.

        Its densities are std^2 / frequency_hz. `std` is per second, as in Karle et al. 2023; its keys are the
        names of all densities up to `_density_`: `position`, `yaw`, `speed`, ... Raises `ValueError` when a
        key is missing or unknown or the frequency is not positive.
        """
        names = {name.partition("_density_")[0]: name for name in cls._density_names()}
        if set(std) != set(names):
            raise ValueError(f"std of {cls.__name__}: give {', '.join(names)}, not {', '.join(std) or 'nothing'}")
        if not frequency_hz > 0.0:
            raise ValueError(f"frequency_hz: must be positive, is {frequency_hz}")
        return cls(**{names[key]: value * value / frequency_hz for key, value in std.items()})

    @classmethod
    def _density_names(cls) -> tuple[str, ...]:
        return tuple(field.name for field in fields(cls) if "_density_" in field.name)


@dataclass(frozen=True)
class CTRV(_WhiteNoise):
    """Constant turn rate and velocity; state x, y, yaw, speed, yaw rate.

    x(t) + i y(t) = x + i y + speed * integral over s in [0, t] of exp(i (yaw + yaw_rate s)). White noise
    drives each entry. The defaults are those of Karle et al. 2023: std per second 0.2, 0.3, 1, 0.5 at 100 Hz.
    """

    position_density_m2ps: float = 0.2**2 / 100.0
    yaw_density_rad2ps: float = 0.3**2 / 100.0
    speed_density_m2ps3: float = 1.0**2 / 100.0
    yaw_rate_density_rad2ps3: float = 0.5**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES[:ACCEL]
    linear: ClassVar[bool] = False

    @property
    def dim(self) -> int:
        """Number n of entries of the state."""
        return len(self.state_names)

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s` on the exact arc, shape (..., 5); the yaw is not wrapped."""
        t = np.asarray(dt_s, dtype=np.float64)
        m0 = _heading_moments(x, t)[..., 0]
        after = _broadcast_copy(x, t)
        after[..., X] += x[..., SPEED] * m0.real
        after[..., Y] += x[..., SPEED] * m0.imag
        after[..., YAW] += x[..., YAW_RATE] * t
        return after

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., 5, 5)."""
        t = np.asarray(dt_s, dtype=np.float64)
        moments = _heading_moments(x, t)
        m0, m1 = moments[..., 0], moments[..., 1]
        v = x[..., SPEED]
        F = _identities(moments.shape[:-1], 5)
        _set_position_rows(F, (1j * v * m0, m0, 1j * v * m1))
        F[..., YAW, YAW_RATE] = t
        return F

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Covariance Q of the noise gathered over `dt_s` along the mean arc, shape (..., n, n).

        Q(x, t) = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', with Phi(t, s) the Jacobian of the flow
        from x(s) over t - s, and D the diagonal of densities. So Q composes (see `MotionModel`): to rounding
        while the object turns by less than 4 rad within `dt_s`, to 1e-8 relative up to 8 rad, worse beyond.
        Raises `CallError` where `dt_s` is negative.
        """
        t = _forward(dt_s)[..., None]
        states = self.predict(x[..., None, :], t * _NODES)
        transitions = self.jacobian(states, t * (1.0 - _NODES))
        roots = transitions * self._root_densities * np.sqrt(t * _WEIGHTS)[..., None, None]
        root = np.swapaxes(roots, -3, -2).reshape(*roots.shape[:-3], self.dim, -1)
        return symmetrise(root @ np.swapaxes(root, -1, -2))

    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The state and its covariance themselves."""
        return x, P

    def from_kinematic(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The first five entries and their covariance; an acceleration is left out."""
        return mean[..., :ACCEL], covariance[..., :ACCEL, :ACCEL]

    @cached_property
    def _root_densities(self) -> FloatArray:
        position, *others = (getattr(self, name) for name in self._density_names())
        return np.sqrt([position, position, *others])


@dataclass(frozen=True)
class CTRA(CTRV):
    """Constant turn rate and acceleration: CTRV with the acceleration along the heading as sixth entry.

    x(t) + i y(t) = x + i y + integral over s in [0, t] of (speed + accel s) exp(i (yaw + yaw_rate s)). The
    defaults are those of Karle et al. 2023 (see `CTRV`), for the acceleration std 3 per second at 100 Hz.
    """

    accel_density_m2ps5: float = 3.0**2 / 100.0
    accel_birth_variance_m2ps4: float = 1.0
    """Variance of the acceleration where `from_kinematic` is told none."""

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s` on the exact curve, shape (..., 6); the yaw is not wrapped."""
        t = np.asarray(dt_s, dtype=np.float64)
        moments = _heading_moments(x, t)
        moved = x[..., SPEED] * moments[..., 0] + x[..., ACCEL] * moments[..., 1]
        after = _broadcast_copy(x, t)
        after[..., X] += moved.real
        after[..., Y] += moved.imag
        after[..., YAW] += x[..., YAW_RATE] * t
        after[..., SPEED] += x[..., ACCEL] * t
        return after

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., 6, 6)."""
        t = np.asarray(dt_s, dtype=np.float64)
        moments = _heading_moments(x, t)
        m0, m1, m2 = moments[..., 0], moments[..., 1], moments[..., 2]
        v, a = x[..., SPEED], x[..., ACCEL]
        F = _identities(moments.shape[:-1], 6)
        _set_position_rows(F, (1j * (v * m0 + a * m1), m0, 1j * (v * m1 + a * m2), m1))
        F[..., YAW, YAW_RATE] = t
        F[..., SPEED, ACCEL] = t
        return F

    def from_kinematic(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The kinematic state; an acceleration it lacks becomes 0 with `accel_birth_variance_m2ps4`."""
        if mean.shape[-1] > ACCEL:
            return mean, covariance
        x = np.concatenate([mean, np.zeros((*mean.shape[:-1], 1))], axis=-1)
        P = np.zeros((*mean.shape[:-1], 6, 6))
        P[..., :ACCEL, :ACCEL] = covariance
        P[..., ACCEL, ACCEL] = self.accel_birth_variance_m2ps4
        return x, P


@dataclass(frozen=True)
class CV(_WhiteNoise):
    """Constant velocity, linear; state x, y and the velocities vx, vy along the axes of the map.

    White noise acceleration drives vx and vy alike. The default is the speed's density of Karle et al. 2023
    (see `CTRV`); an object that turns sharply needs more.
    """

    velocity_density_m2ps3: float = 1.0**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = ("x_m", "y_m", "vx_mps", "vy_mps")
    dim: ClassVar[int] = 4
    linear: ClassVar[bool] = True

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s` on the straight line, shape (..., 4)."""
        t = np.asarray(dt_s, dtype=np.float64)
        after = _broadcast_copy(x, t)
        after[..., :2] += x[..., 2:] * t[..., None]
        return after

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., 4, 4)."""
        t = np.asarray(dt_s, dtype=np.float64)
        F = _identities(np.broadcast_shapes(x.shape[:-1], t.shape), 4)
        F[..., 0, 2] = F[..., 1, 3] = t
        return F

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Covariance Q, shape (..., 4, 4): q [[t^3/3, t^2/2], [t^2/2, t]] on each axis. It composes.

        Raises `CallError` where `dt_s` is negative.
        """
        t = _forward(dt_s)
        q = self.velocity_density_m2ps3
        Q = np.zeros((*np.broadcast_shapes(x.shape[:-1], t.shape), 4, 4))
        Q[..., 0, 0] = Q[..., 1, 1] = q * t**3 / 3.0
        Q[..., 0, 2] = Q[..., 2, 0] = Q[..., 1, 3] = Q[..., 3, 1] = q * t**2 / 2.0
        Q[..., 2, 2] = Q[..., 3, 3] = q * t
        return Q

    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (..., 5), and first-order covariance, (..., 5, 5), of x, y, yaw, speed, yaw rate.

        The yaw rate is 0 with variance 0. At speed 0 the yaw is 0; its variance there is that of the velocity
        across over `MIN_SPEED_MPS` squared, large but finite: nobody knows the heading of an object that
        stands still.
        """
        mean = np.concatenate([x[..., :2], polar(x[..., 2:]), np.zeros((*x.shape[:-1], 1))], axis=-1)
        J = np.zeros((*x.shape[:-1], 5, 4))
        J[..., X, 0] = J[..., Y, 1] = 1.0
        J[..., YAW:YAW_RATE, 2:] = polar_gradient(x[..., 2:], MIN_SPEED_MPS)
        return mean, symmetrise(J @ P @ np.swapaxes(J, -1, -2))

    def from_kinematic(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """State, shape (..., 4), and covariance, (..., 4, 4), with the velocity along the yaw.

        Yaw rate and acceleration drop out. The covariance is of first order, plus the variance of the product
        of speed error and yaw error, across the heading: without it, an object born at speed 0 could not move
        sideways.
        """
        yaw_speed = mean[..., YAW:YAW_RATE]
        J = _identities(mean.shape[:-1], 4)
        J[..., 2:, 2:] = cartesian_gradient(yaw_speed)
        P = symmetrise(J @ covariance[..., :4, :4] @ np.swapaxes(J, -1, -2))
        product = covariance[..., YAW, YAW] * covariance[..., SPEED, SPEED] + covariance[..., YAW, SPEED] ** 2
        across = np.stack([-np.sin(mean[..., YAW]), np.cos(mean[..., YAW])], axis=-1)
        P[..., 2:, 2:] += product[..., None, None] * across[..., :, None] * across[..., None, :]
        return np.concatenate([mean[..., :2], cartesian(yaw_speed)], axis=-1), P


def polar(vector: FloatArray) -> FloatArray:
    """Direction in [-pi, pi], 0 for the zero vector, and length of `vector`; both of shape (..., 2)."""
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([np.arctan2(y, x), np.hypot(x, y)], axis=-1)


def polar_gradient(vector: FloatArray, floor: float) -> FloatArray:
    """Derivative of `polar` by `vector`, shape (..., 2, 2).

    The direction changes by 1 / length; a length below `floor` counts as `floor` there, so all is finite.
    """
    x, y = vector[..., 0], vector[..., 1]
    direction, length = np.arctan2(y, x), np.maximum(np.hypot(x, y), floor)
    c, s = np.cos(direction), np.sin(direction)
    return np.stack([np.stack([-s / length, c / length], axis=-1), np.stack([c, s], axis=-1)], axis=-2)


def cartesian(direction_length: FloatArray) -> FloatArray:
    """Vector of a direction and a (signed) length, both of shape (..., 2)."""
    direction, length = direction_length[..., 0], direction_length[..., 1]
    return np.stack([length * np.cos(direction), length * np.sin(direction)], axis=-1)


def cartesian_gradient(direction_length: FloatArray) -> FloatArray:
    """Derivative of `cartesian` by direction and length, shape (..., 2, 2)."""
    direction, length = direction_length[..., 0], direction_length[..., 1]
    c, s = np.cos(direction), np.sin(direction)
    return np.stack([np.stack([-length * s, c], axis=-1), np.stack([length * c, s], axis=-1)], axis=-2)


def _heading_moments(x: FloatArray, t: FloatArray) -> ComplexArray:
    """Moments m_k = integral over s in [0, t] of s^k exp(i (yaw + yaw_rate s)), k = 0, 1, 2; shape (..., 3).

    The real part belongs to x, the imaginary part to y. A turn w of up to 4 rad is integrated by quadrature:
    exact to rounding, and smooth through yaw rate 0, where the closed form would divide. Beyond, by parts:
    on [0, 1] the moments are E_0 = (exp(i w) - 1) / (i w) and E_k = (exp(i w) - k E_(k-1)) / (i w).
    """
    turn = np.asarray(x[..., YAW_RATE] * t)
    moments = np.exp(1j * turn[..., None] * _NODES) @ _MOMENT_WEIGHTS
    large = np.abs(turn) > _MAX_QUADRATURE_TURN_RAD
    if large.any():
        iw = 1j * turn[large]
        end = np.exp(iw)
        e0 = (end - 1.0) / iw
        e1 = (end - e0) / iw
        moments[large] = np.stack([e0, e1, (end - 2.0 * e1) / iw], axis=-1)
    return np.asarray(np.exp(1j * x[..., YAW])[..., None] * moments * t[..., None] ** (_ORDERS + 1))


def _set_position_rows(F: FloatArray, columns: tuple[ComplexArray, ...]) -> None:
    """Write the derivatives of x (real) and y (imaginary) by yaw and the entries after it into `F`."""
    for column, derivative in enumerate(columns, start=YAW):
        F[..., X, column] = derivative.real
        F[..., Y, column] = derivative.imag


def _broadcast_copy(x: FloatArray, t: FloatArray) -> FloatArray:
    """Writable copy of `x` for each of the durations `t`."""
    return np.broadcast_to(x, (*np.broadcast_shapes(x.shape[:-1], t.shape), x.shape[-1])).copy()


def _identities(shape: tuple[int, ...], n: int) -> FloatArray:
    """Writable identity matrices, shape (*shape, n, n)."""
    return np.broadcast_to(np.eye(n), (*shape, n, n)).copy()


def _forward(dt_s: float | FloatArray) -> FloatArray:
    """`dt_s` as an array; noise is gathered forwards only."""
    t = np.asarray(dt_s, dtype=np.float64)
    if (t < 0.0).any():
        raise CallError(f"process_noise: dt_s is {t.min()} s; noise needs a duration >= 0, swap the stamps")
    return t
