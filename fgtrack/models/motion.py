"""Motion models CTRV, CTRA, CT and CV: exact prediction, Jacobian and composing process noise.

All functions broadcast a state `x` of shape (..., n) with a duration `dt_s`. The
duration is a float or an array of shape (...), and may be negative for `predict` and
`jacobian`. Only `MeasurementModel.residual` wraps the yaw.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from fgtrack.core.checks import not_negative, positive
from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian, cartesian_gradient, polar, polar_gradient
from fgtrack.core.linalg import congruence, kernels, symmetrise
from fgtrack.core.types import ACCEL, SPEED, STATE_NAMES, YAW, YAW_RATE, FloatArray

#: Every state begins with the entries of `POLAR` or of `CARTESIAN`.
POLAR = STATE_NAMES[:4]
CARTESIAN = ("x_m", "y_m", "vx_mps", "vy_mps")
#: The derivative of the heading by the velocity grows as 1 / speed. Below this speed it is held constant.
MIN_SPEED_MPS = 1e-3


class Transition(NamedTuple):
    """Predicted states with their Jacobian and process noise."""

    mean: FloatArray
    """Predicted states, shape (..., n); the yaw is not wrapped."""
    F: FloatArray
    """Derivative of the predicted by the initial state, shape (..., n, n)."""
    Q: FloatArray
    """Covariance of the accumulated process noise, shape (..., n, n)."""


class MotionModel(ABC):
    """Motion of an object between two stamps with its uncertainty; models are frozen dataclasses.

    A model defines `state_names`, `predict`, `jacobian` and `process_noise`. Estimators
    call `transition`. A model that computes the three results together overrides
    `transition`.

    Fields named `<entry>_density_<unit>` are spectral densities of the noise. A
    configuration sets them by `motion.std_per_s`, and `fgtrack tune` fits them.
    """

    state_names: ClassVar[tuple[str, ...]]
    """Names of the n entries of the state: `POLAR` or `CARTESIAN` first, then any others."""
    linear: ClassVar[bool] = False
    """True if the Jacobian is the same at every state."""

    @cached_property
    def dim(self) -> int:
        """Number n of entries of the state."""
        return len(self.state_names)

    @cached_property
    def cartesian(self) -> bool:
        """True if the state contains the velocity as vx and vy instead of yaw and speed."""
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

        The noise composes: Q(x, a + b) = F(x_a, b) Q(x, a) F(x_a, b)' + Q(x_a, b) with
        x_a = predict(x, a). Raises `CallError` if `dt_s` is negative; call `forward`
        for this check.
        """

    @classmethod
    def density_names(cls) -> tuple[str, ...]:
        """Names of the noise densities: the fields `<entry>_density_<unit>`, in their order."""
        if not is_dataclass(cls):
            return ()
        return tuple(each.name for each in fields(cls) if "_density_" in each.name)

    @classmethod
    def densities_of(
        cls, std: Mapping[str, float], frequency_hz: float
    ) -> dict[str, float]:
        """Densities std^2 / frequency_hz of a filter that adds (std / frequency_hz)^2 per step, by the field names.

        `std` is per second, as in Karle et al. 2023. Its keys are the names of all densities up to `_density_`:
        `position`, `yaw`, ... Raises `ValueError` for other keys.
        """
        names = {name.partition("_density_")[0]: name for name in cls.density_names()}
        if set(std) != set(names):
            raise ValueError(
                f"std of {cls.__name__}: give {', '.join(names) or 'none'}, not {', '.join(std) or 'nothing'}"
            )
        return {names[key]: value * value / frequency_hz for key, value in std.items()}

    @classmethod
    def from_std_per_step(
        cls, std: Mapping[str, float], frequency_hz: float, **others: float
    ) -> Self:
        """Return the model with the noise `densities_of`; `others` are the remaining parameters of the model."""
        return cls(**cls.densities_of(std, frequency_hz), **others)

    @staticmethod
    def forward(dt_s: float | FloatArray) -> FloatArray:
        """Return `dt_s` as an array.

        Raises `CallError` if a duration is negative, because noise accumulates only
        forwards in time.
        """
        t = np.asarray(dt_s, dtype=np.float64)
        if (t < 0.0).any():
            raise CallError(
                f"process_noise: dt_s is {t.min()} s; the duration must be >= 0, swap the two stamps"
            )
        return t

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        """Return `predict`, `jacobian` and `process_noise` of the states `x`.

        Raises `CallError` if `dt_s` is negative.
        """
        return Transition(
            self.predict(x, dt_s), self.jacobian(x, dt_s), self.process_noise(x, dt_s)
        )

    def start_variance(self, name: str) -> float:
        """Return the variance of the entry `name` of a new object that was not observed. Its mean is 0."""
        return 1.0

    def kinematic(self, x: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (..., m) and first-order covariance (..., m, m) of the first m entries of `STATE_NAMES`.

        m is 6 for a model with an acceleration, else 5. An entry that the state lacks
        is 0 with variance 0. The yaw variance of a Cartesian state at speed 0 is large
        but finite, see `MIN_SPEED_MPS`.
        """
        if self._is_kinematic:
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
        """Return the state and covariance P of this model from a kinematic state and its covariance.

        An entry that the kinematic state lacks is 0 with variance `start_variance`. A
        Cartesian state has an additional variance across the heading: the variance of
        the product of speed error and yaw error. Without it, an object born at speed 0
        could not move sideways.
        """
        n = self.dim
        if self._is_kinematic and n <= mean.shape[-1]:
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
            x[..., 2:4] = cartesian(yaw_speed)
            J[..., 2:4, YAW:YAW_RATE] = cartesian_gradient(yaw_speed)
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
    def _is_kinematic(self) -> bool:
        """True if the state consists of the first entries of `STATE_NAMES`, in their order."""
        return self.dim >= ACCEL and self.state_names == STATE_NAMES[: self.dim]

    @cached_property
    def _selection(self) -> FloatArray:
        """Matrix (6, n): 1 where the row's `STATE_NAMES` entry equals the column's state entry."""
        return np.array(
            [
                [float(row == column) for column in self.state_names]
                for row in STATE_NAMES
            ]
        )


@dataclass(frozen=True)
class WhiteNoise(MotionModel):
    """Motion model with a compiled transition, driven by white noise in each state entry.

    Noise parameters are spectral densities. Their fields are named
    `<entry>_density_<unit>`, in state order.
    """

    kind: ClassVar[int] = 0
    """Number of the model's transition in `fgtrack.models.transitions`."""

    @cached_property
    def is_compiled(self) -> bool:
        """True if compiled loops may use the compiled transition, as no subclass has overridden it."""
        own = type(self)
        names = ("predict", "jacobian", "process_noise", "transition")
        return all(getattr(own, name) is getattr(WhiteNoise, name) for name in names)

    def __post_init__(self) -> None:
        not_negative(**{name: getattr(self, name) for name in self.density_names()})

    def predict(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.predict`."""
        return self._unchecked_transition(x, dt_s).mean

    def jacobian(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.jacobian`."""
        return self._unchecked_transition(x, dt_s).F

    def process_noise(self, x: FloatArray, dt_s: float | FloatArray) -> FloatArray:
        """See `MotionModel.process_noise`."""
        return self._unchecked_transition(x, self.forward(dt_s)).Q

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        """See `MotionModel.transition`."""
        return self._unchecked_transition(x, self.forward(dt_s))

    def _unchecked_transition(
        self, x: FloatArray, dt_s: float | FloatArray
    ) -> Transition:
        """Return the transition without checking `dt_s`; Q has no meaning for a negative duration."""
        t = np.asarray(dt_s, dtype=np.float64)
        n = self.dim
        shape = x.shape[:-1]
        if shape != t.shape:
            shape = np.broadcast_shapes(shape, t.shape)
            x = np.broadcast_to(x, (*shape, n))
            t = np.broadcast_to(t, shape)
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
        """Spectral density of each state entry, shape (n,); x and y share the first one."""
        first, *others = (getattr(self, name) for name in self.density_names())
        return np.array([first, first, *others])

    @cached_property
    def noise(self) -> FloatArray:
        """Parameters of the compiled transition: the densities, then the model's other parameters."""
        return self.density


def relaxation_hz(density: float, std: float) -> float:
    """Relaxation rate [1/s] of an Ornstein-Uhlenbeck process.

    `density` is its spectral density, and `std` its stationary standard deviation.
    """
    return 0.5 * density / (std * std)


@dataclass(frozen=True)
class CTRV(WhiteNoise):
    """Constant turn rate and velocity; state x, y, yaw, speed, yaw rate.

    x(t) + i y(t) = x + i y + speed * integral over s in [0, t] of exp(i yaw(s)), exact
    at any yaw rate. White noise drives each entry. The default densities are from Karle
    et al. 2023: std per second 0.2, 0.3, 1, 0.5 at 100 Hz.

    The yaw rate is a stationary Ornstein-Uhlenbeck process. It relaxes to zero at the
    rate `relaxation_hz`. Without measurements its standard deviation converges to
    `yaw_rate_std_radps`.

    The yaw of a slow object has additional noise, because positions do not observe this
    yaw. See docs/estimators.md.
    """

    position_density_m2ps: float = 0.2**2 / 100.0
    yaw_density_rad2ps: float = 0.3**2 / 100.0
    speed_density_m2ps3: float = 1.0**2 / 100.0
    yaw_rate_density_rad2ps3: float = 0.5**2 / 100.0
    yaw_rate_std_radps: float = field(default=0.5, kw_only=True)
    """Stationary standard deviation of the yaw rate; infinity gives a random walk."""
    slow_mps: float = field(default=1.0, kw_only=True)
    """Speed below which the yaw has additional noise."""
    resting_yaw_rad2ps: float = field(default=6.0, kw_only=True)
    """Additional spectral density of the yaw of an object at rest.

    At other speeds it is multiplied by 1 / (1 + (speed / slow_mps)^2)^2.
    """

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

    x(t) + i y(t) = x + i y + integral over s in [0, t] of (speed + accel s) exp(i
    yaw(s)). The default noise is from Karle et al. 2023 (see `CTRV`). The acceleration
    has std 3 per second at 100 Hz.
    """

    accel_density_m2ps5: float = 3.0**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES


@dataclass(frozen=True)
class CT(WhiteNoise):
    """Coordinated turn with constant turn rate; state x, y, vx, vy, yaw rate.

    The velocity, along the axes of the map, turns with the yaw rate. The yaw rate
    relaxes to zero as in `CTRV`. White-noise acceleration drives vx and vy alike. The
    default noise is from Karle et al. 2023 (see `CTRV`).

    The position depends linearly on all entries except the yaw rate. So an object at
    rest gives no false evidence of a heading. At speed zero the state has no heading:
    use `CTRV` if a sensor measures the yaw.
    """

    position_density_m2ps: float = 0.2**2 / 100.0
    velocity_density_m2ps3: float = 1.0**2 / 100.0
    yaw_rate_density_rad2ps3: float = 0.5**2 / 100.0
    yaw_rate_std_radps: float = field(default=0.5, kw_only=True)
    """Stationary standard deviation of the yaw rate; infinity gives a random walk."""

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
        """See `WhiteNoise.density`; vx and vy share one density."""
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
    """Constant velocity, a linear model; state x, y, vx, vy along the axes of the map.

    White-noise acceleration drives vx and vy alike. The default density is the speed
    density of Karle et al. 2023 (see `CTRV`).
    """

    velocity_density_m2ps3: float = 1.0**2 / 100.0

    state_names: ClassVar[tuple[str, ...]] = CARTESIAN
    linear: ClassVar[bool] = True
    kind: ClassVar[int] = 1

    @cached_property
    def density(self) -> FloatArray:
        """See `WhiteNoise.density`; only the velocity has noise."""
        return np.array(
            [0.0, 0.0, self.velocity_density_m2ps3, self.velocity_density_m2ps3]
        )
