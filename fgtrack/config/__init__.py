"""The configuration of a run: its settings with their defaults, YAML files, and configurations that are shipped."""

from fgtrack.config.settings import (
    NOISE_HZ,
    SMOOTHERS,
    ClockConfig,
    Config,
    Defect,
    Effective,
    EgoConfig,
    FilterConfig,
    InitiationConfig,
    MapConfig,
    MotionConfig,
)

__all__ = [
    "NOISE_HZ",
    "SMOOTHERS",
    "ClockConfig",
    "Config",
    "Defect",
    "Effective",
    "EgoConfig",
    "FilterConfig",
    "InitiationConfig",
    "MapConfig",
    "MotionConfig",
]
