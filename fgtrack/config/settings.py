"""The configuration of a run. The defaults are for open space; a YAML file overrides them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Discriminator, Field, NonNegativeFloat, PositiveFloat, Tag

from fgtrack.config.motion import InitiationConfig, MotionConfig, turns
from fgtrack.config.shipped import find_file
from fgtrack.config.yaml_file import dump, load, plain, validate, with_settings
from fgtrack.core.errors import CallError
from fgtrack.core.settings import require, settings
from fgtrack.estimation.registry import ESTIMATORS, Claims
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.evaluation.settings import EvaluationConfig
from fgtrack.inputs.settings import InputConfig
from fgtrack.karle2023.tracker_parts import NeighbourhoodMerge, UngatedEuclidean
from fgtrack.models.correlated_errors import with_correlated_errors
from fgtrack.models.motion import MotionModel
from fgtrack.models.road import OPEN_SPACE
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import (
    GatedEuclidean,
    GatedMahalanobis,
    Hypotheses,
)
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.detections import ConnectedMerge, NoMerge
from fgtrack.tracking.lives.counters import LifecycleRules
from fgtrack.tracking.lives.existence import ExistenceRules

__all__ = [
    "ClockConfig",
    "EgoConfig",
    "FilterConfig",
    "MapConfig",
]

MergeConfig = Annotated[
    ConnectedMerge | NoMerge | NeighbourhoodMerge, Discriminator("kind")
]
AssociationConfig = Annotated[
    GatedEuclidean | GatedMahalanobis | Hypotheses | UngatedEuclidean,
    Discriminator("kind"),
]
_Weight = Annotated[float, Field(gt=0.0, le=1.0)]


@settings
class ClockConfig:
    """Times of the ticks."""

    node_hz: Annotated[float, Field(ge=0.1, le=10_000.0)] | None = 50.0
    """Ticks are at multiples of the node period; null: every message causes a tick."""
    idle_ticks: bool = True
    """False leaves out the ticks without a new list of detections, so a run has fewer rows.

    The ego states of a tick without a list are then delivered with the next tick.
    """


@dataclass(frozen=True)
class MapConfig:
    """The map, and the largest distance of objects from it; a negative buffer excludes objects near the wall."""

    track: str | None = None
    """CSV file of the track, `oval` for the built-in track, or `none` for open space.

    Null: in a replay the track of the recording, else open space.
    """
    pit: str | None = None
    """CSV file of the pit lane, `oval` for the built-in pit lane, or null."""
    inner_buffer_m: float = 0.0
    """Largest distance of an object beyond the inner bound of the track."""
    outer_buffer_m: float = 0.0
    """Largest distance of an object beyond the outer bound of the track."""
    pit_buffer_m: float = 0.0
    """Largest distance of an object beyond either bound of the pit lane."""

    @property
    def track_file(self) -> str | None:
        """File of the track; None for open space."""
        return None if self.track == OPEN_SPACE else self.track


@settings
class EgoConfig:
    """Low-pass filter of the ego state, its uncertainty, and the origin of detections in the ego frame."""

    yaw_weight: _Weight = 1.0
    """Weight of a new yaw in the low-pass filter; 1 means no filtering."""
    yaw_rate_weight: _Weight = 1.0
    """Weight of a new yaw rate in the low-pass filter."""
    detection_origin_x_m: float | None = None
    """Origin of the ego frame of detections, ahead of the ego reference point.

    Null: in a replay the origin in the recording, else 0.
    """
    detection_origin_y_m: float = 0.0
    """Origin of the ego frame of detections, to the left of the ego reference point."""
    clock_offset_s: Annotated[float, Field(ge=-86_400.0, le=86_400.0)] = 0.0
    """Stamp of the ego's states minus time of measurement; it is subtracted from each stamp before any other use."""
    uncertainty: Literal["none", "independent"] = "independent"
    """Use of the ego's covariance: `none` ignores it, as in the paper.

    `independent` adds it to the noise of each detection, as if the ego errors of
    detections were independent.
    """
    position_std_m: NonNegativeFloat = 0.0
    """Standard deviation of the ego's x and y, if the recording reports no covariance."""
    position_time_s: PositiveFloat | None = None
    """Correlation time of the ego's position errors, which drift as those of GNSS positions do.

    Positions are then fused with speed and yaw by their standard deviations. Null:
    positions are used as reported, with independent errors.
    """
    yaw_std_rad: NonNegativeFloat = 0.0
    """Standard deviation of the ego's yaw, if the recording reports no covariance."""
    speed_std_mps: NonNegativeFloat = 0.0
    """Standard deviation of the ego's speed, if the recording reports no covariance."""
    yaw_rate_std_radps: NonNegativeFloat = 0.0
    """Standard deviation of the ego's yaw rate, if the recording reports no covariance."""
    wait_s: Annotated[float, Field(ge=0.0, le=60.0)] = 1.0
    """Longest time for which a list that needs the ego's pose waits for an ego state at or after its stamp.

    The list waits for at most half of the estimator's window. Afterwards, or with 0
    immediately, the pose is extrapolated.
    """
    accel_std_mps2: PositiveFloat = 1.0
    """Standard deviation of the ego's acceleration, with which the speed's uncertainty grows in extrapolated poses.

    It is used until the ego's states allow an estimate.
    """
    yaw_accel_std_radps2: PositiveFloat = 0.1
    """Standard deviation of the ego's yaw acceleration, with which the yaw's uncertainty grows in extrapolated poses.

    It is used until the ego's states allow an estimate.
    """

    def __post_init__(self) -> None:
        fused = self.position_time_s is not None
        require(
            not fused or self.uncertainty != "none",
            "uncertainty",
            "must be `independent` if position_time_s is set",
            "none",
        )

    @property
    def detection_origin_m(self) -> tuple[float, float]:
        """Origin of the detections' ego frame, ahead of the ego reference point and to its left."""
        return self.detection_origin_x_m or 0.0, self.detection_origin_y_m


Defect = Literal[
    "circular_heading",
    "heading_jump",
    "noise_per_step",
    "saturated_yaw",
    "stale_present",
    "one_slot",
    "refiltered_ego",
    "leading_clock",
]
"""Defects of the published implementation.

- `heading_jump` (Q3, Q4): the published map look-up from the nearest row, with the heading interpolated as a number,
  even across its jump at +-pi.
- `circular_heading` (Q4): the same look-up, with the heading interpolated on the circle.
- `noise_per_step` (Q6): process noise of (std_per_s dt)^2 in each step dt, so it depends on the filter's frequency.
- `saturated_yaw` (Q2): the yaw stays at its upper limit.
- `stale_present` (Q8): an update without delay does not change the stored present state.
- `one_slot` (Q12): only the newest list of each sensor is used.
- `refiltered_ego` (Q13): the ego's low-pass filters its own output at every tick.
- `leading_clock` (Q14): the tracking time is ahead of the clock by up to one step.
"""


def _lifecycle_kind(value: object) -> str:
    """Tag of the form of `lifecycle`: `existence` unless another kind is given."""
    kind = (
        value.get("kind", "existence")
        if isinstance(value, Mapping)
        else getattr(value, "kind", "existence")
    )
    return "existence" if kind == "existence" else "counting"


LifecycleConfig = Annotated[
    Annotated[LifecycleRules, Tag("counting")]
    | Annotated[ExistenceRules, Tag("existence")],
    Discriminator(_lifecycle_kind),
]


@settings
class FilterConfig:
    """Time grid of the backward-forward EKF."""

    frequency_hz: Annotated[float, Field(ge=1.0, le=10_000.0)] = 100.0
    """Frequency of the grid."""
    storage_s: float = 3.0
    """Time for which the filter keeps states."""

    def __post_init__(self) -> None:
        if not 1.0 / self.frequency_hz <= self.storage_s <= 60.0:
            raise ValueError(
                f"storage_s: must lie between one step and 60 s, is {self.storage_s}"
            )


#: Estimators that use the section `smoother`.
SMOOTHERS = ("smoother", "smoother-batch", "smoother-banded")


@dataclass(frozen=True)
class Effective:
    """Settings that are easily overlooked, as in meta.json."""

    detection_origin_m: tuple[float, float]
    """Origin of the ego frame of detections: ahead of the ego reference point, and to its left."""
    merge_distance_m: float | None
    """Largest distance at which detections are merged; None without merging."""
    lag_key: str
    """Configuration key of the window's length."""
    lag_s: float
    """Length of the estimator's window."""
    reach_s: float
    """Largest age at which a detection changes a track."""

    def __str__(self) -> str:
        x_m, y_m = self.detection_origin_m
        merge = (
            "none"
            if self.merge_distance_m is None
            else f"up to {self.merge_distance_m:g} m"
        )
        late = (
            ""
            if self.reach_s == self.lag_s
            else f", late detections up to {self.reach_s:g} s"
        )
        origin = (
            f"detection origin {x_m:g} m ahead, {y_m:g} m left of the ego; "
            if x_m or y_m
            else ""
        )
        return f"{origin}merge {merge}; lag {self.lag_s:g} s{late}"


@dataclass(frozen=True)
class Config:
    """All settings that determine a run, apart from its input."""

    estimator: str = "ekf-replay"
    """Name of the estimator for all tracks."""
    sensors: Mapping[str, SensorModel] = field(default_factory=dict)
    """Sensors by name. A replay assumes the sensors, and the settings of a sensor, that are not given.

    A configuration is complete, and nothing is assumed, if each sensor has `std` and limits of view.
    """
    ignore_sensors: tuple[str, ...] = ()
    """Sensors of the input that are ignored, even if `sensors` contains them."""
    input: InputConfig = field(default_factory=InputConfig)
    clock: ClockConfig = field(default_factory=ClockConfig)
    map: MapConfig = field(default_factory=MapConfig)
    ego: EgoConfig = field(default_factory=EgoConfig)
    merge: MergeConfig = field(default_factory=NoMerge)
    association: AssociationConfig = field(default_factory=GatedMahalanobis)
    lifecycle: LifecycleConfig = field(default_factory=ExistenceRules)
    birth: Birth = field(default_factory=Birth)
    initiation: InitiationConfig = field(default_factory=InitiationConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    filter: FilterConfig = field(default_factory=FilterConfig)
    smoother: SmootherSettings = field(default_factory=SmootherSettings)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    defects: tuple[Defect, ...] = ()
    """Defects of the published implementation that are reproduced, see `Defect`."""
    options: Mapping[str, Mapping[str, bool | int | float | str]] = field(
        default_factory=dict
    )
    """Options of estimators without a section of their own, by name: `{reorder-buffer: {hold_s: 0.2}}`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "estimator", ESTIMATORS.resolve(self.estimator))
        for name in self.options:
            if ESTIMATORS.resolve(name) != name:
                raise ValueError(
                    f"options: the estimator {name!r} is now named {ESTIMATORS.resolve(name)!r}"
                )
        if self.motion.kind != "ctrv_euler" and {
            "noise_per_step",
            "saturated_yaw",
        } & set(self.defects):
            raise ValueError(
                "defects: noise_per_step and saturated_yaw need motion.kind ctrv_euler"
            )
        for name, sensor in self.sensors.items():
            if sensor.correlation is not None and self.motion.kind == "ctrv_euler":
                raise ValueError(
                    f"sensors.{name}.correlation: needs motion.kind ctrv, ctra, ct or cv"
                )
            curvature = sensor.curvature_from_map_std_radpm
            if curvature is not None and not turns(self.motion.model(self.sensors)):
                raise ValueError(
                    f"sensors.{name}.curvature_from_map_std_radpm: needs motion.kind ctrv or ctra"
                )

    @classmethod
    def from_yaml(cls, name: str | Path) -> Self:
        """Return the configuration of a YAML file, or of a shipped name; raises `CallError` with file and key."""
        return load(cls, find_file("configuration", name))

    @classmethod
    def from_dict(cls, values: Mapping[str, object]) -> Self:
        """Return the configuration of nested mappings, such as `run.config`; missing keys get their defaults.

        Raises `CallError` with the key, and for an argument that is no mapping.
        """
        if not isinstance(values, Mapping):
            raise CallError(
                f"config: must be a mapping of settings, is a {type(values).__name__}"
            )
        return validate(cls, plain(values), "the given configuration")

    def to_yaml(self, path: str | Path) -> None:
        """Write every key to a YAML file; an existing file is replaced."""
        Path(path).write_text(dump(self), encoding="utf-8")

    def replace(
        self, settings: Mapping[str, object] | None = None, /, **sections: object
    ) -> Self:
        """Return a copy with other values of dotted keys, or of whole sections; raises `CallError` with the key.

        `config.replace({"smoother.lag_s": 3.0}, estimator="smoother")`
        """
        changes = {
            key: plain(value) for key, value in {**(settings or {}), **sections}.items()
        }
        return with_settings(type(self), plain(self), changes, "the configuration")

    @property
    def used_sensors(self) -> Mapping[str, SensorModel]:
        """Sensors that are not ignored."""
        return {
            name: sensor
            for name, sensor in self.sensors.items()
            if name not in self.ignore_sensors
        }

    @property
    def effective(self) -> Effective:
        """Settings that are easily overlooked, with the values that a run uses."""
        key = "filter.storage_s"
        lag_s = self.filter.storage_s
        behind_s = 0.0
        if self.estimator in SMOOTHERS:
            key = "smoother.lag_s"
            lag_s = self.smoother.lag_s
            behind_s = self.smoother.behind_s
        distance_m = None if isinstance(self.merge, NoMerge) else self.merge.distance_m
        return Effective(
            self.ego.detection_origin_m, distance_m, key, lag_s, lag_s + behind_s
        )

    @property
    def revises(self) -> bool:
        """True if late lists change decisions: not where the estimator fuses no late measurement."""
        drops = self.estimator == "drop" or (
            self.estimator in SMOOTHERS and self.smoother.late == "drop"
        )
        return (
            isinstance(self.association, Hypotheses)
            and self.association.revise
            and not drops
        )

    @property
    def revision_line(self) -> str:
        """Line about decisions that late lists change; empty for an association that decides each list once."""
        if not isinstance(self.association, Hypotheses):
            return ""
        if not self.revises:
            return "late lists change no decision: a list older than the newest list is too old"
        line = f"late lists change decisions for {self.effective.reach_s:g} s"
        if Claims.of(ESTIMATORS.load(self.estimator)).is_exact:
            return line
        return f"{line}; {self.estimator} is not exact: its states depend on the order of arrival"

    def motion_model(self) -> MotionModel:
        """Return the motion model of the tracks, extended by the time-correlated errors of sensors."""
        return with_correlated_errors(
            self.motion.model(self.used_sensors), self.used_sensors
        )
