"""The values that flow through fgtrack: messages in, track states and update records out.

Every message carries two times: `stamp_ns` (time of measurement) and `receipt_ns` (the tracker got it).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from itertools import takewhile
from typing import Any, Literal, Self, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Frame = Literal["map", "ego", "sensor"]
FRAMES: tuple[Frame, ...] = get_args(Frame)
YawWord = Literal["flipped", "unused"]
"""Defect of a measured yaw: it is half a turn off and was turned, or it misfits in another way and was not used."""
#: State columns of tracks.csv; a motion model's state is a leading part of them.
STATE_NAMES = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2")
X, Y, YAW, SPEED, YAW_RATE, ACCEL = range(6)
#: What the covariance of an `EgoState` is of: x, y, yaw, speed and yaw rate.
EGO_COVARIANCE_STATES = STATE_NAMES[:5]


@dataclass(frozen=True, slots=True)
class EgoState:
    """Pose and motion of the ego vehicle in the map frame."""

    stamp_ns: int
    receipt_ns: int
    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float = 0.0
    accel_mps2: float = 0.0
    in_pit: bool | None = None
    """True while the ego drives in the pit lane; None when the source does not contain it."""
    covariance: tuple[float, ...] | None = None
    """Row-major 5 x 5, of x, y, yaw, speed and yaw rate (`EGO_COVARIANCE_STATES`); None where the source has none.

    A variance of 0 means the same of one of them.
    """


@dataclass(frozen=True, slots=True)
class Detection:
    """One detected object; a component that was not measured is None."""

    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    speed_mps: float | None = None
    range_m: float | None = None
    bearing_rad: float | None = None
    range_rate_mps: float | None = None
    covariance: tuple[float, ...] | None = None
    """Row-major, of the measured components in the order of `MEASURABLE`."""
    stamp_ns: int | None = None
    """The object's own stamp, where the sensor gives one per object."""
    object_id: int | None = None
    z_m: float | None = None
    """Height of the middle of its box, in the frame of the list."""
    length_m: float | None = None
    """Size along its own heading."""
    width_m: float | None = None
    height_m: float | None = None
    score: float | None = None
    """Confidence of the detector, on a scale of its own."""
    class_name: str | None = None
    """Class: `car`, `truck` ..., in the words of the detector."""
    id: str | None = None
    """Identity that the object reports of itself: ICAO address, MMSI, station."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured components, in the order of `MEASURABLE`."""
        return tuple(name for name in MEASURABLE if getattr(self, name) is not None)


#: What a detection may measure, in the order of its covariance and of the residual columns: the fields of
#: `Detection` before its covariance.
MEASURABLE = tuple(
    takewhile(
        lambda name: name != "covariance", (each.name for each in fields(Detection))
    )
)
#: What a detection contains of its object besides: never measurements of the state, and all may be None.
DESCRIBING = ("z_m", "length_m", "width_m", "height_m", "score", "class_name", "id")


@dataclass(frozen=True, slots=True)
class DetectionList:
    """The object list of one sensor at one stamp; an empty list: nothing was detected."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    objects: Sequence[Detection]
    """Kept as a tuple."""
    frame: Frame = "ego"
    left_out: tuple[str, ...] = field(default=(), compare=False)
    """For every object that the reader has left out of the list the setting that excludes it."""
    origin_deg: tuple[float, float] | None = None
    """Latitude and longitude of the origin of the map; None where it is not known."""

    def __post_init__(self) -> None:
        if type(self.objects) is not tuple:
            object.__setattr__(self, "objects", tuple(self.objects))


EGO_ID = -1
"""Object id of the ego in truth."""


@dataclass(frozen=True, slots=True)
class TruthState:
    """True state of an object in the map frame, or of the ego, see `EGO_ID`."""

    stamp_ns: int
    receipt_ns: int
    object_id: int
    x_m: float
    y_m: float
    yaw_rad: float | None = None
    speed_mps: float | None = None
    yaw_rate_radps: float | None = None
    accel_mps2: float | None = None
    ignored: bool = False
    """True if a track of this object, or in this region, is neither right nor false when a run is judged."""
    outline_m: tuple[float, ...] | None = None
    """Corners x, y, x, y ... of the region that is ignored at this stamp, `x_m` and `y_m` in it; None for an object."""


Message = EgoState | DetectionList | TruthState


class Disposition(StrEnum):
    """Outcome of a detection: exactly one for each detection received."""

    BIRTH = "birth"
    IN_SEQUENCE = "in_sequence"
    OUT_OF_SEQUENCE = "out_of_sequence"
    BEYOND_WINDOW = "beyond_window"
    TOO_OLD = "too_old"
    GATED = "gated"
    MERGED = "merged"
    OUT_OF_BOUNDS = "out_of_bounds"
    DUPLICATE = "duplicate"
    SUPERSEDED = "superseded"
    INVALID = "invalid"
    FAILED = "failed"


#: Dispositions of detections that a track has fused out of sequence, and of all that one has fused.
LATE = (Disposition.OUT_OF_SEQUENCE, Disposition.BEYOND_WINDOW)
FUSED = (Disposition.BIRTH, Disposition.IN_SEQUENCE, *LATE)


@dataclass(frozen=True, slots=True)
class TrackState:
    """Gaussian state of one object at one stamp."""

    stamp_ns: int
    mean: FloatArray
    """State, shape (n,): x, y, yaw, speed, yaw rate and, if the model has it, acceleration."""
    covariance: FloatArray
    """Covariance, shape (n, n)."""


class TrackStatus(StrEnum):
    """Confidence in a track."""

    TENTATIVE = "tentative"
    """Not yet confirmed: measured too seldom, or too improbable, according to the lifecycle."""
    CONFIRMED = "confirmed"
    COASTING = "coasting"
    """Not matched by the newest batch that expected to see it."""


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """Class and size of the object of a track; None where no detection gives it."""

    class_name: str | None = None
    """That of most detections."""
    class_share: float | None = None
    """Share of these among those that name a class."""
    length_m: float | None = None
    """Mean over the detections that give it, as the other two."""
    width_m: float | None = None
    height_m: float | None = None
    id: str | None = None
    """Identity that most of its detections report."""


@dataclass(frozen=True, slots=True)
class TrackReport:
    """A track as the tracker publishes it; those of a tick are the rows of tracks.csv."""

    track_id: int
    status: TrackStatus
    state: TrackState
    """Kinematic: x, y, yaw, speed, yaw rate and, if the motion model has it, acceleration."""
    num_measured: int
    object: ObjectReport | None = None
    """Class and size; None where no detection gives any."""
    score: float | None = None
    """Probability that the object exists (`lifecycle.kind: existence`); None where a lifecycle gives none."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the state."""
        return self.state.stamp_ns

    @property
    def x_m(self) -> float:
        """Position in the map, to the east."""
        return float(self.state.mean[X])

    @property
    def y_m(self) -> float:
        """Position in the map, to the north."""
        return float(self.state.mean[Y])

    @property
    def yaw_rad(self) -> float:
        """Direction of travel in (-pi, pi], 0 along +x, counter-clockwise."""
        return float(self.state.mean[YAW])

    @property
    def speed_mps(self) -> float:
        """Speed along the yaw."""
        return float(self.state.mean[SPEED])

    @property
    def yaw_rate_radps(self) -> float:
        """Derivative of the yaw."""
        return float(self.state.mean[YAW_RATE])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the state, shape (n, n)."""
        return self.state.covariance


@dataclass(frozen=True, slots=True)
class UpdateRecord:
    """One row of updates.csv: what became of one received detection."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    index: int
    """Position of the detection in its message."""
    disposition: Disposition
    track_id: int | None = None
    nis: float | None = None
    innovation: Mapping[str, float] = field(default_factory=dict)
    """Measured minus predicted, by name of `MEASURABLE`."""
    reason: str | None = None
    """The setting by which it is out of bounds; None of other dispositions."""
    yaw: YawWord | None = None
    """`flipped` if the yaw is half a turn off, `unused` if it misfits otherwise and the innovation lacks it."""


@dataclass(frozen=True, slots=True)
class SmoothedReport:
    """A state that later measurements have improved: final when it leaves the window, lagged before."""

    track_id: int
    state: TrackState
    lag_s: float | None = None
    """Time from the state to the tick; None of a final one."""


@dataclass(frozen=True)
class TickReport:
    """All that one tracker tick gives."""

    tick: int
    now_ns: int
    tracks: tuple[TrackReport, ...]
    updates: tuple[UpdateRecord, ...]
    smoothed: tuple[SmoothedReport, ...] = ()

    @classmethod
    def made_later(
        cls,
        tick: int,
        now_ns: int,
        smoothed: Sequence[SmoothedReport],
        **makers: Callable[[], Iterable[object]],
    ) -> Self:
        """Return a report whose `tracks` and `updates` the `makers` of these names give when they are asked for."""
        report = object.__new__(cls)
        report.__dict__.update(
            tick=tick, now_ns=now_ns, smoothed=tuple(smoothed), makers=makers
        )
        return report

    def __getattr__(self, name: str) -> Any:  # Any: of what is not made yet
        makers = self.__dict__.get("makers", {})
        if name not in makers:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        self.__dict__[name] = made = tuple(makers[name]())
        del makers[name]
        return made

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)}
