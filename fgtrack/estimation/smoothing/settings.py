"""Settings of the fixed-lag smoothers."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np

from fgtrack.core.checks import not_negative
from fgtrack.core.errors import CallError
from fgtrack.core.types import FloatArray
from fgtrack.models.motion import MotionModel

_NEVER = 1e9
_RELINEARISE = {
    "yaw_rad": 0.02,
    "speed_mps": 1.0,
    "yaw_rate_radps": 0.05,
    "accel_mps2": 1.0,
}
_NONLINEAR = {"x_m": 0.05, "y_m": 0.05, "vx_mps": 0.2, "vy_mps": 0.2}


@dataclass(frozen=True)
class SmootherSettings:
    """Window, late policy, relinearisation and outputs of a fixed-lag smoother."""

    lag_s: float = 1.0
    """Length of the window behind the newest stamp of the track, or the clock."""
    late: Literal["fuse", "drop"] = "fuse"
    """Treatment of a detection older than the window. `fuse`: it is fused exactly, through the marginalised states
    (counted as `beyond_window`). `drop`: it is dropped (`too_old`).
    """
    ring_s: float = 2.0
    """Time behind the window within which `fuse` applies; older detections are `too_old`."""
    relinearise: Mapping[str, float] = field(default_factory=_RELINEARISE.copy)
    """Thresholds by entry of the state. An entry that moved farther from its linearisation point is relinearised.
    Half of the threshold applies before a state leaves the window, a quarter if the state is re-solved anyway. See
    `thresholds` for entries that are not named.
    """
    max_iterations: int = 1
    """Largest number of Gauss-Newton steps per update. Further steps are taken only while a state moves."""
    lagged_s: tuple[float, ...] = (0.3,)
    """Lags of the lagged output; smoothed.csv has the first lag."""
    final: bool = True
    """True if the smoothed state of a node is reported when the node leaves the window."""

    def __post_init__(self) -> None:
        not_negative(lag_s=self.lag_s, ring_s=self.ring_s)
        if not 1 <= self.max_iterations <= 100:
            raise ValueError(
                f"max_iterations: must lie between 1 and 100, is {self.max_iterations}"
            )
        not_negative(
            **{f"relinearise.{name}": value for name, value in self.relinearise.items()}
        )
        if any(not 0.0 <= lag_s <= self.lag_s for lag_s in self.lagged_s):
            raise ValueError(
                f"lagged_s: must lie between 0 and lag_s = {self.lag_s}, is {list(self.lagged_s)}"
            )
        if len(set(self.lagged_s)) < len(self.lagged_s):
            raise ValueError(f"lagged_s: names a lag twice, is {list(self.lagged_s)}")

    @property
    def behind_s(self) -> float:
        """Time behind the window within which detections are still fused."""
        return self.ring_s if self.late == "fuse" else 0.0

    @classmethod
    def of_options(cls, lag_s: float, options: Mapping[str, Any]) -> "SmootherSettings":
        """Return settings for the options of an estimator; by default no lagged and no final states are
        reported.

        Raises `CallError` for an unknown option.
        """
        taken = [each.name for each in fields(cls)]
        if unknown := set(options).difference(taken):
            raise CallError(
                f"unknown option {min(unknown)!r}; its options are {', '.join(taken[1:])}, initiation"
            )
        return cls(lag_s=lag_s, **{"lagged_s": (), "final": False, **options})

    def thresholds(self, motion: MotionModel, nonlinear: bool) -> FloatArray:
        """Return the threshold of each state entry for a relinearisation, shape (n,).

        An entry without a threshold is never relinearised; its value is 1e9. `nonlinear` is True if a measurement is
        nonlinear or has a robust loss. Motion models are linear in the position, so the position has a threshold only
        then. If everything is linear, no entry has a threshold.
        """
        named = (
            {**_NONLINEAR, **self.relinearise}
            if nonlinear
            else {}
            if motion.linear
            else self.relinearise
        )
        return np.array([named.get(name, _NEVER) for name in motion.state_names])
