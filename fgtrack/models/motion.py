"""Motion models: exact flow, Jacobian and composing process noise of CTRV, CTRA, CT and CV.

All functions broadcast a state `x`, shape (..., n), and a duration `dt_s`, a float or an array of shape (...), which
may be negative for `predict` and `jacobian`. Only `MeasurementModel.residual` wraps the yaw.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from fgtrack.core.checks import not_negative, positive
from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian, cartesian_gradient, polar, polar_gradient
from fgtrack.core.linalg import congruence, kernels, symmetrise
from fgtrack.core.types import ACCEL, SPEED, STATE_NAMES, YAW, YAW_RATE, FloatArray

#: The first entries of every model's state are either of these.
POLAR, CARTESIAN = STATE_NAMES[:4], ("x_m", "y_m", "vx_mps", "vy_mps")
#: The gradient of a heading by the velocity grows as 1 / speed; below this speed it stays as it is there.
MIN_SPEED_MPS = 1e-3


class Transition(NamedTuple):
    """States after a duration, how they depend on those before, and how uncertain they have become."""

    mean: FloatArray
    """Shape (..., n); the yaw is not wrapped."""
    F: FloatArray
    """Derivative of the mean by the state before, shape (..., n, n)."""
    Q: FloatArray
    """Covariance of the accumulated noise, shape (..., n, n)."""


class MotionModel(ABC):
    """Motion of an object between two stamps, and its uncertainty: a frozen dataclass.

    A model has `state_names`, `predict`, `jacobian` and `process_noise`; one that computes these three in one go
    overrides `transition`, which is what estimators call.
    """

    state_names: ClassVar[tuple[str, ...]]
    """Names of the n entries of the state: those of `POLAR` or of `CARTESIAN`, then any others."""
    linear: ClassVar[bool] = False
    """True if the Jacobian is the same at every state."""

    @cached_property
    def dim(self) -> int:
        """Number n of entries of the state."""
        return len(self.state_names)

    @cached_property
    def cartesian(self) -> bool:
        """True if the state holds the velocity as vx and vy, and not as yaw and speed."""
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
        Composes: Q(x, a + b) = F(x_a, b) Q(x, a) F(x_a, b)' + Q(x_a, b) with x_a = predict(x, a). Raises `CallError`
        where `dt_s` is negative (let `forward` check it).
        """

    @staticmethod
    def forward(dt_s: float | FloatArray) -> FloatArray:
        """`dt_s` as an array; raises `CallError` where it is negative, because noise accumulates forwards only."""
        t = np.asarray(dt_s, dtype=np.float64)
        if (t < 0.0).any():
            raise CallError(
                f"process_noise: dt_s is {t.min()} s; noise needs a duration >= 0, swap the stamps"
            )
        return t

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        """Return `predict`, `jacobian` and `process_noise` of the states `x`. Raises as `process_noise`."""
        return Transition(
            self.predict(x, dt_s), self.jacobian(x, dt_s), self.process_noise(x, dt_s)
        )

    def start_variance(self, name: str) -> float:
        """Variance of an unobserved entry `name` of a new object; its mean is 0."""
        return 1.0

    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (..., m) and first-order covariance (..., m, m) of the leading m entries of `STATE_NAMES`.
        m is 6 of a model with an acceleration, else 5; an entry that the state lacks is 0 with variance 0. The variance
        of a Cartesian state's yaw at speed 0 is large but finite, see `MIN_SPEED_MPS`.
        """
        if self._leads:
            return x, P
        S = self._selection[
            : len(STATE_NAMES) if "accel_mps2" in self.state_names else ACCEL
        ]
        mean = x @ S.T
        J = np.broadcast_to(S, (*x.shape[:-1], *S.shape)).copy()
        if self.cartesian:
            mean[..., YAW:YAW_RATE] = polar(x[..., 2:4])
            J[..., YAW:YAW_RATE, 2:4] = polar_gradient(x[..., 2:4], MIN_SPEED_MPS)
        return mean, symmetrise(congruence(J, P))

    def published(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance as `kinematic` gives them, with the yaw of a Cartesian state to second order.

        With the velocity errors a along and b across the heading, the yaw error is b / speed - a b / speed^2. A slow
        object needs the second term. Its variance is (var(a) var(b) + cov(a, b)^2) / speed^4 (Bar-Shalom, Li and
        Kirubarajan 2001, section 10.3.2). Third-order terms cancel where a and b are equally uncertain.
        """
        mean, covariance = self.kinematic(x, P)
        if not self.cartesian:
            return mean, covariance
        slowest_mps = np.maximum(mean[..., SPEED], MIN_SPEED_MPS)
        product = (
            covariance[..., YAW, YAW] * covariance[..., SPEED, SPEED]
            + covariance[..., YAW, SPEED] ** 2
        )
        covariance[..., YAW, YAW] += product / slowest_mps**2
        return mean, covariance

    def from_kinematic(
        self, mean: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """State and covariance P of this model from a kinematic state; a missing entry is 0 with `start_variance`.
        To the first-order covariance of a Cartesian velocity comes the variance of the product of speed error and yaw
        error, across the heading: without it, an object born at speed 0 could not move sideways.
        """
        n = self.dim
        if self._leads and n <= mean.shape[-1]:
            return mean[..., :n], covariance[..., :n, :n]
        S = self._selection[: mean.shape[-1]]
        x = mean @ S
        J = np.broadcast_to(S.T, (*mean.shape[:-1], *S.T.shape)).copy()
        unknown = [
            0.0 if column.any() else self.start_variance(self.state_names[k])
            for k, column in enumerate(S.T)
        ]
        if self.cartesian:
            unknown[2:4] = 0.0, 0.0
            yaw_speed = mean[..., YAW:YAW_RATE]
            x[..., 2:4], J[..., 2:4, YAW:YAW_RATE] = (
                cartesian(yaw_speed),
                cartesian_gradient(yaw_speed),
            )
        P = symmetrise(congruence(J, covariance)) + np.diag(unknown)
        if self.cartesian:
            product = (
                covariance[..., YAW, YAW] * covariance[..., SPEED, SPEED]
                + covariance[..., YAW, SPEED] ** 2
            )
            across = np.stack(
                [-np.sin(mean[..., YAW]), np.cos(mean[..., YAW])], axis=-1
            )
            P[..., 2:4, 2:4] += (
                product[..., None, None] * across[..., :, None] * across[..., None, :]
            )
        return x, P

    @cached_property
    def _leads(self) -> bool:
        """True if the state is a kinematic state."""
        return self.dim >= ACCEL and self.state_names == STATE_NAMES[: self.dim]

    @cached_property
    def _selection(self) -> FloatArray:
        """1 where an entry of `STATE_NAMES` (rows) and one of the state (columns) have the same name, shape (6, n)."""
        return np.array(
            [
                [float(row == column) for column in self.state_names]
                for row in STATE_NAMES
            ]
        )


@dataclass(frozen=True)
class WhiteNoise(MotionModel):
    """A motion model with a compiled transition, driven by white noise in each entry of the state.
    Noise parameters are spectral densities, in fields `<entry>_density_<unit>` in the order of the state.
    """

    kind: ClassVar[int] = 0
    """Kind of its transition in `fgtrack.models.transitions`."""

    @cached_property
    def is_compiled(self) -> bool:
        """True if compiled loops may take the transition for its own: no subclass has replaced it, or a part of it."""
        own, names = type(self), ("predict", "jacobian", "process_noise", "transition")
        return all(getattr(own, name) is getattr(WhiteNoise, name) for name in names)

    def __post_init__(self) -> None:
        not_negative(**{name: getattr(self, name) for name in self.density_names()})

    @classmethod
    def from_std_per_step(
        cls, std: Mapping[str, float], frequency_hz: float, **others: float
    ) -> Self:
        """Model with the noise of a filter that adds (std / frequency_hz)^2 per step: densities std^2 / frequency_hz.
        `std` is per second, as in Karle et al. 2023, by the names of all densities up to `_density_`: `position`,
        `yaw`, ... `others` are the parameters of the model that are no densities.
        """
        names = {name.partition("_density_")[0]: name for name in cls.density_names()}
        if set(std) != set(names):
            raise ValueError(
                f"std of {cls.__name__}: give {', '.join(names)}, not {', '.join(std) or 'nothing'}"
            )
        return cls(
            **{names[key]: value * value / frequency_hz for key, value in std.items()},
            **others,
        )

    @classmethod
    def density_names(cls) -> tuple[str, ...]:
        """Names of the density fields, in the order of the state."""
        return tuple(each.name for each in fields(cls) if "_density_" in each.name)

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.predict`."""
        return self._moved(x, dt_s).mean

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.jacobian`."""
        return self._moved(x, dt_s).F

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.process_noise`."""
        return self._moved(x, self.forward(dt_s)).Q

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        """See `MotionModel.transition`."""
        return self._moved(x, self.forward(dt_s))

    def _moved(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        """`transition` over durations that may be negative: Q then means nothing."""
        t = np.asarray(dt_s, dtype=np.float64)
        n, shape = self.dim, x.shape[:-1]
        if shape != t.shape:
            shape = np.broadcast_shapes(shape, t.shape)
            x, t = np.broadcast_to(x, (*shape, n)), np.broadcast_to(t, shape)
        states = np.array(x, dtype=np.float64, order="C").reshape(-1, n)
        times_s = np.array(t, order="C").reshape(-1)
        result = Transition(
            np.empty((*shape, n)), np.empty((*shape, n, n)), np.empty((*shape, n, n))
        )
        flat = (
            result.mean.reshape(-1, n),
            result.F.reshape(-1, n, n),
            result.Q.reshape(-1, n, n),
        )
        kernels("fgtrack.models.transitions").transitions(
            self.kind, states, times_s, self.noise, *flat
        )
        return result

    @cached_property
    def density(self) -> FloatArray:
        """Spectral densities of the entries of the state, shape (n,); x and y have the same."""
        first, *others = (getattr(self, name) for name in self.density_names())
        return np.array([first, first, *others])

    @cached_property
    def noise(self) -> FloatArray:
        """Parameters of the compiled transition: the densities, then those that its kind has besides."""
        return self.density


def relaxation_hz(density: float, std: float) -> float:
    """Rate of the Ornstein-Uhlenbeck process with this spectral density and stationary standard deviation, in 1/s."""
    return 0.5 * density / (std * std)


@dataclass(frozen=True)
class CTRV(WhiteNoise):
    """Constant turn rate and velocity; state x, y, yaw, speed, yaw rate.

    x(t) + i y(t) = x + i y + speed * integral over s in [0, t] of exp(i yaw(s)), exact at any yaw rate. White noise
    drives each entry. The default densities are those of Karle et al. 2023: std per second 0.2, 0.3, 1, 0.5 at 100 Hz.

    The yaw rate is stationary, an Ornstein-Uhlenbeck process: it relaxes to zero at the rate `relaxation_hz`. Without
    measurements its standard deviation becomes `yaw_rate_std_radps`, however long that takes. The yaw of a slow object
    has more noise: positions do not show it, see docs/estimators.md.
    """

    position_density_m2ps: float = 0.2**2 / 100.0
    yaw_density_rad2ps: float = 0.3**2 / 100.0
    speed_density_m2ps3: float = 1.0**2 / 100.0
    yaw_rate_density_rad2ps3: float = 0.5**2 / 100.0
    yaw_rate_std_radps: float = field(default=0.5, kw_only=True)
    """Standard deviation of the yaw rate of any object at any time; infinity for a random walk."""
    slow_mps: float = field(default=1.0, kw_only=True)
    """Speed below which the yaw has more noise."""
    resting_yaw_rad2ps: float = field(default=6.0, kw_only=True)
    """Spectral density that is added to that of the yaw, times 1 / (1 + (speed / slow_mps)^2)^2."""

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES[:ACCEL]

    def __post_init__(self) -> None:
        super().__post_init__()
        not_negative(resting_yaw_rad2ps=self.resting_yaw_rad2ps)
        positive(yaw_rate_std_radps=self.yaw_rate_std_radps, slow_mps=self.slow_mps)

    @property
    def relaxation_hz(self) -> float:
        """Rate at which the yaw rate relaxes to zero, see `relaxation_hz`."""
        return relaxation_hz(self.yaw_rate_density_rad2ps3, self.yaw_rate_std_radps)

    @cached_property
    def noise(self) -> FloatArray:
        """See `WhiteNoise.noise` and `fgtrack.models.transitions`."""
        return np.array(
            [*self.density, self.relaxation_hz, self.slow_mps, self.resting_yaw_rad2ps]
        )


@dataclass(frozen=True)
class CTRA(CTRV):
    """Constant turn rate and acceleration: CTRV with the acceleration along the heading as sixth entry.

    x(t) + i y(t) = x + i y + integral over s in [0, t] of (speed + accel s) exp(i yaw(s)); by default with the noise of
    Karle et al. 2023 (see `CTRV`), for the acceleration std 3 per second at 100 Hz.
    """

    accel_density_m2ps5: float = 3.0**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES


@dataclass(frozen=True)
class CT(WhiteNoise):
    """Coordinated turn: constant turn rate with the velocity along the axes of the map; x, y, vx, vy, yaw rate.

    The velocity turns with the yaw rate, which relaxes to zero as that of `CTRV`. White noise acceleration drives vx
    and vy alike. Positions are linear in this state but for the yaw rate, so it takes no false evidence of a heading
    from an object at rest. It has no heading where the speed is zero: take `CTRV` where a sensor measures the yaw. By
    default with the noise of Karle et al. 2023 (see `CTRV`).
    """

    position_density_m2ps: float = 0.2**2 / 100.0
    velocity_density_m2ps3: float = 1.0**2 / 100.0
    yaw_rate_density_rad2ps3: float = 0.5**2 / 100.0
    yaw_rate_std_radps: float = field(default=0.5, kw_only=True)
    """Standard deviation of the yaw rate of any object at any time; infinity for a random walk."""

    state_names: ClassVar[tuple[str, ...]] = (*CARTESIAN, "yaw_rate_radps")
    kind: ClassVar[int] = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        positive(yaw_rate_std_radps=self.yaw_rate_std_radps)

    @property
    def relaxation_hz(self) -> float:
        """See `CTRV.relaxation_hz`."""
        return relaxation_hz(self.yaw_rate_density_rad2ps3, self.yaw_rate_std_radps)

    @cached_property
    def density(self) -> FloatArray:
        """See `WhiteNoise.density`; vx and vy have the same."""
        q_position, q_velocity, q_yaw_rate = (
            getattr(self, name) for name in self.density_names()
        )
        return np.array([q_position, q_position, q_velocity, q_velocity, q_yaw_rate])

    @cached_property
    def noise(self) -> FloatArray:
        """See `WhiteNoise.noise` and `fgtrack.models.transitions`."""
        return np.array([*self.density, self.relaxation_hz])


@dataclass(frozen=True)
class CV(WhiteNoise):
    """Constant velocity, linear; state x, y and the velocities vx, vy along the axes of the map.

    White noise acceleration drives vx and vy alike, by default with the speed's density of Karle et al. 2023 (see
    `CTRV`).
    """

    velocity_density_m2ps3: float = 1.0**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = CARTESIAN
    linear: ClassVar[bool] = True
    kind: ClassVar[int] = 1

    @cached_property
    def density(self) -> FloatArray:
        """See `WhiteNoise`: that of the velocity."""
        return np.array(
            [0.0, 0.0, self.velocity_density_m2ps3, self.velocity_density_m2ps3]
        )
