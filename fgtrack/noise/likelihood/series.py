"""Measurements of one object with the noise of each in parts, fitted and not fitted, and the parameters of a fit."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray
from fgtrack.estimation.base import UNKNOWN_YAW_STD_RAD, Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.initiation import Initiation
from fgtrack.estimation.filters.track_initiation import TrackInitiation
from fgtrack.models.correlated_errors import CorrelatedErrors
from fgtrack.models.motion import CT, CTRV, MotionModel, WhiteNoise


@dataclass(frozen=True)
class NoiseSpace:
    """The positive parameters in one vector: noise of the motion, then of each sensor, then shares of outliers."""

    motion_names: tuple[str, ...]
    motion: Callable[[Mapping[str, float]], MotionModel]
    """The motion model with these parameters, by name of `motion_names`; where its noise is white they are standard
    deviations."""
    sensors: Mapping[str, tuple[str, ...]]
    """Components by sensor."""

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(sensor, component) of each standard deviation; ("", name) for the motion, (sensor, "") for outliers."""
        motion = [("", name) for name in self.motion_names]
        stds = [
            (sensor, name)
            for sensor, components in self.sensors.items()
            for name in components
        ]
        return (*motion, *stds, *((sensor, "") for sensor in self.sensors))

    @property
    def num_motion(self) -> int:
        """Number of leading parameters that belong to the motion."""
        return len(self.motion_names)

    def motion_model(self, values: Sequence[float] | FloatArray) -> MotionModel:
        """The motion model of `values`, shape (p,)."""
        return self.motion(
            dict(zip(self.motion_names, map(float, values), strict=False))
        )

    def noise_parts(
        self, x: FloatArray, dt_s: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Q = rest + sum of value_i^2 part_i at states `x` (..., n) over `dt_s` (...); None if Q has no such parts.
        Q has none where the noise is not white, and where a yaw rate relaxes: F depends on the density there. The rest
        has shape (..., n, n), the parts have shape (q, ..., n, n).
        """
        model = self.motion_model(np.ones(self.num_motion))
        base = model.base if isinstance(model, CorrelatedErrors) else model
        if not (self.num_motion and isinstance(base, WhiteNoise)):
            return None
        if isinstance(base, (CT, CTRV)) and base.relaxation_hz > 0.0:
            return None
        rest = self.motion_model(np.zeros(self.num_motion)).process_noise(x, dt_s)
        units = np.eye(self.num_motion)
        return rest, np.array(
            [self.motion_model(unit).process_noise(x, dt_s) - rest for unit in units]
        )


@dataclass(frozen=True, slots=True)
class Observation:
    """One measurement of a sensor; the covariance of its error is T diag(std^2) T' + `own` + `foreign`.
    The first d components are measured. Those that follow are assumed, as a heading from a map: they move the state,
    but have no part in the likelihood and keep their noise.
    """

    sensor: str
    measurement: Measurement
    measured: tuple[int, ...]
    """Indices of the d components that were measured."""
    assumed: tuple[int, ...]
    """Indices of the others."""
    axes: FloatArray
    """T, shape (d, d): the axes of the sensor's standard deviations, seen from those of the measurement."""
    own: FloatArray
    """Covariance to which the standard deviations do not apply, as that of the detection, shape (d, d); else 0."""
    foreign: FloatArray
    """Covariance of errors that are not the sensor's, as those of the ego pose, shape (d, d)."""

    @property
    def tuned(self) -> bool:
        """True if the standard deviations of the sensor apply."""
        return not self.own.any()

    @property
    def parameters(self) -> list[tuple[str, str]]:
        """Names in `NoiseSpace.names` of the standard deviations that apply."""
        components = self.measurement.model.components
        return (
            [(self.sensor, components[i]) for i in self.measured] if self.tuned else []
        )


@dataclass(frozen=True, slots=True)
class Series:
    """The observations of one track by rising stamp, and the first state."""

    start: Start
    observations: Sequence[Observation]
    from_ns: float = -math.inf
    """Innovations before this stamp have no part in the likelihood."""
    until_ns: float = math.inf
    """Nor have those from this stamp on."""
    nominal: tuple[FloatArray, ...] = ()
    """States (n,) of a nominal trajectory at the start and at each of the first observations, about which these are
    linearised; empty where the filter is linearised at its own estimates from the start."""
    mixed: frozenset[int] = frozenset()
    """Indices of observations whose innovations have no part in the likelihood either; see `without_mixed`."""
    settle_s: float = 1.0
    """Nor have those of the first seconds with a known direction of travel, which are those of the first state."""
    settle_steps: int = 5
    """Nor have as many of the first ones."""

    @property
    def num_initial(self) -> int:
        """Number of the first observations that are linearised about `nominal`."""
        return max(len(self.nominal) - 1, 0)

    @property
    def initiated_ns(self) -> int:
        """Stamp of the last of these, or of the start where there are none."""
        return (
            self.observations[self.num_initial - 1].measurement.stamp_ns
            if self.nominal
            else self.start.stamp_ns
        )

    @property
    def counted(self) -> BoolArray:
        """True for observations whose innovations have a part in the likelihood, shape (k,)."""
        stamps_ns = np.array([item.measurement.stamp_ns for item in self.observations])
        counted = (stamps_ns - self.initiated_ns >= NS_PER_S * self.settle_s) & (
            stamps_ns >= self.from_ns
        )
        counted &= stamps_ns < self.until_ns
        counted[: self.num_initial + self.settle_steps] = False
        counted[list(self.mixed)] = False
        return counted

    def initiated(self, motion: MotionModel, method: Initiation) -> "Series":
        """Return it with a nominal trajectory along the first positions, where `start` has no direction of travel.
        As in the tracker (see `TrackInitiation`); unchanged where no line leads through the positions.
        """
        search, count = TrackInitiation.of(motion, self.start, method), 0
        if search is None:
            return self
        for observation in self.observations:
            longer = search.with_measurement(observation.measurement)
            if longer is None:
                break
            search, count = longer, count + 1
        try:
            states = [search.nominal(initial_state(motion, self.start)[0])]
        except np.linalg.LinAlgError:
            return self
        stamp_ns, start = self.start.stamp_ns, self.start
        for observation in self.observations[:count]:
            after_ns = observation.measurement.stamp_ns
            states.append(motion.predict(states[-1], seconds(after_ns - stamp_ns)))
            stamp_ns = after_ns
        if not motion.cartesian:
            std_rad = (
                UNKNOWN_YAW_STD_RAD if start.yaw_std_rad is None else start.yaw_std_rad
            )
            start = replace(start, yaw_rad=float(states[0][YAW]), yaw_std_rad=std_rad)
        return replace(self, start=start, nominal=tuple(states))


def positive_part(matrix: FloatArray) -> FloatArray:
    """Return the nearest positive semidefinite matrix to a symmetric `matrix`, shape (k, k)."""
    values, vectors = np.linalg.eigh(symmetrise(matrix))
    return symmetrise(congruence(vectors, np.diag(np.maximum(values, 0.0))))
