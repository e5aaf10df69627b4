"""Track several objects from the delayed object lists of several sensors, and compare how delays are dealt with.

Everything that a user imports is here, loaded when it is first used; the subpackages are private.
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

__version__ = "0.2.0.dev0"

if TYPE_CHECKING:
    from fgtrack import testing as testing
    from fgtrack.advice.advise import advise as advise
    from fgtrack.advice.page import Advice as Advice
    from fgtrack.core.errors import CallError as CallError
    from fgtrack.core.errors import DataError as DataError
    from fgtrack.core.errors import FgtrackError as FgtrackError
    from fgtrack.core.types import Detection as Detection
    from fgtrack.core.types import DetectionList as DetectionList
    from fgtrack.core.types import Disposition as Disposition
    from fgtrack.core.types import EgoState as EgoState
    from fgtrack.core.types import Message as Message
    from fgtrack.core.types import SmoothedReport as SmoothedReport
    from fgtrack.core.types import TickReport as TickReport
    from fgtrack.core.types import TrackReport as TrackReport
    from fgtrack.core.types import TrackState as TrackState
    from fgtrack.core.types import TruthState as TruthState
    from fgtrack.core.types import UpdateRecord as UpdateRecord
    from fgtrack.estimation import starts as starts
    from fgtrack.estimation.base import Estimator as Estimator
    from fgtrack.estimation.base import Measurement as Measurement
    from fgtrack.estimation.base import Start as Start
    from fgtrack.estimation.base import StatesAt as StatesAt
    from fgtrack.estimation.base import TrackBank as TrackBank
    from fgtrack.estimation.base import UpdateResult as UpdateResult
    from fgtrack.estimation.base import UpdateStatus as UpdateStatus
    from fgtrack.estimation.birth import initial_state as initial_state
    from fgtrack.estimation.ekf import robust_weight as robust_weight
    from fgtrack.estimation.registry import estimator as estimator
    from fgtrack.evaluation import plot as plot
    from fgtrack.evaluation.comparison import compare as compare
    from fgtrack.evaluation.tables import Tables as Tables
    from fgtrack.io.adapters.common import ObjectList as ObjectList
    from fgtrack.io.run import Run as Run
    from fgtrack.io.run import load_run as load_run
    from fgtrack.models.measurement import MeasurementModel as MeasurementModel
    from fgtrack.models.measurement import SensorPose as SensorPose
    from fgtrack.models.measurement import measurement_model as measurement_model
    from fgtrack.models.motion import CTRA as CTRA
    from fgtrack.models.motion import CTRV as CTRV
    from fgtrack.models.motion import CV as CV
    from fgtrack.models.motion import MotionModel as MotionModel
    from fgtrack.models.sensors import RobustLoss as RobustLoss
    from fgtrack.models.sensors import SensorModel as SensorModel
    from fgtrack.pipeline.close_up import close_ups as close_ups
    from fgtrack.pipeline.config import Config as Config
    from fgtrack.pipeline.lateness import Lateness as Lateness
    from fgtrack.pipeline.lateness import TickTiming as TickTiming
    from fgtrack.pipeline.live import Tracker as Tracker
    from fgtrack.pipeline.live import TrackOutput as TrackOutput
    from fgtrack.pipeline.live import TracksAt as TracksAt
    from fgtrack.pipeline.public import replay as replay
    from fgtrack.pipeline.public import simulate as simulate
    from fgtrack.pipeline.tune import tune as tune
    from fgtrack.pipeline.tune_report import TuneReport as TuneReport

# The imports above are for type checkers and are the one list of public names: where each name is at home.
_HOMES = {
    alias.asname: (node.module, alias.name)
    for node in ast.walk(ast.parse(Path(__file__).read_text(encoding="utf-8")))
    if isinstance(node, ast.ImportFrom) and node.module is not None
    for alias in node.names
    if alias.asname is not None
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'fgtrack' has no attribute {name!r}")
    module_name, attribute = _HOMES[name]
    known = vars(import_module(module_name))
    value = known[attribute] if attribute in known else import_module(f"{module_name}.{attribute}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*_HOMES, "__version__"])
