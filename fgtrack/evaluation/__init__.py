"""Evaluation of runs: pairs of tracks and true objects, metrics, intervals, tables.

Evaluation reads run folders, never a tracker. The names below are public.
"""

from typing import TYPE_CHECKING

from fgtrack.core.lazy import lazy_names

#: Module that each public name is loaded from on first use.
_HOMES = {
    "Column": "fgtrack.evaluation.tables",
    "Columns": "fgtrack.runs",
    "Consistency": "fgtrack.evaluation.scores.innovations",
    "Distribution": "fgtrack.evaluation.scores.statistics",
    "Estimate": "fgtrack.evaluation.intervals",
    "EvaluatedRun": "fgtrack.evaluation.runs",
    "EvaluationConfig": "fgtrack.evaluation.settings",
    "LOCAL_NAMES": "fgtrack.evaluation.scores.innovations",
    "MS": "fgtrack.evaluation.tables",
    "Matching": "fgtrack.evaluation.matching",
    "Metric": "fgtrack.evaluation.scores.registry",
    "Metrics": "fgtrack.evaluation.metrics",
    "Moments": "fgtrack.evaluation.scores.statistics",
    "NO_TRACK": "fgtrack.runs",
    "PREDICTION_STEP_S": "fgtrack.evaluation.scores.prediction",
    "RUN": "fgtrack.evaluation.tables",
    "RevisionMetrics": "fgtrack.evaluation.scores.revisions",
    "Scenes": "fgtrack.evaluation.near_pairs",
    "Statistic": "fgtrack.evaluation.intervals",
    "Table": "fgtrack.evaluation.tables",
    "Tables": "fgtrack.evaluation.tables",
    "UNKNOWN": "fgtrack.evaluation.intervals",
    "average": "fgtrack.evaluation.intervals",
    "sums_by_stamp": "fgtrack.evaluation.intervals",
    "clear": "fgtrack.evaluation.scores.multi_object",
    "comparisons": "fgtrack.evaluation.comparison",
    "displacements": "fgtrack.evaluation.scores.prediction",
    "ego_states": "fgtrack.evaluation.truth",
    "evaluated": "fgtrack.evaluation.runs",
    "evaluation_settings": "fgtrack.evaluation.settings",
    "gospa": "fgtrack.evaluation.scores.multi_object",
    "t_gospa": "fgtrack.evaluation.scores.t_gospa",
    "lag_metrics": "fgtrack.evaluation.scores.lagged",
    "local_innovations": "fgtrack.evaluation.scores.innovations",
    "match": "fgtrack.evaluation.matching",
    "message_delays": "fgtrack.evaluation.scores.innovations",
    "moments_of": "fgtrack.evaluation.scores.innovations",
    "named": "fgtrack.evaluation.tables",
    "paired": "fgtrack.evaluation.intervals",
    "position_nees": "fgtrack.evaluation.matching",
    "revision_metrics": "fgtrack.evaluation.scores.revisions",
    "scenes": "fgtrack.evaluation.matching",
    "short": "fgtrack.evaluation.tables",
    "true_paths": "fgtrack.evaluation.truth",
    "within_run": "fgtrack.evaluation.intervals",
}

__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same names for type checkers; a test keeps the two lists equal
    from fgtrack.evaluation.comparison import comparisons as comparisons
    from fgtrack.evaluation.intervals import UNKNOWN as UNKNOWN
    from fgtrack.evaluation.intervals import Estimate as Estimate
    from fgtrack.evaluation.intervals import Statistic as Statistic
    from fgtrack.evaluation.intervals import average as average
    from fgtrack.evaluation.intervals import paired as paired
    from fgtrack.evaluation.intervals import sums_by_stamp as sums_by_stamp
    from fgtrack.evaluation.intervals import within_run as within_run
    from fgtrack.evaluation.matching import Matching as Matching
    from fgtrack.evaluation.matching import match as match
    from fgtrack.evaluation.matching import position_nees as position_nees
    from fgtrack.evaluation.matching import scenes as scenes
    from fgtrack.evaluation.metrics import Metrics as Metrics
    from fgtrack.evaluation.near_pairs import Scenes as Scenes
    from fgtrack.evaluation.runs import EvaluatedRun as EvaluatedRun
    from fgtrack.evaluation.runs import evaluated as evaluated
    from fgtrack.evaluation.scores.innovations import LOCAL_NAMES as LOCAL_NAMES
    from fgtrack.evaluation.scores.innovations import Consistency as Consistency
    from fgtrack.evaluation.scores.innovations import (
        local_innovations as local_innovations,
    )
    from fgtrack.evaluation.scores.innovations import message_delays as message_delays
    from fgtrack.evaluation.scores.innovations import moments_of as moments_of
    from fgtrack.evaluation.scores.lagged import lag_metrics as lag_metrics
    from fgtrack.evaluation.scores.multi_object import clear as clear
    from fgtrack.evaluation.scores.multi_object import gospa as gospa
    from fgtrack.evaluation.scores.prediction import (
        PREDICTION_STEP_S as PREDICTION_STEP_S,
    )
    from fgtrack.evaluation.scores.prediction import displacements as displacements
    from fgtrack.evaluation.scores.registry import Metric as Metric
    from fgtrack.evaluation.scores.revisions import RevisionMetrics as RevisionMetrics
    from fgtrack.evaluation.scores.revisions import revision_metrics as revision_metrics
    from fgtrack.evaluation.scores.statistics import Distribution as Distribution
    from fgtrack.evaluation.scores.statistics import Moments as Moments
    from fgtrack.evaluation.scores.t_gospa import t_gospa as t_gospa
    from fgtrack.evaluation.settings import EvaluationConfig as EvaluationConfig
    from fgtrack.evaluation.settings import evaluation_settings as evaluation_settings
    from fgtrack.evaluation.tables import MS as MS
    from fgtrack.evaluation.tables import RUN as RUN
    from fgtrack.evaluation.tables import Column as Column
    from fgtrack.evaluation.tables import Table as Table
    from fgtrack.evaluation.tables import Tables as Tables
    from fgtrack.evaluation.tables import named as named
    from fgtrack.evaluation.tables import short as short
    from fgtrack.evaluation.truth import ego_states as ego_states
    from fgtrack.evaluation.truth import true_paths as true_paths
    from fgtrack.runs import NO_TRACK as NO_TRACK
    from fgtrack.runs import Columns as Columns

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
