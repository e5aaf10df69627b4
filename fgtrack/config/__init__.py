"""The configuration of a run: settings with defaults, YAML files, and shipped configurations.

The names below are public.
"""

from fgtrack.config.motion import NOISE_HZ, InitiationConfig, MotionConfig
from fgtrack.config.settings import (
    SMOOTHERS,
    ClockConfig,
    Config,
    Defect,
    Effective,
    EgoConfig,
    FilterConfig,
    MapConfig,
)
from fgtrack.models.sensors import Correlation, Filter, Mount, Score
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.birth import Birth
from fgtrack.tracking.lives.existence import ExistenceRules

__all__ = [
    "Birth",
    "ClockConfig",
    "Config",
    "Correlation",
    "Defect",
    "Effective",
    "EgoConfig",
    "ExistenceRules",
    "Filter",
    "FilterConfig",
    "GatedEuclidean",
    "GatedMahalanobis",
    "InitiationConfig",
    "MapConfig",
    "MotionConfig",
    "Mount",
    "NOISE_HZ",
    "SMOOTHERS",
    "Score",
]
