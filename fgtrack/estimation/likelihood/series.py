"""Measurements of one object, with the noise of each in parts: fitted, and not fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation.base import UNKNOWN_YAW_STD_RAD, Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.initiation import Initiation
from fgtrack.estimation.filters.track_initiation import TrackInitiation
from fgtrack.models.motion import MotionModel


@dataclass(frozen=True, slots=True)
class Observation:
    """One measurement of a sensor; the covariance of its error is T diag(std^2) T' + `own` + `foreign`.

    The first d components are measured. Those that follow are assumed, as a heading from a map: they move the state as
    in the tracker, but they are no measurements, have no part in the likelihood and keep their noise.
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


@dataclass(frozen=True, slots=True)
class Series:
    """The observations of one track by rising stamp, and the first state."""

    start: Start
    observations: Sequence[Observation]
    from_ns: int | None = None
    """Innovations before this stamp have no part in the likelihood; None for no limit."""
    until_ns: int | None = None
    """Nor have those from this stamp on."""
    nominal: tuple[FloatArray, ...] = ()
    """States (n,) of a nominal trajectory at the start and at each of the first observations, about which these are
    linearised; empty where the filter is linearised at its own estimates from the start."""
    mixed: frozenset[int] = frozenset()
    """Indices of observations whose innovations have no part in the likelihood either; see `without_mixed`."""

    @property
    def num_initial(self) -> int:
        """Number of the first observations that are linearised about `nominal`."""
        return max(len(self.nominal) - 1, 0)

    @property
    def initiated_ns(self) -> int:
        """Stamp of the last of these, or of the start where there are none."""
        return self.observations[self.num_initial - 1].measurement.stamp_ns if self.nominal else self.start.stamp_ns

    def initiated(self, motion: MotionModel, method: Initiation) -> "Series":
        """Return it with a nominal trajectory along the first positions, where `start` has no direction of travel.

        As in the tracker (see `TrackInitiation`): an EKF that starts in a wrong direction takes many seconds to turn,
        in which its innovations say nothing of the noise. Unchanged where no line leads through the positions.
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
            std_rad = UNKNOWN_YAW_STD_RAD if start.yaw_std_rad is None else start.yaw_std_rad
            start = replace(start, yaw_rad=float(states[0][YAW]), yaw_std_rad=std_rad)
        return replace(self, start=start, nominal=tuple(states))


def positive_part(matrix: FloatArray) -> FloatArray:
    """Return the nearest positive semidefinite matrix to a symmetric `matrix`, shape (k, k)."""
    values, vectors = np.linalg.eigh(symmetrise(matrix))
    return symmetrise(congruence(vectors, np.diag(np.maximum(values, 0.0))))
