"""Track several objects from the delayed object lists of several sensors, and compare how delays are dealt with.

Every name that a user imports is here, or in a public module: `config`, `evaluation`, `plot`, `show`, `sim`, `testing`.
A name is loaded when it is first used. All other modules are private.
"""

from typing import TYPE_CHECKING

from fgtrack.core.lazy import lazy_names

__version__ = "0.2.0"

#: Module (or package, of a module) that each public name is loaded from on first use.
_HOMES = {
    "Advice": "fgtrack.advice.page",
    "BatchBank": "fgtrack.estimation.smoothing.gtsam.batch",
    "BatchSolver": "fgtrack.estimation.smoothing.gtsam.batch",
    "BoolArray": "fgtrack.core.types",
    "CT": "fgtrack.models.motion",
    "CTRA": "fgtrack.models.motion",
    "CTRV": "fgtrack.models.motion",
    "CV": "fgtrack.models.motion",
    "CallError": "fgtrack.core.errors",
    "Checkpoint": "fgtrack.pipeline.live",
    "Config": "fgtrack.config.settings",
    "DataError": "fgtrack.core.errors",
    "Decision": "fgtrack.meaning.decision",
    "Detection": "fgtrack.core.types",
    "DetectionList": "fgtrack.core.types",
    "Disposition": "fgtrack.core.types",
    "Draft": "fgtrack.meaning.draft",
    "EgoState": "fgtrack.core.types",
    "Estimator": "fgtrack.estimation.base",
    "FgtrackError": "fgtrack.core.errors",
    "FileFormat": "fgtrack.inputs.source",
    "FloatArray": "fgtrack.core.types",
    "Health": "fgtrack.pipeline.health",
    "HealthLimits": "fgtrack.pipeline.health",
    "HealthState": "fgtrack.pipeline.health",
    "IntArray": "fgtrack.core.types",
    "Lateness": "fgtrack.pipeline.live_statistics",
    "Ledger": "fgtrack.advice.ledger",
    "Measurement": "fgtrack.estimation.base",
    "MeasurementModel": "fgtrack.models.measurement",
    "Message": "fgtrack.core.types",
    "MotionModel": "fgtrack.models.motion",
    "MountEstimate": "fgtrack.meaning.mounts",
    "Mounts": "fgtrack.meaning.mounts",
    "NS_PER_S": "fgtrack.core.time",
    "Nis": "fgtrack.pipeline.health",
    "ObjectList": "fgtrack.inputs.formats.common",
    "Ranking": "fgtrack.ranking.result",
    "Revised": "fgtrack.pipeline.health",
    "Revision": "fgtrack.core.types",
    "RobustLoss": "fgtrack.models.sensors",
    "Run": "fgtrack.runs",
    "ScheduledMeasurement": "fgtrack.evaluation.bounds",
    "SensorHealth": "fgtrack.pipeline.health",
    "SensorModel": "fgtrack.models.sensors",
    "SensorPose": "fgtrack.models.measurement",
    "SmoothedReport": "fgtrack.core.types",
    "SmootherBank": "fgtrack.estimation.smoothing.bank",
    "Start": "fgtrack.estimation.base",
    "Stateful": "fgtrack.core.state",
    "StatesAt": "fgtrack.estimation.base",
    "Study": "fgtrack.recording_study",
    "Tables": "fgtrack.evaluation.tables",
    "TickReport": "fgtrack.core.types",
    "TickTiming": "fgtrack.pipeline.live_statistics",
    "TrackBank": "fgtrack.estimation.base",
    "TrackReport": "fgtrack.core.types",
    "TrackState": "fgtrack.core.types",
    "TrackStatus": "fgtrack.core.types",
    "Tracker": "fgtrack.pipeline.live",
    "TruthState": "fgtrack.core.types",
    "TuneReport": "fgtrack.noise.parameters",
    "UpdateRecord": "fgtrack.core.types",
    "UpdateResult": "fgtrack.estimation.base",
    "UpdateStatus": "fgtrack.estimation.base",
    "Window": "fgtrack.estimation.smoothing.window",
    "advise": "fgtrack.advice.advise",
    "bounds": "fgtrack.evaluation.bounds",
    "bounds_along": "fgtrack.evaluation.bounds",
    "close_ups": "fgtrack.show.figures.late_detection",
    "compare": "fgtrack.evaluation.tables.compare",
    "config": "fgtrack",
    "draft": "fgtrack.meaning.public",
    "estimate_offsets": "fgtrack.clocks.offsets",
    "estimator": "fgtrack.estimation.registry",
    "estimator_claims": "fgtrack.estimation.registry",
    "evaluate": "fgtrack.evaluation.metrics",
    "evaluation": "fgtrack",
    "initial_state": "fgtrack.estimation.birth",
    "ledger": "fgtrack.advice.ledger",
    "list_estimators": "fgtrack.estimation.registry",
    "load_run": "fgtrack.runs",
    "measured_position": "fgtrack.models.measurement",
    "measurement_factor": "fgtrack.estimation.smoothing.gtsam.factors",
    "measurement_model": "fgtrack.models.measurement",
    "motion_factor": "fgtrack.estimation.smoothing.gtsam.factors",
    "mounts": "fgtrack.meaning.public",
    "nanoseconds": "fgtrack.core.time",
    "open_input": "fgtrack.inputs.source",
    "plot": "fgtrack.show.figures",
    "rank": "fgtrack.ranking.public",
    "read_scenario": "fgtrack.config.reading",
    "replay": "fgtrack.pipeline.public",
    "robust_weight": "fgtrack.estimation.filters.ekf",
    "rotation": "fgtrack.core.geometry",
    "seconds": "fgtrack.core.time",
    "show": "fgtrack",
    "sim": "fgtrack",
    "simulate": "fgtrack.pipeline.public",
    "study": "fgtrack.recording_study",
    "sweep": "fgtrack.pipeline.scored_sweep",
    "testing": "fgtrack",
    "tune": "fgtrack.noise.tune",
    "wrap_angle": "fgtrack.core.geometry",
    "write_recording": "fgtrack.inputs.recording",
}

__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same names for type checkers; a test keeps the two lists equal
    from fgtrack import config as config
    from fgtrack import evaluation as evaluation
    from fgtrack import show as show
    from fgtrack import sim as sim
    from fgtrack import testing as testing
    from fgtrack.advice.advise import advise as advise
    from fgtrack.advice.ledger import Ledger as Ledger
    from fgtrack.advice.ledger import ledger as ledger
    from fgtrack.advice.page import Advice as Advice
    from fgtrack.clocks.offsets import estimate_offsets as estimate_offsets
    from fgtrack.config.reading import read_scenario as read_scenario
    from fgtrack.config.settings import Config as Config
    from fgtrack.core.errors import CallError as CallError
    from fgtrack.core.errors import DataError as DataError
    from fgtrack.core.errors import FgtrackError as FgtrackError
    from fgtrack.core.geometry import rotation as rotation
    from fgtrack.core.geometry import wrap_angle as wrap_angle
    from fgtrack.core.state import Stateful as Stateful
    from fgtrack.core.time import NS_PER_S as NS_PER_S
    from fgtrack.core.time import nanoseconds as nanoseconds
    from fgtrack.core.time import seconds as seconds
    from fgtrack.core.types import BoolArray as BoolArray
    from fgtrack.core.types import Detection as Detection
    from fgtrack.core.types import DetectionList as DetectionList
    from fgtrack.core.types import Disposition as Disposition
    from fgtrack.core.types import EgoState as EgoState
    from fgtrack.core.types import FloatArray as FloatArray
    from fgtrack.core.types import IntArray as IntArray
    from fgtrack.core.types import Message as Message
    from fgtrack.core.types import Revision as Revision
    from fgtrack.core.types import SmoothedReport as SmoothedReport
    from fgtrack.core.types import TickReport as TickReport
    from fgtrack.core.types import TrackReport as TrackReport
    from fgtrack.core.types import TrackState as TrackState
    from fgtrack.core.types import TrackStatus as TrackStatus
    from fgtrack.core.types import TruthState as TruthState
    from fgtrack.core.types import UpdateRecord as UpdateRecord
    from fgtrack.estimation.base import Estimator as Estimator
    from fgtrack.estimation.base import Measurement as Measurement
    from fgtrack.estimation.base import Start as Start
    from fgtrack.estimation.base import StatesAt as StatesAt
    from fgtrack.estimation.base import TrackBank as TrackBank
    from fgtrack.estimation.base import UpdateResult as UpdateResult
    from fgtrack.estimation.base import UpdateStatus as UpdateStatus
    from fgtrack.estimation.birth import initial_state as initial_state
    from fgtrack.estimation.filters.ekf import robust_weight as robust_weight
    from fgtrack.estimation.registry import estimator as estimator
    from fgtrack.estimation.registry import estimator_claims as estimator_claims
    from fgtrack.estimation.registry import list_estimators as list_estimators
    from fgtrack.estimation.smoothing.bank import SmootherBank as SmootherBank
    from fgtrack.estimation.smoothing.gtsam.batch import BatchBank as BatchBank
    from fgtrack.estimation.smoothing.gtsam.batch import BatchSolver as BatchSolver
    from fgtrack.estimation.smoothing.gtsam.factors import (
        measurement_factor as measurement_factor,
    )
    from fgtrack.estimation.smoothing.gtsam.factors import (
        motion_factor as motion_factor,
    )
    from fgtrack.estimation.smoothing.window import Window as Window
    from fgtrack.evaluation.bounds import ScheduledMeasurement as ScheduledMeasurement
    from fgtrack.evaluation.bounds import bounds as bounds
    from fgtrack.evaluation.bounds import bounds_along as bounds_along
    from fgtrack.evaluation.metrics import evaluate as evaluate
    from fgtrack.evaluation.tables import Tables as Tables
    from fgtrack.evaluation.tables.compare import compare as compare
    from fgtrack.inputs.formats.common import ObjectList as ObjectList
    from fgtrack.inputs.recording import write_recording as write_recording
    from fgtrack.inputs.source import FileFormat as FileFormat
    from fgtrack.inputs.source import open_input as open_input
    from fgtrack.meaning.decision import Decision as Decision
    from fgtrack.meaning.draft import Draft as Draft
    from fgtrack.meaning.mounts import MountEstimate as MountEstimate
    from fgtrack.meaning.mounts import Mounts as Mounts
    from fgtrack.meaning.public import draft as draft
    from fgtrack.meaning.public import mounts as mounts
    from fgtrack.models.measurement import MeasurementModel as MeasurementModel
    from fgtrack.models.measurement import SensorPose as SensorPose
    from fgtrack.models.measurement import measured_position as measured_position
    from fgtrack.models.measurement import measurement_model as measurement_model
    from fgtrack.models.motion import CT as CT
    from fgtrack.models.motion import CTRA as CTRA
    from fgtrack.models.motion import CTRV as CTRV
    from fgtrack.models.motion import CV as CV
    from fgtrack.models.motion import MotionModel as MotionModel
    from fgtrack.models.sensors import RobustLoss as RobustLoss
    from fgtrack.models.sensors import SensorModel as SensorModel
    from fgtrack.noise.parameters import TuneReport as TuneReport
    from fgtrack.noise.tune import tune as tune
    from fgtrack.pipeline.health import Health as Health
    from fgtrack.pipeline.health import HealthLimits as HealthLimits
    from fgtrack.pipeline.health import HealthState as HealthState
    from fgtrack.pipeline.health import Nis as Nis
    from fgtrack.pipeline.health import Revised as Revised
    from fgtrack.pipeline.health import SensorHealth as SensorHealth
    from fgtrack.pipeline.live import Checkpoint as Checkpoint
    from fgtrack.pipeline.live import Tracker as Tracker
    from fgtrack.pipeline.live_statistics import Lateness as Lateness
    from fgtrack.pipeline.live_statistics import TickTiming as TickTiming
    from fgtrack.pipeline.public import replay as replay
    from fgtrack.pipeline.public import simulate as simulate
    from fgtrack.pipeline.scored_sweep import sweep as sweep
    from fgtrack.ranking.public import rank as rank
    from fgtrack.ranking.result import Ranking as Ranking
    from fgtrack.recording_study import Study as Study
    from fgtrack.recording_study import study as study
    from fgtrack.runs import Run as Run
    from fgtrack.runs import load_run as load_run
    from fgtrack.show.figures import plot as plot
    from fgtrack.show.figures.late_detection import close_ups as close_ups

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
