"""Observations of one track with their noise split into parts, and the parameter vector of a fit."""

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
    """Names and order of the positive noise parameters in one vector.

    First comes the noise of the motion, then the standard deviations of each sensor.
    The share of outliers of each sensor comes last.
    """

    motion_names: tuple[str, ...]
    motion: Callable[[Mapping[str, float]], MotionModel]
    """Factory of the motion model from its parameters by name (`motion_names`).

    For a white-noise model the parameters are standard deviations.
    """
    sensors: Mapping[str, tuple[str, ...]]
    """Measured components by sensor."""

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """Name (sensor, component) of each parameter.

        Motion parameters have the name ("", name), and shares of outliers (sensor, "").
        """
        motion = [("", name) for name in self.motion_names]
        stds = [
            (sensor, name)
            for sensor, components in self.sensors.items()
            for name in components
        ]
        return (*motion, *stds, *((sensor, "") for sensor in self.sensors))

    @property
    def num_motion(self) -> int:
        """Number of motion parameters; they are the first ones."""
        return len(self.motion_names)

    def motion_model(self, values: Sequence[float] | FloatArray) -> MotionModel:
        """Return the motion model with the parameters `values`, shape (p,)."""
        return self.motion(
            dict(zip(self.motion_names, map(float, values), strict=False))
        )

    def noise_parts(
        self, x: FloatArray, dt_s: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Split the process noise at states `x` (..., n): Q = rest + sum of value_i^2 part_i.

        Returns the rest (..., n, n) and the parts (q, ..., n, n), over the durations
        `dt_s` (...). Returns None if Q cannot be split: the noise is not white, or a
        yaw rate relaxes. In the second case F depends on the density too.
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
    """Measurement of a sensor whose error has the covariance T diag(std^2) T' + `own` + `other_errors`.

    The measured components contribute to the likelihood. Assumed components, such as a
    heading from a map, update the state and keep their noise. They do not contribute to
    the likelihood.
    """

    sensor: str
    measurement: Measurement
    measured: tuple[int, ...]
    """Indices of the d measured components."""
    assumed: tuple[int, ...]
    """Indices of the assumed components."""
    axes: FloatArray
    """Rotation T from the axes of the sensor's standard deviations to the axes of the measurement, shape (d, d)."""
    own: FloatArray
    """Covariance that replaces the sensor's standard deviations, shape (d, d).

    For instance the covariance that the detection reports. Zero if the standard
    deviations apply.
    """
    other_errors: FloatArray
    """Covariance of errors from other sources, for instance the ego pose, shape (d, d)."""

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
    """Observations of one track in ascending order of stamps, with the first state."""

    start: Start
    observations: Sequence[Observation]
    from_ns: float = -math.inf
    """Innovations before this stamp do not contribute to the likelihood."""
    until_ns: float = math.inf
    """Innovations at or after this stamp do not contribute to the likelihood."""
    nominal: tuple[FloatArray, ...] = ()
    """States (n,) of a nominal trajectory at the start and at each of the first observations.

    These observations are linearised about it. If empty, the filter is linearised about
    its own estimates.
    """
    mixed: frozenset[int] = frozenset()
    """Indices of observations whose innovations do not contribute, see `with_mixed_marked`."""
    settle_s: float = 1.0
    """Length of the first part whose innovations do not contribute, as they depend on the first state.

    The time counts from the end of the nominal trajectory.
    """
    settle_steps: int = 5
    """Number of first innovations, after the nominal trajectory, that do not contribute."""

    @property
    def num_initial(self) -> int:
        """Number of observations that are linearised about the nominal trajectory."""
        return max(len(self.nominal) - 1, 0)

    @property
    def initiated_ns(self) -> int:
        """Stamp of the last observation on the nominal trajectory; the stamp of the start if there is no such
        observation.
        """
        return (
            self.observations[self.num_initial - 1].measurement.stamp_ns
            if self.nominal
            else self.start.stamp_ns
        )

    @property
    def counted(self) -> BoolArray:
        """Mask of the observations whose innovations contribute to the likelihood, shape (k,)."""
        stamps_ns = np.array([item.measurement.stamp_ns for item in self.observations])
        counted = (stamps_ns - self.initiated_ns >= NS_PER_S * self.settle_s) & (
            stamps_ns >= self.from_ns
        )
        counted &= stamps_ns < self.until_ns
        counted[: self.num_initial + self.settle_steps] = False
        counted[list(self.mixed)] = False
        return counted

    def initiated(self, motion: MotionModel, method: Initiation) -> "Series":
        """Return the series with a nominal trajectory if its start has no direction of travel.

        The trajectory follows the first positions, as in the tracker (see
        `TrackInitiation`). Returns the series unchanged if no trajectory fits the
        positions.
        """
        search = TrackInitiation.of(motion, self.start, method)
        if search is None:
            return self
        count = 0
        for observation in self.observations:
            longer = search.with_measurement(observation.measurement)
            if longer is None:
                break
            search = longer
            count += 1
        try:
            states = [search.nominal(initial_state(motion, self.start)[0])]
        except np.linalg.LinAlgError:
            return self
        start = self.start
        stamp_ns = start.stamp_ns
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
    """Return the positive semidefinite matrix nearest to the symmetric `matrix`, shape (k, k)."""
    values, vectors = np.linalg.eigh(symmetrise(matrix))
    return symmetrise(congruence(vectors, np.diag(np.maximum(values, 0.0))))
