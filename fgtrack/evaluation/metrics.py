"""All metrics of a run."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import BoolArray, Disposition, IntArray
from fgtrack.evaluation.consistency import Consistency, consistency
from fgtrack.evaluation.continuity import late_switches, times_to_confirm, tracked_visits
from fgtrack.evaluation.deadlines import Deadlines
from fgtrack.evaluation.innovations import RESIDUAL_NAMES, message_delays, num_measured, residuals
from fgtrack.evaluation.lagged import LagMetrics, lag_metrics
from fgtrack.evaluation.left_out import left_out
from fgtrack.evaluation.matching import ERROR_NAMES, Matching, confirmed, match, track_errors
from fgtrack.evaluation.multi_object import MultiObjectMetrics, multi_object_metrics
from fgtrack.evaluation.prediction import PredictionErrors, prediction_errors
from fgtrack.evaluation.residual_samples import ResidualSamples, residual_samples
from fgtrack.evaluation.statistics import ChiSquareMean, Distribution, Moments
from fgtrack.io.run import NO_TRACK, EvaluationConfig, Run
from fgtrack.models.measurement import ANGULAR

FALSE_TRACK_SHARE = 0.5
"""A track that is paired with a true object in less than this share of its rows is false."""
LATE_SWITCH_S = 0.5
"""An identity switch within this time after an out-of-sequence update counts as late."""


@dataclass(frozen=True)
class ObjectMetrics:
    """How one true object, or all of them together, was tracked."""

    errors: Mapping[str, Moments]
    """Track minus truth, by name of `ERROR_NAMES`; `position_m` is the distance."""
    ticks_present: int
    """Ticks at which there is truth."""
    ticks_tracked: int
    """Ticks among them at which a track was paired."""
    breaks: int
    """How often tracking went on after a loss, or with another track."""
    id_switches: int
    """How often it went on with another track than the last one."""
    late_id_switches: int
    """Those that follow on an out-of-sequence update, see `late_switches`."""
    time_to_confirm_s: Moments
    """From the first detection to the first confirmed track, a sample for each object, see `times_to_confirm`."""
    ticks_in_sight: int
    """Ticks at which there is truth and some sensor could see it, see `in_sight`."""
    ticks_tracked_in_sight: int
    """Ticks among them at which a track was paired."""

    @property
    def tracked_share(self) -> float:
        """Share of the ticks at which the object was tracked."""
        return self.ticks_tracked / self.ticks_present if self.ticks_present else math.nan

    @property
    def tracked_share_in_sight(self) -> float:
        """Share of the ticks in sight at which the object was tracked."""
        return self.ticks_tracked_in_sight / self.ticks_in_sight if self.ticks_in_sight else math.nan

    def __add__(self, other: "ObjectMetrics") -> "ObjectMetrics":
        return ObjectMetrics(
            {name: self.errors[name] + other.errors[name] for name in ERROR_NAMES},
            self.ticks_present + other.ticks_present,
            self.ticks_tracked + other.ticks_tracked,
            self.breaks + other.breaks,
            self.id_switches + other.id_switches,
            self.late_id_switches + other.late_id_switches,
            self.time_to_confirm_s + other.time_to_confirm_s,
            self.ticks_in_sight + other.ticks_in_sight,
            self.ticks_tracked_in_sight + other.ticks_tracked_in_sight,
        )


NOTHING_TRACKED = ObjectMetrics({name: Moments() for name in ERROR_NAMES}, 0, 0, 0, 0, 0, Moments(), 0, 0)


@dataclass(frozen=True)
class TruthMetrics:
    """Metrics that need truth."""

    objects: Mapping[int, ObjectMetrics]
    """By object id."""
    judged_tracks: int
    """Tracks with a judged row."""
    false_tracks: int
    """Those of them paired in less than `FALSE_TRACK_SHARE` of their judged rows."""
    tracked_objects: int
    """True objects that a confirmed track was ever paired with."""
    tracked_visits: int
    """How often one came into sight and was tracked there: TP of the precision, see `tracked_visits`."""

    @property
    def overall(self) -> ObjectMetrics:
        """All objects together."""
        return sum(self.objects.values(), start=NOTHING_TRACKED)


@dataclass(frozen=True)
class SensorMetrics:
    """What became of the detections of one sensor."""

    dispositions: Mapping[str, int]
    """Detections by disposition; every disposition is there."""
    delay_s: Distribution
    """Receipt minus stamp of the messages that held a detection."""
    residuals: Mapping[str, Moments]
    """Innovations by name of `RESIDUAL_NAMES`, those that occur."""
    nis: Moments
    """Normalised innovation squared."""
    nis_dof: Moments
    """Number of measured components of the updates with a NIS: a consistent filter has this mean NIS."""

    @property
    def detections(self) -> int:
        """All detections received."""
        return sum(self.dispositions.values())


@dataclass(frozen=True)
class Metrics:
    """All metrics of one run."""

    name: str
    """Name of the run folder; empty for a run in memory."""
    estimator: str
    options: EvaluationConfig
    num_tracks: int
    """Distinct ids in tracks.csv."""
    num_confirmed: int
    """Ids that were `confirmed`."""
    sensors: Mapping[str, SensorMetrics]
    residuals: Mapping[str, Moments]
    """Innovations of all sensors and confirmed tracks, by name of `LOCAL_NAMES`: table I of Karle et al. 2023."""
    time_per_tick_s: Distribution
    """Wall time of the ticks with a detection."""
    time_per_detection_s: float
    """Wall time of these ticks per detection received; NaN without any."""
    consistency: Consistency
    deadlines: Deadlines
    truth: TruthMetrics | None = field(default=None)
    """None for a run without truth."""
    lagged: tuple[LagMetrics, ...] = ()
    """Present, lagged and final states, see `lag_metrics`."""
    multi_object: MultiObjectMetrics | None = None
    """None for a run without truth, and where they are not asked for."""
    predictions: Mapping[str, Mapping[str, PredictionErrors]] = field(default_factory=dict)
    """What states say of the next seconds, by predictor and horizon, see `prediction_errors`; empty without truth."""
    failures: Mapping[str, int] = field(default_factory=dict)
    """What failed while the run was made, by kind, zeros included; empty of runs that did not count it."""
    left_out: tuple[str, ...] = ()
    """For sensors of which settings left out detections, how many by which."""

    @property
    def precision(self) -> float:
        """TP / (TP + FP) of Karle et al. 2023, section IV-A: tracked visits of true objects / confirmed ids."""
        if self.truth is None or not self.num_confirmed:
            return math.nan
        return self.truth.tracked_visits / self.num_confirmed

    def as_dict(self) -> dict[str, Any]:
        """JSON values by name, derived ones included; None for what does not exist."""
        values: dict[str, Any] = _plain(self)
        values["precision"] = _plain(self.precision)
        for name, sensor in self.sensors.items():
            values["sensors"][name]["detections"] = sensor.detections
        if self.truth is not None:
            values["truth"]["overall"] = _plain(self.truth.overall)
        return values


def evaluate(run: Run, options: EvaluationConfig | None = None) -> Metrics:
    """Metrics of `run`; without truth, those that need none.

    Without `options` it is judged as its configuration says.
    """
    options = options or run.evaluation
    return evaluate_matched(run, match(run, options), options, residual_samples(run))


def evaluate_matched(
    run: Run, matching: Matching | None, options: EvaluationConfig, samples: ResidualSamples
) -> Metrics:
    """Metrics of `run`, whose `match` by these `options` and `residual_samples` are known."""
    ids = run.tables["tracks"]["track_id"]
    is_confirmed = confirmed(run.tables["tracks"])
    busy = run.tables["timing"]["num_detections"] > 0
    time_s, detections = (
        run.tables["timing"]["process_ns"][busy] / NS_PER_S,
        run.tables["timing"]["num_detections"][busy],
    )
    return Metrics(
        name="" if run.path is None else run.path.resolve().name,
        estimator=str(run.meta.get("estimator", "")),
        options=options,
        num_tracks=len(np.unique(ids)),
        num_confirmed=len(np.unique(ids[is_confirmed])),
        sensors=_sensor_metrics(run),
        residuals=samples.moments(),
        time_per_tick_s=Distribution.of(time_s),
        time_per_detection_s=float(time_s.sum() / detections.sum()) if len(time_s) else math.nan,
        consistency=consistency(run, matching),
        deadlines=Deadlines.of(run),
        truth=None if matching is None else _truth_metrics(run, matching, options),
        lagged=lag_metrics(run, matching),
        multi_object=multi_object_metrics(run, matching, options),
        predictions=prediction_errors(run, matching),
        failures=dict(run.meta.get("failures") or {}),
        left_out=tuple(left_out(run.meta)),
    )


def _truth_metrics(run: Run, matching: Matching, options: EvaluationConfig) -> TruthMetrics:
    errors = track_errors(matching)
    late = late_switches(run, matching, LATE_SWITCH_S)
    confirm_s = times_to_confirm(run, matching, options.gate_m)
    objects = {}
    for index, object_id in enumerate(matching.object_ids):
        mine = errors.object_index == index
        objects[object_id] = _object_metrics(
            {name: Moments.of(values[mine]) for name, values in errors.values.items()},
            matching.present[:, index],
            matching.in_sight[:, index],
            matching.track_ids[:, index],
            int(late[index]),
            Moments.of(confirm_s[index : index + 1]),
        )
    tracks, paired = matching.tracks, matching.paired
    ids, inverse = np.unique(tracks["track_id"], return_inverse=True)
    life = np.bincount(inverse, minlength=len(ids))
    paired_life = np.bincount(inverse[paired], minlength=len(ids))
    is_confirmed = confirmed(tracks)
    return TruthMetrics(
        objects=objects,
        judged_tracks=len(ids),
        false_tracks=int((paired_life < FALSE_TRACK_SHARE * life).sum()),
        tracked_objects=len(np.unique(matching.object_index[paired & is_confirmed])),
        tracked_visits=tracked_visits(matching),
    )


def _object_metrics(
    errors: Mapping[str, Moments],
    present: BoolArray,
    in_sight: BoolArray,
    track_ids: IntArray,
    late_id_switches: int,
    time_to_confirm_s: Moments,
) -> ObjectMetrics:
    """Counts from the track paired with one object at every tick, shape (ticks,)."""
    track_ids, seen = track_ids[present], in_sight[present]
    tracked = track_ids != NO_TRACK
    before = np.concatenate([[NO_TRACK], track_ids])[:-1]
    stretches = int((tracked & (track_ids != before)).sum())
    sequence = track_ids[tracked]
    return ObjectMetrics(
        errors=errors,
        ticks_present=len(track_ids),
        ticks_tracked=len(sequence),
        breaks=max(stretches - 1, 0),
        id_switches=int((sequence[1:] != sequence[:-1]).sum()),
        late_id_switches=late_id_switches,
        time_to_confirm_s=time_to_confirm_s,
        ticks_in_sight=int(seen.sum()),
        ticks_tracked_in_sight=int((seen & tracked).sum()),
    )


def _sensor_metrics(run: Run) -> dict[str, SensorMetrics]:
    updates, values = run.tables["updates"], residuals(run)
    measured = num_measured(updates)
    sensors = {}
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = updates["sensor"] == sensor
        with_nis = mine & np.isfinite(updates["nis"])
        moments = {
            name: (Moments.of_angles if name in ANGULAR else Moments.of)(values[name][mine]) for name in RESIDUAL_NAMES
        }
        dispositions = updates["disposition"][mine].tolist()
        sensors[sensor] = SensorMetrics(
            dispositions={name.value: dispositions.count(name.value) for name in Disposition},
            delay_s=Distribution.of(message_delays(updates.where(mine))[1]),
            residuals={name: value for name, value in moments.items() if value.count},
            nis=Moments.of(updates["nis"][with_nis]),
            nis_dof=Moments.of(measured[with_nis].astype(np.float64)),
        )
    return sensors


def _plain(value: Any) -> Any:
    """`value` as JSON: with derived properties, NaN as None, keys as text."""
    if isinstance(value, Moments | ChiSquareMean):
        return {name: _plain(number) for name, number in value.as_dict().items()}
    if is_dataclass(value):
        plain = {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}
        if isinstance(value, ObjectMetrics):
            plain["tracked_share"] = _plain(value.tracked_share)
            plain["tracked_share_in_sight"] = _plain(value.tracked_share_in_sight)
        return plain
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
