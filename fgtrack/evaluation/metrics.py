"""All metrics of a run."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Disposition, IntArray
from fgtrack.evaluation.diagnostics.outcomes import excluded_lines
from fgtrack.evaluation.matching import Matching, confirmed, match, scenes, track_errors
from fgtrack.evaluation.scores.continuity import (
    breaks,
    switches,
    times_to_confirm,
    tracked_visits,
)
from fgtrack.evaluation.scores.decisions import DecisionMetrics, decision_metrics
from fgtrack.evaluation.scores.innovations import (
    RESIDUAL_NAMES,
    Consistency,
    consistency,
    local_innovations,
    message_delays,
    moments_of,
    residuals,
)
from fgtrack.evaluation.scores.lagged import LagMetrics, lag_metrics
from fgtrack.evaluation.scores.multi_object import (
    MultiObjectMetrics,
    multi_object_metrics,
)
from fgtrack.evaluation.scores.prediction import PredictionErrors, prediction_errors
from fgtrack.evaluation.scores.revisions import RevisionMetrics, revision_metrics
from fgtrack.evaluation.scores.statistics import Distribution, Moments
from fgtrack.evaluation.settings import EvaluationConfig, evaluation_settings
from fgtrack.runs import NO_TRACK, Columns, Run

FALSE_TRACK_SHARE = 0.5
"""A track is false if less than this share of its rows has a true object."""


@dataclass(frozen=True)
class ObjectMetrics:
    """Metrics of one true object, or of all true objects together."""

    errors: Mapping[str, Moments]
    """Errors, track minus truth, by name of `ERROR_NAMES`."""
    ticks_present: int = 0
    """Number of ticks with truth."""
    ticks_tracked: int = 0
    """Number of ticks with truth and a paired track."""
    breaks: int = 0
    """Number of times that tracking resumed after a loss or with another track."""
    id_switches: int = 0
    """Number of times that tracking continued with another track than before."""
    time_to_confirm_s: Moments = field(default_factory=Moments)
    """Time from the first detection to the first confirmed track, one sample per object, see `times_to_confirm`."""
    ticks_in_view: int = 0
    """Number of ticks with truth at which some sensor could detect the object, see `visible`."""
    ticks_tracked_in_view: int = 0
    """Number of ticks in view with a paired track."""

    @property
    def tracked_share(self) -> float:
        """Share of the ticks with truth at which the object was tracked."""
        return (
            self.ticks_tracked / self.ticks_present if self.ticks_present else math.nan
        )

    @property
    def tracked_share_in_view(self) -> float:
        """Share of the ticks in view at which the object was tracked."""
        return (
            self.ticks_tracked_in_view / self.ticks_in_view
            if self.ticks_in_view
            else math.nan
        )


@dataclass(frozen=True)
class TruthMetrics:
    """Metrics that require truth."""

    objects: Mapping[int, ObjectMetrics]
    """Metrics by object id."""
    judged_tracks: int
    """Number of tracks with an evaluated row."""
    false_tracks: int
    """Number of evaluated tracks with a true object in less than `FALSE_TRACK_SHARE` of their rows."""
    tracked_visits: int
    """True positives of the precision: times in view with a confirmed track, see `tracked_visits`."""
    overall: ObjectMetrics
    """Metrics over all objects together."""


@dataclass(frozen=True)
class SensorMetrics:
    """Dispositions, delays and innovations of one sensor."""

    dispositions: Mapping[str, int]
    """Number of detections by disposition, zeros included."""
    overtaken: int
    """Number of detections with a newer detection of the sensor received before them."""
    delay_s: Distribution
    """Delay from stamp to receipt of the messages with a detection."""
    residuals: Mapping[str, Moments]
    """Innovations by name of `RESIDUAL_NAMES`; only names with innovations."""

    @property
    def detections(self) -> int:
        """Number of received detections."""
        return sum(self.dispositions.values())


@dataclass(frozen=True)
class Metrics:
    """All metrics of one run."""

    name: str
    """Name of the run folder; empty for a run in memory."""
    estimator: str
    options: EvaluationConfig
    num_tracks: int
    """Number of distinct ids in tracks.csv."""
    num_confirmed: int
    """Number of tracks that were confirmed at some tick."""
    sensors: Mapping[str, SensorMetrics]
    residuals: Mapping[str, Moments]
    """Innovations of confirmed tracks over all sensors, by name of `LOCAL_NAMES`.

    These are the residuals in table I of Karle et al. 2023.
    """
    time_per_tick_s: Distribution
    """Wall time of each tick with a detection."""
    time_per_detection_s: float
    """Wall time per received detection; NaN without detections."""
    consistency: Consistency
    revisions: RevisionMetrics = field(default_factory=RevisionMetrics)
    """Decisions and states that were taken back, see `revision_metrics`."""
    truth: TruthMetrics | None = None
    """Metrics with truth; None for a run without truth."""
    lagged: tuple[LagMetrics, ...] = ()
    """Errors of present, lagged and final states, see `lag_metrics`."""
    multi_object: MultiObjectMetrics | None = None
    """GOSPA, CLEAR, IDF1 and HOTA; None without truth, or if the options exclude them."""
    decisions: DecisionMetrics | None = None
    """Parts of wrong decisions and of estimates in the errors; None without truth, or without `detections.csv`."""
    predictions: Mapping[str, Mapping[str, PredictionErrors]] = field(
        default_factory=dict
    )
    """Errors of predictions by predictor and horizon, see `prediction_errors`; empty without truth."""
    failures: Mapping[str, int] = field(default_factory=dict)
    """Number of failures inside the estimator by kind, zeros included; empty if the run did not count them."""
    left_out: tuple[str, ...] = ()
    """Lines on detections that settings excluded."""

    @property
    def precision(self) -> float:
        """Precision TP / (TP + FP) of Karle et al. 2023, section IV-A: tracked visits over confirmed tracks."""
        if self.truth is None or not self.num_confirmed:
            return math.nan
        return self.truth.tracked_visits / self.num_confirmed

    def as_dict(self) -> dict[str, Any]:
        """Return JSON values by name, including derived values; None for NaN."""
        values: dict[str, Any] = _plain(self)
        return values


def evaluate(
    run: Run,
    truth: Mapping[str, Any] | None = None,
    options: EvaluationConfig | None = None,
) -> Metrics:
    """Return the metrics of `run`; without truth only those that require none.

    `truth` are columns of truth.csv, for instance a DataFrame; by default the truth of
    the recording. `options` are by default the settings in the run's configuration.
    """
    if truth is not None:
        num_rows = len(truth["stamp_ns"])
        columns = {
            name: np.asarray(truth.get(name, np.full(num_rows, np.nan)))
            for name in run.tables["truth"]
        }
        run = replace(run, tables={**run.tables, "truth": Columns(columns)})
    options = options or evaluation_settings(run)
    return evaluate_matched(run, match(run, options), options)


def evaluate_matched(
    run: Run, matching: Matching | None, options: EvaluationConfig
) -> Metrics:
    """Return the metrics of `run` from its existing `matching` with these `options`."""
    tracks = run.tables["tracks"]
    timing = run.tables["timing"]
    busy = timing["num_detections"] > 0
    scored = (
        scenes(run, matching) if matching is not None and options.multi_object else None
    )
    time_s = timing["process_ns"][busy] / NS_PER_S
    detections = timing["num_detections"][busy]
    return Metrics(
        name="" if run.path is None else run.path.resolve().name,
        estimator=str(run.meta.get("estimator", "")),
        options=options,
        num_tracks=len(np.unique(tracks["track_id"])),
        num_confirmed=len(np.unique(tracks["track_id"][confirmed(tracks)])),
        sensors=_sensor_metrics(run),
        residuals={
            name: moments_of(name, values)
            for name, values in local_innovations(run)[1].items()
        },
        time_per_tick_s=Distribution.of(time_s),
        time_per_detection_s=float(time_s.sum() / detections.sum())
        if len(time_s)
        else math.nan,
        consistency=consistency(run, matching),
        revisions=revision_metrics(run, options),
        truth=None if matching is None else _truth_metrics(run, matching, options),
        lagged=lag_metrics(run, matching),
        multi_object=None
        if scored is None
        else multi_object_metrics(scored, options.gate_m),
        decisions=decision_metrics(run, matching, options),
        predictions=prediction_errors(run, matching),
        failures=dict(run.meta.get("failures") or {}),
        left_out=tuple(excluded_lines(run.meta)),
    )


def _truth_metrics(
    run: Run, matching: Matching, options: EvaluationConfig
) -> TruthMetrics:
    errors = track_errors(matching)
    confirm_s = times_to_confirm(run, matching, options.gate_m)
    tracked = matching.track_ids != NO_TRACK

    def together(indices: Sequence[int]) -> ObjectMetrics:
        """Return the metrics of the objects with these indices."""
        mine = np.isin(errors.object_index, indices)
        present = matching.present[:, indices]
        in_view = matching.in_view[:, indices]
        sequences = [
            matching.track_ids[matching.present[:, index], index] for index in indices
        ]
        return ObjectMetrics(
            errors={
                name: Moments.of(values[mine]) for name, values in errors.values.items()
            },
            ticks_present=int(present.sum()),
            ticks_tracked=int((present & tracked[:, indices]).sum()),
            breaks=sum(map(breaks, sequences)),
            id_switches=sum(len(switches(sequence)) for sequence in sequences),
            time_to_confirm_s=Moments.of(confirm_s[indices]),
            ticks_in_view=int((present & in_view).sum()),
            ticks_tracked_in_view=int((present & in_view & tracked[:, indices]).sum()),
        )

    ids, inverse = np.unique(matching.tracks["track_id"], return_inverse=True)
    num_rows = np.bincount(inverse, minlength=len(ids))
    num_paired = np.bincount(inverse[matching.paired], minlength=len(ids))
    return TruthMetrics(
        objects={
            object_id: together([index])
            for index, object_id in enumerate(matching.object_ids)
        },
        judged_tracks=len(ids),
        false_tracks=int((num_paired < FALSE_TRACK_SHARE * num_rows).sum()),
        tracked_visits=tracked_visits(matching),
        overall=together(range(len(matching.object_ids))),
    )


def _sensor_metrics(run: Run) -> dict[str, SensorMetrics]:
    updates = run.tables["updates"]
    values = residuals(run)
    sensors = {}
    for sensor in np.unique(updates["sensor"]).tolist():
        mine = updates["sensor"] == sensor
        moments = {
            name: moments_of(name, values[name][mine]) for name in RESIDUAL_NAMES
        }
        counts = Counter(updates["disposition"][mine].tolist())
        sensors[sensor] = SensorMetrics(
            dispositions={name.value: counts[name.value] for name in Disposition},
            overtaken=_overtaken(
                updates["stamp_ns"][mine], updates["receipt_ns"][mine]
            ),
            delay_s=Distribution.of(message_delays(updates.where(mine))[1]),
            residuals={name: value for name, value in moments.items() if value.count},
        )
    return sensors


def _overtaken(stamps_ns: IntArray, receipts_ns: IntArray) -> int:
    """Return the number of stamps (m,) that are older than a stamp with an earlier receipt."""
    ordered_ns = stamps_ns[np.lexsort((stamps_ns, receipts_ns))]
    return int((ordered_ns < np.maximum.accumulate(ordered_ns)).sum())


def _plain(value: Any) -> Any:
    """Return `value` as JSON values: fields and derived properties by name, NaN as None, keys as text.

    Properties that begin with `is_` are excluded.
    """
    if is_dataclass(value):
        derived = [
            name
            for name, each in vars(type(value)).items()
            if isinstance(each, property) and name[:3] != "is_"
        ]
        value = {
            name: getattr(value, name)
            for name in (*(entry.name for entry in fields(value)), *derived)
        }
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
