"""What decides a fit of noise, and the configuration that it replays with."""

from dataclasses import dataclass, field, replace

from fgtrack.estimation.likelihood.fit import FitSettings
from fgtrack.pipeline.config import Config
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis


@dataclass(frozen=True)
class TuneRules:
    """Which tracks count, and when a parameter is known."""

    fit: FitSettings = field(default_factory=FitSettings)
    keep: tuple[str, ...] = ()
    """Keys of the configuration that stay as they are."""
    train_share: float = 0.7
    """Part of the time of each recording, from its start, that the noise which is judged is fitted to; 1: no part is
    left to judge it by."""
    max_rounds: int = 4
    """How often detections are associated at most."""
    settled: float = 0.2
    """Rounds end where no parameter moves by more than this share of its standard deviation."""
    min_observations: int = 20
    """Shorter tracks are left out: most of them are clutter."""
    max_observations: int | None = None
    """Longer tracks are cut to so many measurements; null: none is."""
    min_count: int = 30
    """Measured components that a parameter needs at least."""
    known_std_error: float = 0.05
    """A parameter is known where its standard error is below this share of it: three of them are 15 %, ..."""
    rough_std_error: float = 0.5
    """... and not known where it is above this."""
    rejected: float = 1.92
    """A value is rejected by the data where the log-likelihood is lower by this: a 95 % interval."""
    gate_probability: float = 0.9999
    """A narrower chi-square gate is opened to this: what it cuts off would be missing in the noise."""
    gate_stds: float = 4.0
    """A gate in metres is opened to so many standard deviations, for the same reason."""
    start_factor: float = 5.0
    """Further starts have a motion noise larger, and smaller, by this."""
    start_observations: int = 200
    """Part of a track that is used to compare starts."""
    start_tracks: int = 3
    """The number of these tracks."""


def for_tuning(config: Config, rules: TuneRules) -> Config:
    """The configuration with an estimator that keeps late data, and a gate that does not cut off the noise."""
    association = config.association
    if isinstance(association, GatedMahalanobis):
        probability = max(association.gate_probability, rules.gate_probability)
        association = replace(association, gate_probability=probability)
    return replace(config, estimator="ekf-replay", association=association)


def widened(config: Config, rules: TuneRules) -> Config:
    """The configuration with a gate of so many standard deviations of the position of the least precise sensor."""
    axes = ("x_m", "y_m", "range_m")
    needed_m = rules.gate_stds * max(
        [0.0, *(one.std[name] for one in config.used_sensors.values() for name in axes if name in one.std)]
    )
    association = config.association
    if isinstance(association, GatedEuclidean):
        return replace(config, association=replace(association, gate_m=max(association.gate_m, needed_m)))
    if isinstance(association, GatedMahalanobis):
        limit_m = max(association.max_distance_m, needed_m)
        return replace(config, association=replace(association, max_distance_m=limit_m))
    return config
