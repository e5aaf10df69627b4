"""One object list, ready for decisions."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, Detection, EgoState, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.correlated_errors import split_error
from fgtrack.models.measurement import MeasurementModel, measurement_model
from fgtrack.models.motion import CT, MotionModel
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.inbox import Batch
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.preprocess import Candidate, Candidates, Group, StampError

#: Components that a velocity along the axes of the map does not show well at low speed, or that are no measurement.
_LEFT_OUT = {"yaw_rad", "curvature_radpm"}
_SPEED_OF_CLUTTER_MPS = 30.0


def decision_motion(motion: MotionModel) -> MotionModel:
    """Return the motion model of decisions: `motion`, or `CT` with its noise for a state with yaw and speed.

    A first position gives no direction. A Cartesian velocity expresses this without an assumed yaw.
    """
    if motion.cartesian:
        return motion
    noise = {
        "position_density_m2ps": "position_density_m2ps",
        "velocity_density_m2ps3": "speed_density_m2ps3",
        "yaw_rate_density_rad2ps3": "yaw_rate_density_rad2ps3",
        "yaw_rate_std_radps": "yaw_rate_std_radps",
    }
    given = {
        own: getattr(motion, theirs)
        for own, theirs in noise.items()
        if hasattr(motion, theirs)
    }
    return CT(**given)


class Description(NamedTuple):
    """Class and identity that most detections of a track have given; None without one."""

    classes: Mapping[str, int]
    ids: Mapping[str, int]

    @property
    def class_name(self) -> str | None:
        """The most frequent class."""
        return _most(self.classes)

    @property
    def identity(self) -> str | None:
        """The most frequent identity."""
        return _most(self.ids)

    def learned(self, other: "Description") -> "Description":
        """Return the description by both."""
        return Description(_sum(self.classes, other.classes), _sum(self.ids, other.ids))


NOTHING = Description({}, {})


def described(detections: Iterable[Detection]) -> Description:
    """Return the description by `detections`."""
    classes: dict[str, int] = {}
    ids: dict[str, int] = {}
    for each in detections:
        if each.class_name is not None:
            classes[each.class_name] = classes.get(each.class_name, 0) + 1
        if each.id is not None:
            ids[each.id] = ids.get(each.id, 0) + 1
    return Description(classes, ids) if classes or ids else NOTHING


def _sum(a: Mapping[str, int], b: Mapping[str, int]) -> Mapping[str, int]:
    if not b:
        return a
    return {key: a.get(key, 0) + b.get(key, 0) for key in {**a, **b}}


def _most(counts: Mapping[str, int]) -> str | None:
    return max(sorted(counts), key=counts.__getitem__) if counts else None


@dataclass(frozen=True)
class Starts:
    """First states of the tracks that the candidates of a list would start."""

    birth: Birth
    road: Road
    ego: EgoState | None
    """Ego at the stamp of the list."""
    ego_in_pit: bool

    def of(self, candidate: Candidate) -> Start | None:
        """Return the first state of the track that a candidate would start; None without a position."""
        return self.birth.prior(candidate, self.road, self.ego, self.ego_in_pit)


@dataclass(eq=False)
class Entry:
    """An object list with its candidates."""

    batch: Batch
    candidates: Candidates
    scan: Scan
    sensor: SensorModel
    index: int
    """Number of the sensor."""
    motion: MotionModel
    scores: FloatArray
    """Logarithms of p(score | object) / p(score | clutter), shape (m,)."""
    may_start: BoolArray
    """True for each candidate that may start a track, shape (m,)."""
    starts: Starts
    roots: list[int] = field(default_factory=list)
    """Numbers of the tracks that the candidates would start."""
    number: int = 0
    """Number of the list in the order of arrival."""
    free: tuple[FloatArray, FloatArray] | None = None
    """Log-density of the candidates without a track (m,), and the probability that they start one (m,), once known."""

    _starts: dict[int, Start | None] = field(default_factory=dict)
    _states: dict[int, tuple[FloatArray, FloatArray] | None] = field(
        default_factory=dict
    )

    def start(self, position: int) -> Start | None:
        """Return the first state of the track that a candidate would start; None without one."""
        if position not in self._starts:
            self._starts[position] = self.starts.of(self.candidates[position])
        return self._starts[position]

    def state(self, position: int) -> tuple[FloatArray, FloatArray] | None:
        """Return mean and covariance of `start` in the state of the motion model of decisions; None without one."""
        if position not in self._states:
            start = self.start(position)
            self._states[position] = (
                None if start is None else initial_state(self.motion, start)
            )
        return self._states[position]

    @cached_property
    def key(self) -> tuple[int, str, bytes]:
        """Sort key: stamp, sensor and contents, so that the order of arrival does not matter."""
        return (
            self.batch.stamp_ns,
            self.batch.message.sensor,
            self.candidates.lines.tobytes(),
        )

    @cached_property
    def groups(self) -> list[Group]:
        """The measurements of decisions, with their whole errors, in the state of the motion model of decisions."""
        return [own for each in self.candidates.groups for own in _groups(each, self)]

    @property
    def jump_probability(self) -> float:
        """Probability that the correlated error of a detection is new."""
        correlation = self.sensor.correlation
        return 0.0 if correlation is None else correlation.jump_probability

    @cached_property
    def errors(self) -> list[int]:
        """Indices of the time-correlated errors of the sensor in the state."""
        first = f"{self.batch.message.sensor}."
        names = self.motion.state_names
        return [row for row, name in enumerate(names) if name.startswith(first)]

    @cached_property
    def placed(self) -> BoolArray:
        """True for each candidate with a position, shape (m,)."""
        return np.array(self.candidates.placed, dtype=bool)

    @cached_property
    def log_clutter(self) -> FloatArray:
        """Logarithm of the density of clutter at each candidate, relative to its score, shape (m,).

        The density is that of the measured components. Clutter is uniform in the directions of a bearing.
        """
        per_m2 = math.log(self.sensor.clutter_per_m2)
        result = np.where(self.placed, per_m2, -math.log(math.tau)) - self.scores
        for group in self.groups:
            result[group.rows] += _log_others(group)
        return result

    @cached_property
    def descriptions(self) -> list[Description]:
        """Classes and identities of the candidates."""
        return [
            described(self.candidates.described(self.batch, position))
            for position in range(len(self.candidates))
        ]

    @cached_property
    def describes(self) -> bool:
        """True if a detection of the list has a class, an identity or a size."""
        return any(
            value is not None
            for each in self.batch.message.objects
            for value in (
                each.class_name,
                each.id,
                each.length_m,
                each.width_m,
                each.height_m,
            )
        )

    @cached_property
    def is_described(self) -> bool:
        """True if a candidate has a class or an identity."""
        return any(each is not NOTHING for each in self.descriptions)


def _groups(group: Group, entry: Entry) -> Iterator[Group]:
    """Yield the measurements of `group` with the components that decisions use.

    Candidates with time-correlated errors are a group each, as in `fgtrack.tracking.preprocess`.
    """
    own, motion, sensor = group.stack, entry.motion, entry.sensor
    names = own.model.components
    kept = [
        row
        for row, name in enumerate(names)
        if name not in _LEFT_OUT and name not in own.assumed
    ]
    model = measurement_model(names, motion)
    late = (
        None
        if group.stamp_error is None
        else StampError(motion, group.stamp_error.std_s)
    )
    if sensor.correlation is None:
        z, R = own.z[:, kept], group.spread[:, kept][:, :, kept]
        stack = _measurement(own, model.part(kept), z, R)
        yield Group(group.rows, stack, stack.R, None, late)
        return
    name = entry.batch.message.sensor
    for k, whole in enumerate(group.spread):
        split, white = split_error(name, sensor, model, whole, motion.state_names)
        z, R = own.z[k : k + 1, kept], white[None][:, kept][:, :, kept]
        stack = _measurement(own, split.part(kept), z, R)
        yield Group(group.rows[k : k + 1], stack, stack.R, None, late)


def _measurement(
    own: Measurement, model: MeasurementModel, z: FloatArray, R: FloatArray
) -> Measurement:
    z, R = np.ascontiguousarray(z), np.ascontiguousarray(R)
    return Measurement(own.stamp_ns, model, z, R, own.pose, own.loss)


def _log_others(group: Group) -> FloatArray:
    """Return the log-density of clutter in the components besides the position, and in polar coordinates, (m,).

    The density of positions per m^2 is that per metre and radian over the range.
    """
    names, z = group.stack.model.components, group.stack.z
    result = np.zeros(len(z))
    for row, name in enumerate(names):
        if name == "range_m":
            result += np.log(np.maximum(z[:, row], 1.0))
        elif name.endswith("_mps"):
            result -= math.log(2.0 * _SPEED_OF_CLUTTER_MPS)
    return result
