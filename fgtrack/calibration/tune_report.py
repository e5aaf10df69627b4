"""What tuning has found: parameters with their standard errors, and how well they fit what they were not fitted to."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

from fgtrack.io.run import Run
from fgtrack.pipeline.config import Config

Known = Literal["yes", "roughly", "limit", "no"]


@dataclass(frozen=True)
class TunedParameter:
    """One standard deviation."""

    key: str
    """Key of the configuration."""
    configured: float
    tuned: float
    """As configured where it is not known."""
    std_error: float | None
    """Standard error as a share of the value; None where there is none."""
    known: Known
    """`yes`: `std_error` is at most `TuneRules.known_std_error`; `roughly`: at most `rough_std_error`, and adopted too;
    `limit`: only a limit is known, and the configured value lies beyond it, so that the limit is adopted; `no`: the
    configured value stays."""
    why: str
    """Why it is not known; empty where it is."""

    @property
    def identifiable(self) -> bool:
        """Whether it is known: `yes`."""
        return self.known == "yes"


@dataclass(frozen=True)
class SensorNoise:
    """What else was found of one sensor."""

    sensor: str
    count: int
    """Innovations that counted."""
    own_covariance: int
    """Those of detections with a covariance of their own, to which the standard deviations do not apply."""
    outlier_share: float | None
    """Share of measurements with larger errors; None where nothing counted."""


@dataclass(frozen=True)
class InnovationFit:
    """How innovations of one component compare with their covariance, on time held out."""

    sensor: str
    component: str
    count: int
    before: float
    """Mean of the squared innovation over its variance, expected 1, with the configured noise."""
    after: float
    """The same with the noise fitted to the rest of the time."""
    band: float
    """Half-width of the 95 % interval of that mean for independent innovations."""


@dataclass(frozen=True)
class HeldOut:
    """The last part of each recording, to which the noise that is judged was not fitted."""

    share: float
    """Share of the recorded time."""
    count: int
    """Innovations."""
    before: float
    """Log-likelihood per innovation with the configured noise."""
    after: float
    """With the noise fitted to the rest."""
    innovations: tuple[InnovationFit, ...]
    from_ns: tuple[int, ...]
    """Where it begins in each recording."""
    runs_before: tuple[Run, ...] = field(repr=False)
    """Runs with the configured noise, of the estimator `ekf-replay`, one for each recording."""
    runs_after: tuple[Run, ...] = field(repr=False)
    """Runs with the noise fitted to the rest."""


@dataclass(frozen=True)
class TuneReport:
    """Noise fitted to recordings."""

    config: Config
    """The tuned configuration."""
    parameters: tuple[TunedParameter, ...]
    sensors: tuple[SensorNoise, ...]
    held_out: HeldOut | None
    """None where too little is left to judge."""
    log_likelihood: float
    """Per innovation, of all of them, with the tuned noise."""
    count: int
    """Innovations that counted in the final fit."""
    num_tracks: int
    """Tracks they belong to."""
    num_mixed: int
    """Measurements that were left out, because most of those around them are outliers; see `without_mixed`."""
    rounds: int
    """How often detections were associated."""
    optima: int
    """Different maxima of the likelihood found from several starts; the highest one is reported."""
    settled: bool
    """Whether another association would have changed nothing any more."""
    broken: Mapping[str, str]
    """Why a recording broke off, by its name; what came before was used."""

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON, without the runs."""
        values: dict[str, object] = {
            "parameters": [{**asdict(one), "identifiable": one.identifiable} for one in self.parameters],
            "sensors": [asdict(one) for one in self.sensors],
            "held_out": None,
        }
        names = ("log_likelihood", "count", "num_tracks", "num_mixed", "rounds", "optima", "settled")
        values |= {name: getattr(self, name) for name in names}
        values["broken"] = dict(self.broken)
        if self.held_out is not None:
            kept = ("share", "count", "before", "after", "from_ns")
            values["held_out"] = {name: getattr(self.held_out, name) for name in kept} | {
                "innovations": [asdict(one) for one in self.held_out.innovations]
            }
        return values
