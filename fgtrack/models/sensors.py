"""Sensors: measured quantities, noise, delay limits, and the weight of detections in the life of a track."""

import math
from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from numbers import Real
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from fgtrack.core.geometry import body_point, polar, wrap_angles
from fgtrack.core.settings import OpenProbability, settings
from fgtrack.core.types import DESCRIBING, MEASURABLE, BoolArray, Detection, FloatArray


@settings
class Mount:
    """Pose of the sensor frame in the ego's detection frame."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


_AT_ORIGIN = Mount()


@settings
class Filter:
    """Which values pass; all that is given must hold."""

    min: float | None = None
    """Smallest value that passes."""
    max: float | None = None
    """Largest value that passes."""
    one_of: tuple[bool | int | float | str, ...] | None = None
    """Values that pass, no others."""
    none_of: tuple[bool | int | float | str, ...] = ()
    """Values that do not."""

    def __post_init__(self) -> None:
        if self.min is not None and self.max is not None and not self.min <= self.max:
            raise ValueError(
                f"min: must not be more than max = {self.max}, is {self.min}"
            )

    def passes(self, value: object) -> bool:
        """True if `value` passes; what is not there or not a number does not pass a bound."""
        if (
            self.one_of is not None and value not in self.one_of
        ) or value in self.none_of:
            return False
        if self.min is None and self.max is None:
            return True
        low, high = (
            -math.inf if self.min is None else self.min,
            math.inf if self.max is None else self.max,
        )
        return isinstance(value, Real) and low <= float(value) <= high


@settings
class RobustLoss:
    """A loss that grows slower than the square, so that an outlier pulls less."""

    kind: Literal["huber", "cauchy", "tukey", "geman_mcclure", "dcs"]
    """`tukey`, `geman_mcclure` and `dcs` are redescending: they can lose a track for good."""
    width: PositiveFloat
    """Where the loss leaves the square, in standard deviations of one component; of several at the same probability."""


@settings
class Correlation:
    """Correlation between the errors of an object's successive detections."""

    share: OpenProbability = 0.8
    """Correlated share of the variance; the rest is new in every detection."""
    time_s: PositiveFloat = 1.0
    """After this time the correlated part has fallen to 1/e, as the autocorrelation of the errors shows."""
    jump_probability: float = Field(0.0, ge=0.0, lt=1.0)
    """Probability that a position's whole error is new, as at the other end of a hull. A detection that a claim refuses
    then updates a confirmed track without one, if a jump is likelier than clutter; see `association.claim_m`."""


@settings
class Score:
    """Likelihood ratio of a detection's score: log p(score | object) / p(score | clutter) = (score - even) / scale.
    Its logarithm is at most 10 to either side.
    """

    even: float
    """A score that objects and clutter have equally often."""
    scale: PositiveFloat
    """Increase of the score that makes an object e times more probable."""


@settings
class SensorModel:
    """One modality. Positions have their standard deviations along and across the line of sight."""

    std: Mapping[str, PositiveFloat]
    """Standard deviation of each measured component; the keys are what the sensor measures."""
    yaw_from_map_std_rad: PositiveFloat | None = None
    """Where the sensor measures no yaw: take the map heading as a yaw measurement with this standard deviation."""
    curvature_from_map_std_radpm: PositiveFloat | None = None
    """Take the curvature of the map's line as a measurement of yaw rate over speed with this standard deviation: the
    yaw rate is speed times curvature, but for what a driver does beside the line; null: no curvature."""
    std_growth: Mapping[str, NonNegativeFloat] = field(default_factory=dict)
    """By how much the standard deviation of a component grows with each metre of range: its variance is std^2 +
    (std_growth range)^2. A detection's own covariance stays as it is."""
    max_delay_s: PositiveFloat | None = None
    """A message that arrives later than this is refused as too old."""
    counter_init: PositiveInt = 3
    """Status counter of a track that this sensor gave birth to."""
    counter_add: NonNegativeInt = 1
    """Increment of the status counter by a match with this sensor."""
    ages: Literal["always", "short_range", "long_range", "never"] = "always"
    """At which range a track that this sensor does not see loses one count."""
    stamp_from: Literal["message", "object", "objects_mean", "receipt"] = "message"
    """A detection's stamp: the list's, its own where it carries one, the mean of those that do, or the receipt, where
    the driver sets none or one of another clock."""
    clock_offset_s: Annotated[float, Field(ge=-60.0, le=60.0)] = 0.0
    """Advance of its stamps over the time at which it measured; subtracted before anything else is done. With
    `stamp_from: receipt` its latency. `fgtrack advise` and `fgtrack offsets` find it."""
    stamp_std_s: NonNegativeFloat = 0.0
    """Standard deviation of its stamps: adds the velocity times it to the noise of every detection, along the motion of
    the track that it is compared with."""
    wrong_id_probability: OpenProbability = 1e-4
    """Probability that the identity of a detection, or of its track, is wrong. Where both have one, the NIS of the pair
    is lower by 2 log((1 - p) / p) if they are equal, and higher by it if they are not."""
    copies_s: PositiveFloat | None = None
    """A detection of the same identity and position as one received at most this long before is a copy of its message,
    heard by another receiver: `duplicate`. A copy with an earlier stamp, received before the first was processed, gives
    it its stamp. Null: objects that stand repeat the same position."""
    message_covariance: bool = True
    """Use a detection's own covariance where the message carries one."""
    max_range_m: PositiveFloat | None = None
    """A detection further from the sensor than this is out of bounds: beyond it clutter outweighs objects."""
    filters: Mapping[str, Filter] = field(default_factory=dict)
    """Which detections are used, by anything that they contain: `{score: {min: 0.5}, class_name: {one_of: [car]}}`. The
    others are out of bounds."""
    view_range_m: PositiveFloat | None = None
    """Range of view, where that is less than `max_range_m`; for existence and evaluation, no detection is out of
    bounds by it."""
    max_range_behind_m: PositiveFloat | None = None
    """Range of view in the half behind it, where that is less; for existence and evaluation."""
    field_of_view_rad: Annotated[float, Field(gt=0.0, le=math.tau)] | None = None
    """Full angle that it sees, centred on its axis; for existence and evaluation, as these ranges. null: in a replay
    that of the recording, or where it detects in it, if no range is given either; else all around."""
    scan: bool = True
    """True if a list shows all objects in view, so that it misses those that it lacks. False where objects are reported
    one by one, as by ADS-B, AIS or V2X; without a configuration a replay finds it in the recording."""
    births: bool = True
    """True if an unmatched detection of this sensor starts a track."""
    loss: RobustLoss | None = None
    """Robust loss of its measurements; null is the Gaussian. A smoother updates the weights while they are in its
    window, a filter once, at the state that the update gives."""
    detection_probability: OpenProbability = 0.9
    """Probability that a list shows an object that is visible to it (`lifecycle.kind: existence`), as in a list between
    two that show it. How often objects are hidden, or too small or too far away, is estimated."""
    clutter_per_m2: PositiveFloat = 1e-4
    """False detections in a list for each square metre (`lifecycle.kind: existence`, `association.joint_from`)."""
    score: Score | None = None
    """Evidence of the score of a detection for the existence of its object; null: none."""
    near_side_m: float = 0.0
    """Distance by which the sensor sees an object nearer than its reference point, along the line of sight: the near
    side of a hull or a car. Positions are moved away from the sensor by it."""
    mount: Mount | None = None
    """Pose of the sensor in the ego's detection frame; null: in a replay that of the recording, else the origin."""
    correlation: Correlation | None = None
    """Errors that are correlated in time, estimated with each object; null: errors are white."""

    def __post_init__(self) -> None:
        for key, names, known in (
            ("std", self.std, MEASURABLE),
            ("std_growth", self.std_growth, self.components),
            ("filters", self.filters, (*MEASURABLE, *DESCRIBING)),
        ):
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(
                    f"{key}: unknown {unknown[0]!r}, known are {', '.join(known)}"
                )
        if not self.std or ("x_m" in self.std) != ("y_m" in self.std):
            raise ValueError(
                "std: name at least one measured component, and x_m and y_m together"
            )

    @property
    def components(self) -> tuple[str, ...]:
        """Measured components in the order of `MEASURABLE`."""
        return tuple(name for name in MEASURABLE if name in self.std)

    def refusing(self, detection: Detection) -> str | None:
        """Name of the first of the filters that `detection` does not pass; None where it passes all."""
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
        """True if its detections give a position: x and y, or range and bearing."""
        return "x_m" in self.std or {"range_m", "bearing_rad"} <= self.std.keys()

    @property
    def placed(self) -> Mount:
        """Its mount, the origin where none is given."""
        return self.mount or _AT_ORIGIN

    @property
    def is_view_given(self) -> bool:
        """True if its field of view or a range is given."""
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
        """True if an object there is in range and in the field of view, shape (...); nothing hides it.
        `positions_m` (..., 2) and the `ego_poses` x, y, yaw (..., 3) at the same times are in the map, `origin_m` is
        the origin of the detection frame in that of the ego.
        """
        x_m, y_m, yaw_rad = np.moveaxis(ego_poses, -1, 0)
        still, mount = np.zeros_like(x_m), self.placed
        at_x_m, at_y_m, _, _ = body_point(
            x_m,
            y_m,
            yaw_rad,
            still,
            still,
            origin_m[0] + mount.x_m,
            origin_m[1] + mount.y_m,
        )
        direction_range = polar(positions_m - np.stack([at_x_m, at_y_m], axis=-1))
        return in_view(
            direction_range[..., 1],
            direction_range[..., 0] - yaw_rad - mount.yaw_rad,
            self.field_of_view_rad or math.tau,
            max_range_m=min(
                (m for m in (self.max_range_m, self.view_range_m) if m is not None),
                default=math.inf,
            ),
            max_range_behind_m=self.max_range_behind_m,
        )

    def noise(self, components: tuple[str, ...]) -> FloatArray:
        """Diagonal covariance R (k, k) of `components`, also those from the map, in the sensor's axes; read-only."""
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
    def round(self) -> bool:
        """True if its error of the position is the same along and across the line of sight."""
        growth = self.std_growth
        return self.std["x_m"] == self.std["y_m"] and growth.get(
            "x_m", 0.0
        ) == growth.get("y_m", 0.0)

    def growth(
        self, components: tuple[str, ...], range_m: FloatArray
    ) -> FloatArray | None:
        """Increase (m, k) of the variances in `noise` at `range_m` (m,), 0 at NaN; None where nothing grows."""
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
    """True for objects at these ranges and bearings (0 on the sensor's axis), any one shape, in view of a sensor.
    `field_of_view_rad` is the full angle; `max_range_behind_m` replaces `max_range_m` in the half behind the sensor.
    """
    off_axis_rad = np.abs(wrap_angles(bearing_rad))
    behind_m = (
        max_range_m
        if max_range_behind_m is None
        else min(max_range_behind_m, max_range_m)
    )
    limit_m = np.where(off_axis_rad > math.pi / 2.0, behind_m, max_range_m)
    in_range = (range_m >= min_range_m) & (range_m <= limit_m)
    return np.asarray(in_range & (off_axis_rad <= field_of_view_rad / 2.0))
