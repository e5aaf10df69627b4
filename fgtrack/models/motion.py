"""Motion models: exact flow, Jacobian and composing process noise of CTRV, CTRA and CV.

All functions take a state `x`, shape (..., n), and a duration `dt_s`, a float or an array of shape (...), and
broadcast the two. A duration may be 0. For `predict` and `jacobian` it may be negative: the flow runs
backwards. `predict` does not wrap the yaw; `MeasurementModel.residual` does.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian, cartesian_gradient, polar, polar_gradient
from fgtrack.core.linalg import congruence, identity, symmetrise
from fgtrack.core.types import ACCEL, SPEED, STATE_NAMES, YAW, YAW_RATE, FloatArray, X, Y
from fgtrack.models.arc import (
    MAX_SMALL_TURN_RAD,
    NODES,
    WEIGHTS,
    heading_moments,
    small_turn,
    small_turn_noise,
    way,
    way_gradient,
)
from fgtrack.models.arc_series import arc_series
from fgtrack.models.white_noise import WhiteNoise

#: The first entries of every model's state are either of these.
POLAR, CARTESIAN = STATE_NAMES[:4], ("x_m", "y_m", "vx_mps", "vy_mps")

#: The gradient of a heading by the velocity grows as 1 / speed; below this speed it stays as it is there.
MIN_SPEED_MPS = 1e-3

_FEW = 2  # so many states are faster one by one than as an array


class Step(NamedTuple):
    """One state after a duration: what `predict`, `jacobian` and `process_noise` give, at a fraction of the cost."""

    mean: list[float]
    """State, n entries; the yaw is not wrapped."""
    F: FloatArray
    """Derivative of the mean by the state before, shape (n, n)."""
    Q: FloatArray
    """Covariance of the accumulated noise, shape (n, n)."""


class Steps(NamedTuple):
    """`Step` of many states: shapes (..., n), (..., n, n) and (..., n, n)."""

    mean: FloatArray
    F: FloatArray
    Q: FloatArray


class MotionModel(ABC):
    """How an object moves between two stamps, and how uncertain that is.

    A model has `state_names`, `predict`, `jacobian` and `process_noise`; what else is asked of it follows from them.
    It is immutable, equal to one with the same parameters, and hashable: a frozen dataclass.
    """

    state_names: ClassVar[tuple[str, ...]]
    """Names of the n entries of the state: those of `POLAR` or of `CARTESIAN`, then any others."""
    linear: ClassVar[bool] = False
    """Whether the Jacobian is the same at every state."""

    @property
    def dim(self) -> int:
        """Number n of entries of the state."""
        return len(self.state_names)

    @property
    def cartesian(self) -> bool:
        """Whether the state holds the velocity as vx and vy, and not as yaw and speed."""
        return self.state_names[:4] == CARTESIAN

    @abstractmethod
    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s`, shape (..., n); the yaw is not wrapped."""

    @abstractmethod
    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., n, n)."""

    @abstractmethod
    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Covariance Q of the noise accumulated over `dt_s`, shape (..., n, n).

        Composes: Q(x, a + b) = F(x_a, b) Q(x, a) F(x_a, b)' + Q(x_a, b) with x_a = predict(x, a), so a late
        detection may split a segment. Raises `CallError` where `dt_s` is negative (let `forward` check it).
        """

    @staticmethod
    def forward(dt_s: float | FloatArray) -> FloatArray:
        """`dt_s` as an array; raises `CallError` where it is negative, because noise accumulates forwards only."""
        t = np.asarray(dt_s, dtype=np.float64)
        if (t < 0.0).any():
            raise CallError(f"process_noise: dt_s is {t.min()} s; noise needs a duration >= 0, swap the stamps")
        return t

    def step(self, x: Sequence[float], dt_s: float) -> Step:
        """The one state `x` after `dt_s` >= 0; F and Q are new arrays. Raises `CallError` where `dt_s` is negative."""
        return Step(*self.flow(x, dt_s), self.process_noise(np.array(x, dtype=np.float64), dt_s))

    def steps(self, x: FloatArray, dt_s: FloatArray) -> Steps:
        """`step` of many states: what `predict`, `jacobian` and `process_noise` give."""
        return Steps(self.predict(x, dt_s), self.jacobian(x, dt_s), self.process_noise(x, dt_s))

    def flow(self, x: Sequence[float], dt_s: float) -> tuple[list[float], FloatArray]:
        """Mean and F of `step`, of any duration."""
        state = np.array(x, dtype=np.float64)
        return self.predict(state, dt_s).tolist(), self.jacobian(state, dt_s)

    def start_variance(self, name: str) -> float:
        """Variance of the entry `name` of a new object of which nothing is known of it; its mean is 0."""
        return 1.0

    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean, shape (..., m), and first-order covariance, (..., m, m), of the leading m entries of `STATE_NAMES`.

        m is 6 of a model with an acceleration, else 5; an entry that the state lacks is 0 with variance 0. Of a
        Cartesian state the yaw is 0 at speed 0; its variance there is that of the velocity across over
        `MIN_SPEED_MPS` squared, large but finite: the heading of an object at rest is unknown.
        """
        if self._leads:
            return x, P
        S = self._selection[: len(STATE_NAMES) if "accel_mps2" in self.state_names else ACCEL]
        mean = x @ S.T
        J = np.broadcast_to(S, (*x.shape[:-1], *S.shape)).copy()
        if self.cartesian:
            mean[..., YAW:YAW_RATE] = polar(x[..., 2:4])
            J[..., YAW:YAW_RATE, 2:4] = polar_gradient(x[..., 2:4], MIN_SPEED_MPS)
        return mean, symmetrise(congruence(J, P))

    def from_kinematic(self, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """State and covariance P of this model from what `kinematic` of any model gives.

        What the kinematic state lacks is 0 with `start_variance`. The covariance of a Cartesian velocity is of first
        order, plus the variance of the product of speed error and yaw error, across the heading: without it, an
        object born at speed 0 could not move sideways.
        """
        n = self.dim
        if self._leads and n <= mean.shape[-1]:
            return mean[..., :n], covariance[..., :n, :n]
        S = self._selection[: mean.shape[-1]]
        x = mean @ S
        J = np.broadcast_to(S.T, (*mean.shape[:-1], *S.T.shape)).copy()
        unknown = [0.0 if column.any() else self.start_variance(self.state_names[k]) for k, column in enumerate(S.T)]
        if self.cartesian:
            unknown[2:4] = 0.0, 0.0
            yaw_speed = mean[..., YAW:YAW_RATE]
            x[..., 2:4], J[..., 2:4, YAW:YAW_RATE] = cartesian(yaw_speed), cartesian_gradient(yaw_speed)
        P = symmetrise(congruence(J, covariance)) + np.diag(unknown)
        if self.cartesian:
            product = covariance[..., YAW, YAW] * covariance[..., SPEED, SPEED] + covariance[..., YAW, SPEED] ** 2
            across = np.stack([-np.sin(mean[..., YAW]), np.cos(mean[..., YAW])], axis=-1)
            P[..., 2:4, 2:4] += product[..., None, None] * across[..., :, None] * across[..., None, :]
        return x, P

    @cached_property
    def _leads(self) -> bool:
        """Whether the state is a kinematic state."""
        return self.dim >= ACCEL and self.state_names == STATE_NAMES[: self.dim]

    @cached_property
    def _selection(self) -> FloatArray:
        """1 where an entry of `STATE_NAMES` (rows) and one of the state (columns) have the same name, shape (6, n)."""
        return np.array([[float(row == column) for column in self.state_names] for row in STATE_NAMES])


@dataclass(frozen=True)
class CTRV(WhiteNoise, MotionModel):
    """Constant turn rate and velocity; state x, y, yaw, speed, yaw rate.

    x(t) + i y(t) = x + i y + speed * integral over s in [0, t] of exp(i (yaw + yaw_rate s)). White noise
    drives each entry. The defaults are those of Karle et al. 2023: std per second 0.2, 0.3, 1, 0.5 at 100 Hz.
    """

    position_density_m2ps: float = 0.2**2 / 100.0
    yaw_density_rad2ps: float = 0.3**2 / 100.0
    speed_density_m2ps3: float = 1.0**2 / 100.0
    yaw_rate_density_rad2ps3: float = 0.5**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES[:ACCEL]

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s` on the exact arc, shape (..., 5); the yaw is not wrapped."""
        t = np.asarray(dt_s, dtype=np.float64)
        moved = way(heading_moments(x, t), 0, *_drive(x))
        after = _broadcast_copy(x, t)
        after[..., X] += moved.real
        after[..., Y] += moved.imag
        after[..., YAW] += x[..., YAW_RATE] * t
        return after

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., 5, 5)."""
        t = np.asarray(dt_s, dtype=np.float64)
        moments = heading_moments(x, t)
        F = _identities(moments[0].shape, self.dim)
        for column, derivative in enumerate(way_gradient(moments, *_drive(x)), start=YAW):
            F[..., X, column], F[..., Y, column] = derivative.real, derivative.imag
        F[..., YAW, YAW_RATE] = t
        return F

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Covariance Q of the noise accumulated over `dt_s` along the mean arc, shape (..., n, n).

        Q(x, t) = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', with Phi(t, s) the Jacobian of the flow
        from x(s) over t - s, and D the diagonal of densities. So Q composes (see `MotionModel`): to rounding
        while the object turns by less than 4 rad within `dt_s`, to 1e-8 relative up to 8 rad, worse beyond.
        Raises `CallError` where `dt_s` is negative.
        """
        t = self.forward(dt_s)[..., None]
        states = self.predict(x[..., None, :], t * NODES)
        transitions = self.jacobian(states, t * (1.0 - NODES))
        roots = transitions * self._root_densities * np.sqrt(t * WEIGHTS)[..., None, None]
        root = np.swapaxes(roots, -3, -2).reshape(*roots.shape[:-3], self.dim, len(NODES) * self.dim)
        return symmetrise(root @ np.swapaxes(root, -1, -2))

    def step(self, x: Sequence[float], dt_s: float) -> Step:
        """See `MotionModel.step`; fast up to a turn of `MAX_SMALL_TURN_RAD`."""
        arc = small_turn(x[YAW], x[YAW_RATE], dt_s)
        if arc is None or dt_s < 0.0:
            return super().step(x, dt_s)
        mean, F = self._along(x, dt_s, arc.moments)
        return Step(mean, F, small_turn_noise(arc, dt_s, self._densities, x[SPEED], *x[ACCEL:]))

    def steps(self, x: FloatArray, dt_s: FloatArray) -> Steps:
        """See `MotionModel.steps`; fast where no state turns further than `MAX_SMALL_TURN_RAD`."""
        if x.ndim == 2 and 0 < len(x) <= _FEW:
            return Steps(*map(np.array, zip(*map(self.step, x.tolist(), dt_s.tolist()), strict=True)))
        turn = x[..., YAW_RATE] * dt_s
        small = np.abs(turn).max(initial=0.0) <= MAX_SMALL_TURN_RAD and (dt_s >= 0.0).all()
        if not (x.ndim == 2 and small and np.isfinite(x[:, YAW]).all()):
            return super().steps(x, dt_s)
        return Steps(*arc_series(self._densities, self.dim)(x, dt_s, turn))

    def flow(self, x: Sequence[float], dt_s: float) -> tuple[list[float], FloatArray]:
        """See `MotionModel.flow`; fast up to a turn of `MAX_SMALL_TURN_RAD`."""
        arc = small_turn(x[YAW], x[YAW_RATE], dt_s)
        return super().flow(x, dt_s) if arc is None else self._along(x, dt_s, arc.moments)

    def _along(self, x: Sequence[float], t: float, moments: Sequence[complex]) -> tuple[list[float], FloatArray]:
        """`flow` with given heading moments."""
        drive = x[SPEED], *x[ACCEL:]
        moved = way(moments, 0, *drive)
        F = identity(len(x)).copy()
        for column, derivative in enumerate(way_gradient(moments, *drive), start=YAW):
            F[X, column], F[Y, column] = derivative.real, derivative.imag
        F[YAW, YAW_RATE] = t
        return [x[X] + moved.real, x[Y] + moved.imag, x[YAW] + x[YAW_RATE] * t, *x[SPEED:]], F

    @cached_property
    def _root_densities(self) -> FloatArray:
        return np.sqrt([self._densities[0], *self._densities])[: self.dim]

    @cached_property
    def _densities(self) -> tuple[float, ...]:
        """Of position, yaw, speed, yaw rate and acceleration; 0 where the state has none."""
        return (*(getattr(self, name) for name in self.density_names()), 0.0)[:5]


@dataclass(frozen=True)
class CTRA(CTRV):
    """Constant turn rate and acceleration: CTRV with the acceleration along the heading as sixth entry.

    x(t) + i y(t) = x + i y + integral over s in [0, t] of (speed + accel s) exp(i (yaw + yaw_rate s)). The
    defaults are those of Karle et al. 2023 (see `CTRV`), for the acceleration std 3 per second at 100 Hz.
    """

    accel_density_m2ps5: float = 3.0**2 / 100.0
    accel_birth_variance_m2ps4: float = 1.0
    """Variance of the acceleration where `from_kinematic` is given none."""

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """State after `dt_s` on the exact curve, shape (..., 6); the yaw is not wrapped."""
        after = super().predict(x, dt_s)
        after[..., SPEED] += x[..., ACCEL] * dt_s
        return after

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """Derivative F of `predict` by `x`, shape (..., 6, 6)."""
        F = super().jacobian(x, dt_s)
        F[..., SPEED, ACCEL] = dt_s
        return F

    def start_variance(self, name: str) -> float:
        """See `MotionModel.start_variance`: `accel_birth_variance_m2ps4`."""
        return self.accel_birth_variance_m2ps4

    def _along(self, x: Sequence[float], t: float, moments: Sequence[complex]) -> tuple[list[float], FloatArray]:
        mean, F = super()._along(x, t, moments)
        mean[SPEED] += x[ACCEL] * t
        F[SPEED, ACCEL] = t
        return mean, F


@dataclass(frozen=True)
class CV(WhiteNoise, MotionModel):
    """Constant velocity, linear; state x, y and the velocities vx, vy along the axes of the map.

    White noise acceleration drives vx and vy alike. The default is the speed's density of Karle et al. 2023
    (see `CTRV`); an object that turns sharply needs more.
    """

    velocity_density_m2ps3: float = 1.0**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = CARTESIAN
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
        t = self.forward(dt_s)
        return self._noise(np.broadcast_shapes(x.shape[:-1], t.shape), t)

    def step(self, x: Sequence[float], dt_s: float) -> Step:
        """See `MotionModel.step`."""
        return Step(*self.flow(x, dt_s), self._noise((), dt_s)) if dt_s >= 0.0 else super().step(x, dt_s)

    def flow(self, x: Sequence[float], dt_s: float) -> tuple[list[float], FloatArray]:
        """See `MotionModel.flow`."""
        x_m, y_m, vx, vy = x
        F = identity(4).copy()
        F[0, 2] = F[1, 3] = dt_s
        return [x_m + vx * dt_s, y_m + vy * dt_s, vx, vy], F

    def _noise(self, shape: tuple[int, ...], t: FloatArray | float) -> FloatArray:
        """Q over `t`, shape (*shape, 4, 4)."""
        Q = np.zeros((*shape, 4, 4))
        q = self.velocity_density_m2ps3
        Q[..., 0, 0] = Q[..., 1, 1] = q * t**3 / 3.0
        Q[..., 0, 2] = Q[..., 2, 0] = Q[..., 1, 3] = Q[..., 3, 1] = q * t**2 / 2.0
        Q[..., 2, 2] = Q[..., 3, 3] = q * t
        return Q


def _drive(x: FloatArray) -> tuple[FloatArray, ...]:
    """Arguments of `way` from the speed on."""
    return (x[..., SPEED], x[..., ACCEL]) if x.shape[-1] > ACCEL else (x[..., SPEED],)


def _broadcast_copy(x: FloatArray, t: FloatArray) -> FloatArray:
    """Writable copy of `x` for each of the durations `t`."""
    return np.broadcast_to(x, (*np.broadcast_shapes(x.shape[:-1], t.shape), x.shape[-1])).copy()


def _identities(shape: tuple[int, ...], n: int) -> FloatArray:
    """Writable identity matrices, shape (*shape, n, n)."""
    return np.array(np.broadcast_to(identity(n), (*shape, n, n)))
