"""The protocols of estimators and their banks."""

import math
from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum
from functools import cache
from itertools import chain
from typing import (
    TYPE_CHECKING,
    Generic,
    Protocol,
    TypeVar,
    overload,
    runtime_checkable,
)

import numpy as np

from fgtrack.core.checks import LARGEST, LARGEST_NS, as_stamp, is_number
from fgtrack.core.errors import CallError
from fgtrack.core.linalg import equal_ones, mahalanobis_squared
from fgtrack.core.types import FloatArray, IntArray, SmoothedReport, TrackState
from fgtrack.models.measurement import (
    AT_ORIGIN,
    COMPONENTS,
    MeasurementModel,
    SensorPose,
    measurement_model,
)
from fgtrack.models.motion import CTRV, MotionModel
from fgtrack.models.robust import compiled_form
from fgtrack.models.sensors import RobustLoss

if TYPE_CHECKING:
    from fgtrack.estimation.smoothing.window import Window

_T = TypeVar("_T")
Content = tuple[tuple[int, ...], tuple[float, ...], tuple[str, ...]]
"""Sort key of a measurement: number of components and their codes; z, R, pose, kind and width of the loss; assumed
components.
"""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One detection, ready to be fused: z = h(x at stamp, pose) + N(0, R)."""

    stamp_ns: int
    model: MeasurementModel
    z: FloatArray
    """Measured components, shape (k,); in a stack of m measurements (m, k)."""
    R: FloatArray
    """Covariance, shape (k, k); in a stack of m measurements (m, k, k)."""
    pose: SensorPose = AT_ORIGIN
    loss: RobustLoss | None = None
    """Robust loss; None for the square (Gaussian errors)."""
    assumed: tuple[str, ...] = ()
    """Components that are prior knowledge, such as a heading from the map. They are fused, but do not count for the
    NIS.
    """

    def __post_init__(self) -> None:
        if (
            type(self.stamp_ns) is not int
            or not -LARGEST_NS <= self.stamp_ns <= LARGEST_NS
        ):
            object.__setattr__(
                self, "stamp_ns", as_stamp("measurement: stamp_ns", self.stamp_ns)
            )

    @classmethod
    def of(
        cls,
        stamp_ns: int,
        *,
        std: Mapping[str, float] | float | None = None,
        covariance: FloatArray | None = None,
        pose: SensorPose = AT_ORIGIN,
        loss: RobustLoss | None = None,
        assumed: tuple[str, ...] = (),
        **values: float,
    ) -> "Measurement":
        """Return the measurement of `values`, keyed by the names of `COMPONENTS`.

        Give the errors either as `std` or as `covariance`. `std` is a mapping from the same names to standard
        deviations, or one number if all values have the same unit (x and y). `covariance`, shape (k, k), is in
        the order of `COMPONENTS`.

        Raises `CallError` for an unknown or missing name, and for an invalid value or covariance.
        """
        names = tuple(name for name in COMPONENTS if name in values)
        if not names or len(names) < len(values):
            given = (
                ", ".join(name for name in values if name not in COMPONENTS)
                or "nothing"
            )
            raise CallError(
                f"measurement of {given}: give one or more of {', '.join(COMPONENTS)}"
            )
        if not set(assumed) < set(names):
            raise CallError(
                f"measurement of {', '.join(names)}: assumed must name some of them, is {assumed!r}"
            )
        if (std is None) == (covariance is None):
            raise CallError(
                f"measurement of {', '.join(names)}: give either std or covariance"
            )
        if std is not None and not isinstance(std, Mapping):
            rule = f"a mapping of {', '.join(names)} to numbers, or one number for values of one unit"
            is_one_unit = len({name.rpartition("_")[2] for name in names}) == 1
            _check(
                f"measurement of {', '.join(names)}: std",
                std,
                rule,
                is_one_unit and is_number(std),
            )
            std = dict.fromkeys(names, std)
        if std is not None and std.keys() != values.keys():
            raise CallError(
                f"measurement of {', '.join(names)}: std must name these components, names {', '.join(std)}"
            )
        stamp_ns = as_stamp("measurement: stamp_ns", stamp_ns)
        for name, value in (*values.items(), *(std or {}).items()):
            _check(
                f"measurement of {name}",
                value,
                "a number, finite and at most 1e9",
                is_number(value),
            )
        z = np.array([values[name] for name in names], dtype=np.float64)
        R = (
            np.diag([std[name] ** 2 for name in names])
            if std is not None
            else np.array(covariance, dtype=np.float64)
        )
        sound = (
            R.shape == (len(z), len(z))
            and np.isfinite(R).all()
            and (R == R.T).all()
            and np.isfinite(z).all()
        )
        if not sound or np.linalg.eigvalsh(R)[0] <= 0.0:
            raise CallError(
                f"measurement of {', '.join(names)}: values must be finite, the covariance symmetric, positive "
                f"definite and of shape {(len(z), len(z))}, are {z.tolist()} and {R.tolist()}"
            )
        return cls(
            stamp_ns, measurement_model(names, CTRV()), z, R, pose, loss, assumed
        )

    def seen_by(self, motion: MotionModel) -> "Measurement":
        """Return this measurement with the measurement model for the state of `motion`; itself if it has this
        model already.
        """
        names = self.model.state_names
        if names is motion.state_names or names[:4] == motion.state_names[:4]:
            return self
        return replace(self, model=measurement_model(self.model.components, motion))

    @property
    def is_nonlinear(self) -> bool:
        """True if the measurement must be linearised, or weighted by a robust loss, at a state."""
        return self.loss is not None or not self.model.linear

    @property
    def content(self) -> Content:
        """Return all values but the stamp, as a sort key. Only identical measurements have equal content.

        Compiled loops compare measurements in the same order.
        """
        k, codes = len(self.z), self.model.codes.tolist()
        kind, width = compiled_form(self.loss, k)
        numbers = self.z.tolist(), self.R.ravel().tolist(), self.pose, (kind, width)
        return (k, *codes), tuple(chain(*numbers)), self.assumed

    @property
    def order(self) -> tuple[int, Content]:
        """Return the sort key by stamp, and at equal stamps by content. So the order of arrival does not matter."""
        return self.stamp_ns, self.content

    @property
    def measured(self) -> IntArray:
        """Indices of the components that were measured, shape (d,)."""
        return _measured(self.model.components, self.assumed)

    def nis(self, innovation: FloatArray, S: FloatArray) -> float:
        """Return the normalised innovation squared y' S^-1 y of y (k,) and S (k, k), without the components
        that are `assumed`.
        """
        return float(mahalanobis_squared(innovation, S, self.measured))


@cache
def _measured(components: tuple[str, ...], assumed: tuple[str, ...]) -> IntArray:
    return np.array(
        [index for index, name in enumerate(components) if name not in assumed],
        dtype=np.int64,
    )


class Lazy(Sequence[_T], Generic[_T]):
    """A sequence that makes each item at every access to the item."""

    @abstractmethod
    def item(self, index: int) -> _T:
        """Return the item at an index from 0 to the length of the sequence minus 1."""

    @overload
    def __getitem__(self, index: int) -> _T: ...

    @overload
    def __getitem__(self, index: slice) -> list[_T]: ...

    def __getitem__(self, index: int | slice) -> _T | list[_T]:
        if isinstance(index, slice):
            return [self.item(each) for each in range(len(self))[index]]
        return self.item(range(len(self))[index])


class Measurements(Lazy[Measurement]):
    """Measurements of several objects by one sensor at one stamp. They differ in z and R only."""

    def __init__(self, stack: Measurement) -> None:
        self.stack = stack
        """All measurements as one stack: z (m, k) and R (m, k, k)."""

    def __len__(self) -> int:
        return len(self.stack.z)

    def item(self, index: int) -> Measurement:
        """See `Lazy.item`."""
        own = self.stack
        return Measurement(
            own.stamp_ns,
            own.model,
            own.z[index],
            own.R[index],
            own.pose,
            own.loss,
            own.assumed,
        )


def stacks(
    measurements: Sequence[Measurement],
) -> list[tuple[Sequence[int], Measurement]]:
    """Group measurements that differ in z and R only. Return the indices and the stack of each group."""
    if isinstance(measurements, Measurements):
        return [(range(len(measurements.stack.z)), measurements.stack)]
    parts = list[tuple[Sequence[int], Measurement]]()
    for rows in equal_ones(
        [(id(item.model), item.pose, item.assumed, item.loss) for item in measurements]
    ):
        z, R = (
            np.array([getattr(measurements[row], name) for row in rows])
            for name in ("z", "R")
        )
        parts.append((rows, replace(measurements[rows[0]], z=z, R=R)))
    return parts


class UpdateStatus(StrEnum):
    """Outcome of a measurement in an estimator; the values are dispositions."""

    IN_SEQUENCE = "in_sequence"
    OUT_OF_SEQUENCE = "out_of_sequence"
    BEYOND_WINDOW = "beyond_window"
    TOO_OLD = "too_old"
    DUPLICATE = "duplicate"
    """An identical measurement was fused before; the new one changes nothing."""
    FAILED = "failed"


@dataclass(
    slots=True
)  # not frozen: that takes three times as long, for every measurement
class UpdateResult:
    """Outcome of one measurement."""

    status: UpdateStatus
    innovation: FloatArray | None = None
    """Measured minus predicted value at the stamp of the measurement, shape (k,)."""
    nis: float | None = None
    """Normalised innovation squared, see `Measurement.nis`."""
    innovation_covariance: FloatArray | None = None
    """Covariance S of the innovation, shape (k, k); None if the estimator does not report S."""


#: Standard deviation of an unknown direction: the uniform distribution has this standard deviation.
UNKNOWN_YAW_STD_RAD = math.pi / math.sqrt(3.0)
KNOWN_YAW_STD_RAD = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """State of a new object at its first stamp, with standard deviations. Raises `CallError` for an invalid number."""

    stamp_ns: int = 0
    position_m: Sequence[float] | FloatArray = (0.0, 0.0)
    position_std_m: float = 1.0
    """Standard deviation along both axes; not used if `position_covariance` is given."""
    position_covariance: FloatArray | None = None
    """Covariance of x and y, shape (2, 2); None: `position_std_m` applies."""
    position_cross: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Covariance of the position with other entries of the state, by their names, for example with a
    time-correlated sensor error. `yaw_rad` and `speed_mps` may be named for every motion model.
    """
    yaw_cross: Mapping[str, float] = field(default_factory=dict)
    """Covariance of the yaw with `speed_mps`, and with entries of the state after the speed, by their names."""
    speed_cross: Mapping[str, float] = field(default_factory=dict)
    """Covariance of the speed with entries of the state after the speed, by their names."""
    yaw_rad: float | None = None
    """Direction of travel; None if it is unknown."""
    yaw_std_rad: float | None = None
    """Standard deviation of the direction of travel.

    None: `KNOWN_YAW_STD_RAD`, 0.1 rad, if `yaw_rad` is given. Otherwise `UNKNOWN_YAW_STD_RAD`, pi / sqrt(3) rad, the
    standard deviation of a uniform direction.
    """
    speed_mps: float = 0.0
    speed_std_mps: float = 10.0
    yaw_rate_radps: float = 0.0
    yaw_rate_std_radps: float = 0.3
    accel_mps2: float = 0.0
    accel_std_mps2: float = 1.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "stamp_ns", as_stamp("Start: stamp_ns", self.stamp_ns))
        for each in fields(self):
            name, value = each.name, getattr(self, each.name)
            if value is each.default or name == "stamp_ns" or name.endswith("_cross"):
                continue
            shape = _SHAPES.get(name, ())
            least = 0.0 if "_std_" in name else -_MOST
            rule = f"finite{'' if least else ' and not negative'}, of shape {shape} and at most {_MOST:g}"
            _check(f"Start: {name}", value, rule, _is_array(value, shape, least))
            if not shape and type(value) is not float:
                object.__setattr__(self, name, float(value))


_MOST = LARGEST**4
"""Largest number of a start. Products of measured and configured values are smaller, and the square is finite."""
_SHAPES = {"position_m": (2,), "position_covariance": (2, 2)}


def _check(name: str, value: object, rule: str, holds: bool) -> None:
    if not holds:
        raise CallError(f"{name}: must be {rule}, is {value!r}")


def _is_array(value: object, shape: tuple[int, ...], least: float) -> bool:
    """True if `value` has this shape, and numbers from `least` to `_MOST`."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of several lengths
        return False
    return (
        array.shape == shape
        and array.dtype.kind in "fiu"
        and bool(((least <= array) & (array <= _MOST)).all())
    )


@dataclass(frozen=True, slots=True)
class StatesAt:
    """States of the tracks that existed at a stamp, in order of birth."""

    track_ids: tuple[int, ...]
    means: FloatArray
    """Shape (m, n), in the state of the motion model."""
    covariances: FloatArray
    """Shape (m, n, n)."""

    def of(self, track_id: int) -> "StatesAt":
        """Return the state of one track; an empty `StatesAt` if the track has no state."""
        rows = [row for row, each in enumerate(self.track_ids) if each == track_id]
        return StatesAt(
            (track_id,) * len(rows), self.means[rows], self.covariances[rows]
        )

    def without(self, track_ids: Collection[int]) -> "StatesAt":
        """Return the states of all tracks except `track_ids`; this object itself if it has none of them."""
        rows = [row for row, each in enumerate(self.track_ids) if each not in track_ids]
        if len(rows) == len(self.track_ids):
            return self
        return StatesAt(
            tuple([self.track_ids[row] for row in rows]),
            self.means[rows],
            self.covariances[rows],
        )


@runtime_checkable
class TrackBank(Protocol):
    """The estimators of all objects.

    The tracker asks for the states at the stamp of a list, associates the detections, and fuses the measurements of
    this stamp.
    """

    @property
    def present_ns(self) -> int:
        """Stamp of the present states."""

    @property
    def window_start_ns(self) -> int:
        """Measurements with an older stamp cannot be fused by any track."""

    @property
    def track_ids(self) -> tuple[int, ...]:
        """Ids of all tracks, in order of birth."""

    def advance(self, now_ns: int) -> None:
        """Predict all tracks to the new present `now_ns`."""

    def states_at(self, stamp_ns: int) -> StatesAt:
        """Return the states at `stamp_ns`, in the past or the present."""

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """Fuse one measurement for each of `track_ids`, all with the same stamp. Return the results in this order."""

    def birth(self, track_id: int, prior: Start) -> None:
        """Start a track at the stamp of the `prior`."""

    def remove(self, track_id: int) -> None:
        """Forget a track."""

    def present(self) -> Sequence[TrackState]:
        """Return the kinematic states at the present, in the order of `track_ids`.

        A kinematic state is x, y, yaw, speed, yaw rate and, if the model has it, acceleration.
        """

    def smoothed(self) -> list[SmoothedReport]:
        """Return kinematic states of the past that later measurements have improved; a filter returns none.

        A lagged state is reported as it is now. A final state is reported once: when it has left its window, or
        when its track was removed.
        """


@runtime_checkable
class MeasurementBank(TrackBank, Protocol):
    """A bank that keeps the measurements of its windows."""

    def has_fused(self, track_id: int, measurement: Measurement) -> bool:
        """True if an identical measurement was fused and is still kept."""


@runtime_checkable
class WindowBank(MeasurementBank, Protocol):
    """A bank that can return copies of its windows: a smoother."""

    def window(self, track_id: int) -> "Window":
        """Return a copy of the window of a track."""

    def withdraw(self, track_id: int, measurement: Measurement) -> bool:
        """Undo the fusion of a measurement. Return False if the measurement is not in the window."""


def no_states(dim: int) -> StatesAt:
    """Return the empty `StatesAt`: states (0, n) of dimension `dim`."""
    return StatesAt((), np.empty((0, dim)), np.empty((0, dim, dim)))


@runtime_checkable
class Estimator(Protocol):
    """Estimator of one object, which fuses measurements in any order of arrival."""

    @property
    def window_ns(self) -> tuple[int, int]:
        """Oldest stamp that can be fused or asked for, and newest fused stamp."""

    def update(self, measurement: Measurement) -> UpdateResult:
        """Fuse `measurement` at its own stamp. A measurement that is older than the window changes nothing."""

    def state_at(self, stamp_ns: int) -> TrackState:
        """Return the state at any stamp in or after the window, in the state of the motion model."""

    def advance(self, now_ns: int) -> None:
        """Move the window to the clock `now_ns`. The estimate does not change."""


def asked_stamp(stamp_ns: object, oldest_ns: int) -> int:
    """Return a requested stamp as an integer. Raises `CallError` for an invalid stamp, and for a stamp before
    `oldest_ns`.
    """
    stamp = as_stamp("stamp_ns", stamp_ns)
    if stamp < oldest_ns:
        raise CallError(
            f"stamp_ns: there is no state at {stamp} ns, the oldest one is at {oldest_ns} ns"
        )
    return stamp


def described(name: str, motion: MotionModel, window_ns: tuple[int, int]) -> str:
    """Return the text of `repr` for the estimator `name` of one object: its motion model and its window."""
    oldest_ns, newest_ns = window_ns
    return f"<{name} of one object: {type(motion).__name__}, window {oldest_ns} to {newest_ns} ns>"
