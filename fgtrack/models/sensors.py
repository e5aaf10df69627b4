"""Sensor models: measured components, noise, delays, field of view and track-life settings."""

import math
from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from numbers import Real
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from fgtrack.core.linalg import kernels
from fgtrack.core.settings import OpenProbability, settings
from fgtrack.core.types import DESCRIBING, MEASURABLE, BoolArray, Detection, FloatArray

_KERNELS = "fgtrack.models.view_kernels"
NUM_LIMITS = 7
"""Number of columns of the limits of a sensor, see `fgtrack.models.view_kernels`."""


@settings
class Mount:
    """Pose of the sensor frame in the ego's detection frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


_AT_ORIGIN = Mount()


@settings
class Filter:
    """Condition on a field of a detection. A value passes if it meets every given condition."""

    min: float | None = None
    """Smallest value that passes."""
    max: float | None = None
    """Largest value that passes."""
    one_of: tuple[bool | int | float | str, ...] | None = None
    """The only values that pass."""
    none_of: tuple[bool | int | float | str, ...] = ()
    """Values that do not pass."""

    def __post_init__(self) -> None:
        if self.min is not None and self.max is not None and not self.min <= self.max:
            raise ValueError(f"min: is {self.min}, must be at most max = {self.max}")

    def passes(self, value: object) -> bool:
        """True if `value` passes; a missing or non-numeric value does not pass a bound."""
        if (
            self.one_of is not None and value not in self.one_of
        ) or value in self.none_of:
            return False
        if self.min is None and self.max is None:
            return True
        low = -math.inf if self.min is None else self.min
        high = math.inf if self.max is None else self.max
        return isinstance(value, Real) and low <= float(value) <= high


@settings
class RobustLoss:
    """Robust loss: it grows slower than the square, so an outlier pulls the estimate less."""

    kind: Literal["huber", "cauchy", "tukey", "geman_mcclure", "dcs"]
    """`tukey`, `geman_mcclure` and `dcs` are redescending: they can lose a track for good."""
    width: PositiveFloat
    """Distance at which the loss departs from the square, in standard deviations of one component.

    For several components the distance with the same probability is used.
    """


@settings
class Correlation:
    """Time correlation between the errors of successive detections of one object."""

    share: OpenProbability = 0.8
    """Correlated share of the error variance. The rest is independent in each detection."""
    time_s: PositiveFloat = 1.0
    """Correlation time: the autocorrelation of the correlated part falls to 1/e after it."""
    jump_probability: float = Field(0.0, ge=0.0, lt=1.0)
    """Probability that the whole position error of a detection has changed since the detection before.

    For instance, the sensor now detects the other end of a hull. Then a detection that a claim refuses still updates a
    confirmed track without another detection, if a jump is more likely than clutter. See `association.claim_m`.
    """


@settings
class SecondReturns:
    """Detections of an object besides its first one in a list: the other end of a long hull."""

    share: OpenProbability
    """Share of the lists with a detection of an object that have a second one of it."""
    std_m: PositiveFloat
    """Standard deviation of its distance from the first one, along the course of the object."""
    across_std_m: PositiveFloat | None = None
    """Standard deviation of its distance across the course; null for a third of `std_m`, as hulls are long."""

    @property
    def stds_m(self) -> tuple[float, float]:
        """Standard deviations along and across the course."""
        across_m = self.std_m / 3.0 if self.across_std_m is None else self.across_std_m
        return self.std_m, across_m


@settings
class Score:
    """Evidence of a detection's score: log(p(score | object) / p(score | clutter)) = (score - even) / scale.

    This logarithm of the likelihood ratio is limited to the range from -10 to 10.
    """

    even: float
    """Score that is equally likely for objects and clutter."""
    scale: PositiveFloat
    """Increase of the score that multiplies the likelihood ratio by e."""


@settings
class SensorModel:
    """Model of a sensor.

    Position errors have one standard deviation along and one across the line of sight.
    """

    std: Mapping[str, PositiveFloat] = field(default_factory=dict)
    """Standard deviation of each measured component, in the unit of its name; the sensor measures these components.

    Empty: a replay assumes it from the recording. A live tracker needs it.
    """
    yaw_from_map_std_rad: PositiveFloat | None = None
    """For a sensor without yaw: use the map heading as a yaw measurement with this standard deviation."""
    curvature_from_map_std_radpm: PositiveFloat | None = None
    """Use the curvature of the map's line as a measurement of yaw rate over speed.

    This is its standard deviation: it covers drivers who leave the line. null: the
    curvature is not used.
    """
    std_growth: Mapping[str, NonNegativeFloat] = field(default_factory=dict)
    """Growth of the standard deviation of a component per metre of range: the variance is
    std^2 + (std_growth range)^2.

    It does not change a detection's own covariance.
    """
    max_delay_s: PositiveFloat | None = None
    """Largest delay of a message. A later message is refused as too old. null: no limit."""
    counter_init: PositiveInt = 3
    """Initial status counter of a track that this sensor starts."""
    counter_add: NonNegativeInt = 1
    """Increment of the status counter when a detection of this sensor matches a track."""
    ages: Literal["always", "short_range", "long_range", "never"] = "always"
    """Tracks that lose one count if a list of this sensor misses them (`lifecycle.kind: counting`).

    `always`: all tracks. `short_range`: tracks within `lifecycle.short_range_m` of the ego. `long_range`: tracks beyond
    this distance. `never`: no track.
    """
    stamp_from: Literal["message", "object", "objects_mean", "receipt"] = "message"
    """Stamp of a detection.

    `message`: the stamp of its list. `object`: its own stamp, if it has one.
    `objects_mean`: the mean of the stamps in the list. `receipt`: the receipt time, for
    a driver that sets no stamps or uses another clock.
    """
    clock_offset_s: Annotated[float, Field(ge=-86_400.0, le=86_400.0)] = 0.0
    """Stamp minus time of measurement.

    It is subtracted from each stamp before any other use. With `stamp_from: receipt` it
    is the sensor latency. `fgtrack advise` and `fgtrack offsets` estimate it.
    """
    stamp_std_s: NonNegativeFloat = 0.0
    """Standard deviation of the stamps.

    The covariance of a detection gains the variance (speed times this)^2 along the
    motion of the compared track.
    """
    wrong_id_probability: OpenProbability = 1e-4
    """Probability p that the identity of a detection or of its track is wrong.

    If both have an identity, the NIS of the pair changes by 2 log((1 - p) / p): it is
    lower for equal identities, and higher for different ones.
    """
    copies_s: PositiveFloat | None = None
    """Longest time between a message and its copy through another receiver.

    A detection with the identity and position of one that was received within this time
    is a `duplicate`. If the copy has the earlier stamp, and comes before the first
    message was processed, its stamp is used. null: no check, because objects at rest
    repeat their position.
    """
    message_covariance: bool = True
    """Use the covariance of a detection where the message contains it."""
    max_range_m: PositiveFloat | None = None
    """A detection beyond this range is out of bounds: there, clutter outweighs objects."""
    filters: Mapping[str, Filter] = field(default_factory=dict)
    """Conditions on any field of a detection: `{score: {min: 0.5}, class_name: {one_of: [car]}}`.

    A detection that fails a condition is out of bounds.
    """
    view_range_m: PositiveFloat | None = None
    """Range of view, if it is smaller than `max_range_m`.

    It affects existence and evaluation alone: detections beyond it are used.
    """
    max_range_behind_m: PositiveFloat | None = None
    """Smaller range of view in the half-plane behind the sensor. It affects existence and evaluation alone."""
    field_of_view_rad: Annotated[float, Field(gt=0.0, le=math.tau)] | None = None
    """Full opening angle of the field of view, centred on the sensor axis.

    It affects existence and evaluation alone. null: all around. A replay without any
    given range takes it from the recording: from its header, or from the sector of the
    detections.
    """
    scan: bool = True
    """True if a list contains all objects in view, so a missing object is a miss.

    False for objects that report themselves, as with ADS-B, AIS or V2X. Without a
    configuration, a replay detects this from the recording.
    """
    births: bool = True
    """True if an unmatched detection of this sensor starts a track."""
    loss: RobustLoss | None = None
    """Robust loss of the sensor's measurements.

    null: Gaussian. A smoother updates the weights while the measurements are in its
    window. A filter weights once, at the updated state.
    """
    detection_probability: OpenProbability = 0.9
    """Probability that a list contains an object that is visible to the sensor (`lifecycle.kind: existence`).

    It applies while the object is visible, as between two lists that contain the object. The tracker itself estimates
    how often objects are hidden, too small or too far away.
    """
    clutter_per_m2: PositiveFloat = 1e-4
    """False detections per list and square metre (`lifecycle.kind: existence`, `association.joint_from`)."""
    second_returns: SecondReturns | None = None
    """Second returns of long objects. null: the sensor gives one detection for each object."""
    score: Score | None = None
    """Evidence of a detection's score for the existence of its object. null: the score is no evidence."""
    near_side_m: float = 0.0
    """Distance along the line of sight from the detected near side of a hull or car to its reference point.

    Detected positions are moved away from the sensor by it.
    """
    mount: Mount | None = None
    """Pose of the sensor in the ego's detection frame.

    null: the mount in the recording for a replay, else the origin.
    """
    correlation: Correlation | None = None
    """Time-correlated errors, estimated with each object. null: the errors are white."""

    def __post_init__(self) -> None:
        for key, names, known in (
            ("std", self.std, MEASURABLE),
            ("std_growth", self.std_growth, self.components),
            ("filters", self.filters, (*MEASURABLE, *DESCRIBING)),
        ):
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(
                    f"{key}: unknown {unknown[0]!r}, use {', '.join(known)}"
                )
        if ("x_m" in self.std) != ("y_m" in self.std):
            raise ValueError("std: give x_m and y_m together")

    @property
    def components(self) -> tuple[str, ...]:
        """Measured components in the order of `MEASURABLE`."""
        return tuple(name for name in MEASURABLE if name in self.std)

    def refusing_filter(self, detection: Detection) -> str | None:
        """Name of the first field whose filter refuses `detection`; None if it passes all filters."""
        return next(
            (
                name
                for name, item in self.filters.items()
                if not item.passes(getattr(detection, name))
            ),
            None,
        )

    @property
    def gives_position(self) -> bool:
        """True if the sensor measures positions: x and y, or range and bearing."""
        return "x_m" in self.std or {"range_m", "bearing_rad"} <= self.std.keys()

    @property
    def mount_or_origin(self) -> Mount:
        """The configured mount; the origin without a mount."""
        return self.mount or _AT_ORIGIN

    @property
    def has_view_limits(self) -> bool:
        """True if the field of view or any range limit is configured."""
        limits = {
            self.field_of_view_rad,
            self.max_range_m,
            self.view_range_m,
            self.max_range_behind_m,
        }
        return limits != {None}

    def sees(
        self,
        positions_m: FloatArray,
        ego_poses: FloatArray,
        origin_m: tuple[float, float],
    ) -> BoolArray:
        """Mask of positions within range and field of view, shape (...); occlusion is ignored.

        `positions_m` (..., 2) and the `ego_poses` x, y, yaw (..., 3) have the same
        times and are in the map frame. `origin_m` is the origin of the detection frame
        in the ego frame.
        """
        shape = positions_m.shape[:-1]
        views = np.empty((math.prod(shape), 1), dtype=bool)
        kernels(_KERNELS).look(
            positions_m.reshape(-1, 2),
            np.ascontiguousarray(ego_poses).reshape(-1, 3),
            self.view_limits(origin_m)[None],
            np.zeros(1, dtype=np.int64),
            views,
        )
        return views.reshape(shape)

    def view_limits(self, origin_m: tuple[float, float]) -> FloatArray:
        """Return pose, field of view and ranges, shape (7,), with the columns of `fgtrack.models.view_kernels`.

        `origin_m` is the origin of the detection frame in the ego frame.
        """
        mount = self.mount_or_origin
        most_m = min(
            (m for m in (self.max_range_m, self.view_range_m) if m is not None),
            default=math.inf,
        )
        return _limits(
            (origin_m[0] + mount.x_m, origin_m[1] + mount.y_m, mount.yaw_rad),
            self.field_of_view_rad or math.tau,
            0.0,
            most_m,
            self.max_range_behind_m,
        )

    def noise(self, components: tuple[str, ...]) -> FloatArray:
        """Diagonal covariance R of `components`, shape (k, k), in the sensor's axes; read-only.

        `components` may include those that the map provides.
        """
        if components not in self._noises:
            from_map = {
                "yaw_rad": self.yaw_from_map_std_rad,
                "curvature_radpm": self.curvature_from_map_std_radpm,
            }
            std = {
                name: value
                for name, value in {**from_map, **self.std}.items()
                if value is not None
            }
            R = np.diag([std[name] ** 2 for name in components])
            R.flags.writeable = False
            self._noises[components] = R
        return self._noises[components]

    @cached_property
    def is_isotropic(self) -> bool:
        """True if the position error is the same along and across the line of sight."""
        growth = self.std_growth
        return self.std["x_m"] == self.std["y_m"] and growth.get(
            "x_m", 0.0
        ) == growth.get("y_m", 0.0)

    def variance_growth(
        self, components: tuple[str, ...], range_m: FloatArray
    ) -> FloatArray | None:
        """Increase of the variances in `noise` at `range_m` (m,), shape (m, k).

        The increase is 0 where the range is NaN. None if no variance of the components
        grows.
        """
        if self.std_growth.keys().isdisjoint(components):
            return None
        rates = np.array([self.std_growth.get(name, 0.0) for name in components])
        return np.asarray(
            (np.where(np.isnan(range_m), 0.0, range_m)[:, None] * rates) ** 2
        )

    @cached_property
    def _noises(self) -> dict[tuple[str, ...], FloatArray]:
        return {}


def in_view(
    range_m: FloatArray,
    bearing_rad: FloatArray,
    field_of_view_rad: float,
    *,
    min_range_m: float = 0.0,
    max_range_m: float = math.inf,
    max_range_behind_m: float | None = None,
) -> BoolArray:
    """Mask of the objects that are in a sensor's field of view and range.

    `range_m` and `bearing_rad` (0 on the sensor axis) have one common shape.
    `field_of_view_rad` is the full opening angle. `max_range_behind_m`, if smaller,
    replaces `max_range_m` in the half-plane behind the sensor.
    """
    limits = _limits(
        (0.0, 0.0, 0.0), field_of_view_rad, min_range_m, max_range_m, max_range_behind_m
    )
    flat = (np.ascontiguousarray(each).reshape(-1) for each in (range_m, bearing_rad))
    found = kernels(_KERNELS).in_view(*flat, limits)
    return np.asarray(found.reshape(np.shape(range_m)))


def _limits(
    place: tuple[float, float, float],
    field_of_view_rad: float,
    least_m: float,
    most_m: float,
    most_behind_m: float | None,
) -> FloatArray:
    """Return the limits of a sensor at x, y, yaw in the ego frame, see `fgtrack.models.view_kernels`."""
    behind_m = math.inf if most_behind_m is None else most_behind_m
    return np.array([*place, 0.5 * field_of_view_rad, least_m, most_m, behind_m])
