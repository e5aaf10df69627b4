"""Numbers of the decisions."""

from collections.abc import Mapping
from dataclasses import dataclass

from fgtrack.models.motion import MotionModel
from fgtrack.tracking.decisions.second_returns import Returns
from fgtrack.tracking.decisions.unseen import BirthPrior
from fgtrack.tracking.lives.latency import Views


@dataclass(frozen=True)
class Rules:
    """Numbers of the decisions."""

    motion: MotionModel
    views: Views
    most: int
    lifetime_s: float
    visible_share: float
    visible_s: float
    out_of_view_s: float
    hidden_s: float
    least_existence: float
    confirm_probability: float
    birth_odds: float
    min_travel_m: float
    speed_std_mps: float
    returns: Mapping[int, Returns]
    """Second returns, by sensor."""
    prior: BirthPrior | None = None
