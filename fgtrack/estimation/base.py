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
"""Number of components and their codes; z, R, pose, kind and width of the loss; assumed components. It has an order."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One detection, ready to be fused: z = h(x at stamp, pose) + N(0, R)."""

    stamp_ns: int
    model: MeasurementModel
    z: FloatArray
    """Measured components, shape (k,); (m, k) of a stack."""
    R: FloatArray
    """Covariance, shape (k, k); (m, k, k) of a stack."""
    pose: SensorPose = AT_ORIGIN
    loss: RobustLoss | None = None
    """Robust loss; None is the Gaussian."""
    assumed: tuple[str, ...] = ()
    """Components that are prior knowledge, as a heading from the map: fused like the others, but not measured."""

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
        """The measurement of `values`, by name of `COMPONENTS`, with a standard deviation each or a covariance.
        `std` is a mapping by the same names, or one number for values of one unit (x and y).
        `covariance`, shape (k, k), is in the order of `COMPONENTS`. Raises `CallError` for an unknown or missing name
        and a value or covariance that makes no sense.
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
                f"measurement of {', '.join(names)}: std must name the same, names {', '.join(std)}"
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
        """This measurement with the model for the state of `motion`: itself where that is its model already."""
        names = self.model.state_names
        if names is motion.state_names or names[:4] == motion.state_names[:4]:
            return self
        return replace(self, model=measurement_model(self.model.components, motion))

    @property
    def is_nonlinear(self) -> bool:
        """True if it has to be linearised, or weighted, at a state."""
        return self.loss is not None or not self.model.linear

    @property
    def content(self) -> Content:
        """All but the stamp: only what is the same in every respect is equal. Compiled loops compare in this order."""
        k, codes = len(self.z), self.model.codes.tolist()
        kind, width = compiled_form(self.loss, k)
        numbers = self.z.tolist(), self.R.ravel().tolist(), self.pose, (kind, width)
        return (k, *codes), tuple(chain(*numbers)), self.assumed

    @property
    def order(self) -> tuple[int, Content]:
        """Order among measurements: by stamp, and at one stamp by content, so that arrival does not matter."""
        return self.stamp_ns, self.content

    @property
    def measured(self) -> IntArray:
        """Indices of the components that were measured, shape (d,)."""
        return _measured(self.model.components, self.assumed)

    def nis(self, innovation: FloatArray, S: FloatArray) -> float:
        """Normalised innovation squared y' S^-1 y of y (k,) and S (k, k), without components that are `assumed`."""
        return float(mahalanobis_squared(innovation, S, self.measured))


@cache
def _measured(components: tuple[str, ...], assumed: tuple[str, ...]) -> IntArray:
    return np.array(
        [index for index, name in enumerate(components) if name not in assumed],
        dtype=np.int64,
    )


class Lazy(Sequence[_T], Generic[_T]):
    """A sequence that makes each item when the item is read."""

    @abstractmethod
    def item(self, index: int) -> _T:
        """Return the item at an index from 0 to the length."""

    @overload
    def __getitem__(self, index: int) -> _T: ...

    @overload
    def __getitem__(self, index: slice) -> list[_T]: ...

    def __getitem__(self, index: int | slice) -> _T | list[_T]:
        if isinstance(index, slice):
            return [self.item(each) for each in range(len(self))[index]]
        return self.item(range(len(self))[index])


class Measurements(Lazy[Measurement]):
    """Measurements of several objects that differ in their numbers alone."""

    def __init__(self, stack: Measurement) -> None:
        self.stack = stack
        """All of them: z (m, k) and R (m, k, k)."""

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
    """Return the measurements that differ in their numbers alone: their indices, and the stack of them."""
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
    """Measured (or assumed) minus predicted at the measurement's own stamp, shape (k,)."""
    nis: float | None = None
    """Normalised innovation squared against the prior at that stamp, `Measurement.nis`."""
    innovation_covariance: FloatArray | None = None
    """Covariance S of the innovation, shape (k, k), of estimators that report it."""


#: Standard deviation of a direction of which nothing is known: that of the uniform distribution.
UNKNOWN_YAW_STD_RAD = math.pi / math.sqrt(3.0)
KNOWN_YAW_STD_RAD = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """State of a new object at its first stamp, with standard deviations. Raises `CallError` for an invalid number."""

    stamp_ns: int = 0
    position_m: Sequence[float] | FloatArray = (0.0, 0.0)
    position_std_m: float = 1.0
    """Along both axes; not used where `position_covariance` is given."""
    position_covariance: FloatArray | None = None
    """Shape (2, 2)."""
    position_cross: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Covariance of the position with further entries of the state, by their names: where it is off by an error that
    lasts, this entry is known to be opposite. `yaw_rad` and `speed_mps` may be named for every motion model."""
    yaw_cross: Mapping[str, float] = field(default_factory=dict)
    """Covariance of the yaw with `speed_mps`, and with entries of the state behind the speed, by their names."""
    speed_cross: Mapping[str, float] = field(default_factory=dict)
    """Covariance of the speed with entries of the state behind the speed, by their names."""
    yaw_rad: float | None = None
    """Direction of travel; None where it is unknown."""
    yaw_std_rad: float | None = None
    """None for `KNOWN_YAW_STD_RAD`, or `UNKNOWN_YAW_STD_RAD` where `yaw_rad` is None."""
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
"""No number of a start is larger: products of what is measured and configured are not, and its square is finite."""
_SHAPES = {"position_m": (2,), "position_covariance": (2, 2)}


def _check(name: str, value: object, rule: str, holds: bool) -> None:
    if not holds:
        raise CallError(f"{name}: must be {rule}, is {value!r}")


def _is_array(value: object, shape: tuple[int, ...], least: float) -> bool:
    """True if it has this shape, and numbers from `least` to `_MOST`."""
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
    """States of those tracks that existed at one stamp, in order of birth."""

    track_ids: tuple[int, ...]
    means: FloatArray
    """Shape (m, n), in the motion model's own state."""
    covariances: FloatArray
    """Shape (m, n, n)."""

    def of(self, track_id: int) -> "StatesAt":
        """Return the state of one track; of no track where it has none."""
        rows = [row for row, each in enumerate(self.track_ids) if each == track_id]
        return StatesAt(
            (track_id,) * len(rows), self.means[rows], self.covariances[rows]
        )

    def without(self, track_ids: Collection[int]) -> "StatesAt":
        """Return the states of all tracks but these; itself where no state is left out."""
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
    """The estimators of all objects: states at a stamp for association, then the measurements of that stamp."""

    @property
    def present_ns(self) -> int:
        """Stamp of the present states."""

    @property
    def window_start_ns(self) -> int:
        """Measurements with an older stamp cannot be fused by any track."""

    @property
    def track_ids(self) -> tuple[int, ...]:
        """All tracks in order of birth."""

    def advance(self, now_ns: int) -> None:
        """The clock moved: bring every track to the present."""

    def states_at(self, stamp_ns: int) -> StatesAt:
        """States at `stamp_ns`, in the past or the present."""

    def update(
        self,
        stamp_ns: int,
        track_ids: Sequence[int],
        measurements: Sequence[Measurement],
    ) -> list[UpdateResult]:
        """Fuse one measurement for each of `track_ids`, all of the same stamp."""

    def birth(self, track_id: int, prior: Start) -> None:
        """Start a track at the prior's stamp."""

    def remove(self, track_id: int) -> None:
        """Forget a track."""

    def present(self) -> Sequence[TrackState]:
        """Kinematic states (x, y, yaw, speed, yaw rate[, acceleration]) now, in the order of `track_ids`."""

    def smoothed(self) -> list[SmoothedReport]:
        """Kinematic states of the past, improved by later measurements; of a filter none.
        Lagged ones as they are now, final ones that left a window, or whose track was removed, since the last call.
        """


@runtime_checkable
class MeasurementBank(TrackBank, Protocol):
    """A bank that keeps the measurements of its windows."""

    def has_fused(self, track_id: int, measurement: Measurement) -> bool:
        """True if an identical measurement was fused and is still kept."""


@runtime_checkable
class WindowBank(MeasurementBank, Protocol):
    """A bank that gives out its windows: the smoothers."""

    def window(self, track_id: int) -> "Window":
        """Return a copy of the window of a track."""

    def withdraw(self, track_id: int, measurement: Measurement) -> bool:
        """Take a measurement back, as if it had never been fused. Return False if it is not kept."""


def no_states(dim: int) -> StatesAt:
    """The states of no track at all."""
    return StatesAt((), np.empty((0, dim)), np.empty((0, dim, dim)))


@runtime_checkable
class Estimator(Protocol):
    """One object: fuses measurements in any order of arrival."""

    @property
    def window_ns(self) -> tuple[int, int]:
        """Oldest stamp that can still be fused or asked for, and the newest stamp fused."""

    def update(self, measurement: Measurement) -> UpdateResult:
        """Fuse `measurement` at its own stamp; one that is older than the window changes nothing."""

    def state_at(self, stamp_ns: int) -> TrackState:
        """State, in the motion model's own form, at any stamp in or after the window."""

    def advance(self, now_ns: int) -> None:
        """The clock moved: move the window, nothing else."""


def asked_stamp(stamp_ns: object, oldest_ns: int) -> int:
    """Return a stamp for which a state is asked. Raises `CallError` for an invalid one and before `oldest_ns`."""
    stamp = as_stamp("stamp_ns", stamp_ns)
    if stamp < oldest_ns:
        raise CallError(
            f"stamp_ns: there is no state at {stamp} ns, the oldest one is at {oldest_ns} ns"
        )
    return stamp


def described(name: str, motion: MotionModel, window_ns: tuple[int, int]) -> str:
    """Return a line on the estimator `name` of one object: motion model and window, for its repr."""
    oldest_ns, newest_ns = window_ns
    return f"<{name} of one object: {type(motion).__name__}, window {oldest_ns} to {newest_ns} ns>"
