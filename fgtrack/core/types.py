"""The values that flow through fgtrack: messages as inputs, track states and update records as outputs.

Every message carries two times: `stamp_ns`, the time of measurement, and `receipt_ns`,
when the tracker got it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from itertools import takewhile
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Frame = Literal["map", "ego", "sensor"]
FRAMES: tuple[Frame, ...] = get_args(Frame)
YawWord = Literal["flipped", "unused"]
"""Treatment of a wrong yaw: `flipped` if it was half a turn off and turned, `unused` if it was ignored."""
#: State columns of tracks.csv; the state of every motion model consists of the first few.
STATE_NAMES = ("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2")
X, Y, YAW, SPEED, YAW_RATE, ACCEL = range(6)
#: States of the covariance of an `EgoState`.
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
    """True while the ego drives in the pit lane; None if the source does not report it."""
    covariance: tuple[float, ...] | None = None
    """Row-major 5 x 5, of x, y, yaw, speed and yaw rate (`EGO_COVARIANCE_STATES`); None if the source reports none.

    Variance 0: that component has no reported uncertainty.
    """


@dataclass(frozen=True, slots=True)
class Detection:
    """One detected object; components that were not measured are None."""

    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None
    speed_mps: float | None = None
    range_m: float | None = None
    bearing_rad: float | None = None
    range_rate_mps: float | None = None
    covariance: tuple[float, ...] | None = None
    """Row-major covariance of the measured components, in the order of `MEASURABLE`."""
    stamp_ns: int | None = None
    """Own stamp of the object, if the sensor reports one for each object."""
    object_id: int | None = None
    z_m: float | None = None
    """Height of the centre of the object's box, in the frame of the list."""
    length_m: float | None = None
    """Size of the box along its heading."""
    width_m: float | None = None
    height_m: float | None = None
    score: float | None = None
    """Confidence of the detector, on the detector's own scale."""
    class_name: str | None = None
    """Class in the detector's words, for example `car` or `truck`."""
    id: str | None = None
    """Identity that the object reports, for example an ICAO address, an MMSI or a station number."""

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the measured components, in the order of `MEASURABLE`."""
        return tuple(name for name in MEASURABLE if getattr(self, name) is not None)


#: Components that a detection may measure: the fields of `Detection` before `covariance`.
#: Covariances and residual columns have this order.
MEASURABLE = tuple(
    takewhile(
        lambda name: name != "covariance", (each.name for each in fields(Detection))
    )
)
#: Fields of a detection that describe the object, and are no measurements of its state; all may be None.
DESCRIBING = ("z_m", "length_m", "width_m", "height_m", "score", "class_name", "id")


@dataclass(frozen=True, slots=True)
class DetectionList:
    """The detections of one sensor at one stamp; an empty list means that nothing was detected."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    objects: Sequence[Detection]
    """Detections; stored as a tuple."""
    frame: Frame = "ego"
    left_out: tuple[str, ...] = field(default=(), compare=False)
    """The excluding setting for each object that the reader has left out of the list."""
    origin_deg: tuple[float, float] | None = None
    """Latitude and longitude of the origin of the map; None if unknown."""

    def __post_init__(self) -> None:
        if type(self.objects) is not tuple:
            object.__setattr__(self, "objects", tuple(self.objects))


EGO_ID = -1
"""`TruthState.object_id` of the ego."""


@dataclass(frozen=True, slots=True)
class TruthState:
    """True state of an object, or of the ego (`EGO_ID`), in the map frame."""

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
    """True if the evaluation ignores tracks of this object or in this region: they are neither right nor false."""
    outline_m: tuple[float, ...] | None = None
    """Corners x, y, x, y ... of a region that is ignored at this stamp; None for an object.

    The point `x_m`, `y_m` lies in the region.
    """


Message = EgoState | DetectionList | TruthState


class Disposition(StrEnum):
    """Outcome of a detection; every received detection has exactly one."""

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


#: Dispositions of detections that a track has fused out of sequence.
LATE = (Disposition.OUT_OF_SEQUENCE, Disposition.BEYOND_WINDOW)
#: Dispositions of all detections that a track has fused.
FUSED = (Disposition.BIRTH, Disposition.IN_SEQUENCE, *LATE)


@dataclass(frozen=True, slots=True)
class TrackState:
    """Gaussian state of an object at one stamp."""

    stamp_ns: int
    mean: FloatArray
    """State, shape (n,): x, y, yaw, speed, yaw rate and, if the model has it, acceleration."""
    covariance: FloatArray
    """Covariance, shape (n, n)."""


class TrackStatus(StrEnum):
    """Lifecycle status of a track."""

    TENTATIVE = "tentative"
    """Not confirmed yet, or of doubtful existence: too few matches, or too low an existence probability."""
    CONFIRMED = "confirmed"
    COASTING = "coasting"
    """Confirmed, but missed by the newest list that should have contained the object."""


@dataclass(frozen=True, slots=True)
class ObjectReport:
    """Class and size of a track's object; a field is None if no detection reports it."""

    class_name: str | None = None
    """Most frequent class of the detections."""
    class_share: float | None = None
    """Share of this class among the detections with a class."""
    length_m: float | None = None
    """Mean length, over the detections that report a length."""
    width_m: float | None = None
    """Mean width, over the detections that report a width."""
    height_m: float | None = None
    """Mean height, over the detections that report a height."""
    id: str | None = None
    """Most frequent identity of the detections."""


@dataclass(frozen=True, slots=True)
class TrackReport:
    """A track as the tracker publishes it: one row of tracks.csv."""

    track_id: int
    status: TrackStatus
    state: TrackState
    """Kinematic state: x, y, yaw, speed, yaw rate and, if the motion model has it, acceleration."""
    num_measured: int
    object: ObjectReport | None = None
    """Class and size; None if no detection reports any."""
    score: float | None = None
    """Existence probability (`lifecycle.kind: existence`); None for a lifecycle without probabilities."""
    open_until_ns: int | None = None
    """Time up to which late data may change the state, or the decisions behind it; None for a final state."""

    @property
    def is_final(self) -> bool:
        """True if no late data can change the state, nor the decisions behind it."""
        return self.open_until_ns is None

    @property
    def stamp_ns(self) -> int:
        """Stamp of the state."""
        return self.state.stamp_ns

    @property
    def x_m(self) -> float:
        """Position in the map along x (east)."""
        return float(self.state.mean[X])

    @property
    def y_m(self) -> float:
        """Position in the map along y (north)."""
        return float(self.state.mean[Y])

    @property
    def yaw_rad(self) -> float:
        """Direction of travel in (-pi, pi], 0 along +x, counter-clockwise."""
        return float(self.state.mean[YAW])

    @property
    def speed_mps(self) -> float:
        """Speed along the yaw; negative while the object reverses."""
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
    """Outcome of one received detection: one row of updates.csv."""

    sensor: str
    stamp_ns: int
    receipt_ns: int
    index: int
    """Index of the detection in its list."""
    disposition: Disposition
    track_id: int | None = None
    nis: float | None = None
    innovation: Mapping[str, float] = field(default_factory=dict)
    """Measured minus predicted value, by name of `MEASURABLE`."""
    reason: str | None = None
    """Setting by which the detection is out of bounds; None for every other disposition."""
    yaw: YawWord | None = None
    """`flipped` if the measured yaw was turned by half a turn, `unused` if the innovation lacks it."""


@dataclass(frozen=True, slots=True)
class Revision:
    """A decision about a received detection that late data has changed: one row of revisions.csv."""

    tick: int
    """Tick at which the decision has changed."""
    sensor: str
    stamp_ns: int
    receipt_ns: int
    index: int
    old_track_id: int | None
    """Track before; None for a detection without a track."""
    track_id: int | None
    """Track from now on; None for a detection without a track."""


class FinalTrack(NamedTuple):
    """A track as it was in the end: one row of final_tracks.csv."""

    track_id: int
    first_stamp_ns: int
    """Stamp of the first detection."""
    last_stamp_ns: int
    """Stamp of the last detection."""
    is_confirmed: bool
    probability: float
    """Probability that the object of the track has ever existed."""


@dataclass(frozen=True, slots=True)
class SmoothedReport:
    """A state of a track after later measurements: final when it leaves the window, lagged before."""

    track_id: int
    state: TrackState
    lag_s: float | None = None
    """Time from the state to the tick; None for a final state."""


@dataclass(frozen=True)
class TickReport:
    """Results of one tracker tick."""

    tick: int
    now_ns: int
    tracks: tuple[TrackReport, ...]
    updates: tuple[UpdateRecord, ...]
    smoothed: tuple[SmoothedReport, ...] = ()
    revisions: tuple[Revision, ...] = ()
    """Decisions about earlier detections that late data has changed in this tick."""
    final_tracks: tuple["FinalTrack", ...] = ()
    """Tracks that have ended, and that no late list can change any more; each track is in one report."""

    @classmethod
    def made_later(
        cls,
        tick: int,
        now_ns: int,
        smoothed: Sequence[SmoothedReport],
        revisions: Sequence[Revision] = (),
        final_tracks: Sequence["FinalTrack"] = (),
        **makers: Callable[[], Iterable[object]],
    ) -> Self:
        """Return a report with `tracks` and `updates` that their `makers` compute at the first access.

        A maker returns the elements of the field with the maker's name.
        """
        report = object.__new__(cls)
        report.__dict__.update(
            tick=tick,
            now_ns=now_ns,
            smoothed=tuple(smoothed),
            revisions=tuple(revisions),
            final_tracks=tuple(final_tracks),
            makers=makers,
        )
        return report

    def __getattr__(self, name: str) -> Any:  # Any: the type of the field
        makers = self.__dict__.get("makers", {})
        if name not in makers:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        self.__dict__[name] = made = tuple(makers[name]())
        del makers[name]
        return made

    def __getstate__(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self)}
