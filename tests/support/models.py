"""All registered motion models, with their default parameters."""

from fgtrack.estimation.registry import MOTION_MODELS
from fgtrack.models.motion import MotionModel

MOTIONS: dict[str, MotionModel] = {
    kind: MOTION_MODELS.load(kind)() for kind in MOTION_MODELS
}
MODELS = tuple(MOTIONS.values())
