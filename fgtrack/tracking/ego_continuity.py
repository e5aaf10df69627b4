"""Consistency of successive ego states with their own speeds."""

import math
from collections.abc import Sequence

from fgtrack.core.time import seconds
from fgtrack.core.types import EgoState

__all__ = ["CONTRADICTS", "Continuity"]

CONTRADICTS = "contradicts its neighbours"
_LONGEST_S = 1.0
_SLACK_M = 2.0
_SHARE = 0.5
_SIGMAS = 3.0


class Continuity:
    """Holds back a state that contradicts the one before it, until the next one tells which of the two is wrong.

    A stamp that is half a second off puts the ego tens of metres from where it was, and with it all that is seen from
    it. Two states contradict each other where the way between them differs from that at their speeds by more than half
    of it, by 2 m, and by three standard deviations of their positions as far as they say them. What is more than 1 s
    apart says nothing. A single state that contradicts both neighbours is left out; where the states go on from it,
    the ego has jumped, and is followed. States that never fit, of an ego that does not know its speed, are all taken.
    """

    def __init__(self) -> None:
        self.jumps = 0
        """Places at which states went on elsewhere."""
        self._last: EgoState | None = None
        self._held: EgoState | None = None
        self._fits = False  # whether the last two did

    def judged(self, ego: EgoState) -> tuple[Sequence[EgoState], str | None]:
        """Return the states to take now, in their order, and the reason if the one held back is left out."""
        last, held = self._last, self._held
        self._held = None
        if last is None or _fit(last, ego):
            self._fits = last is not None
            self._last = ego
            return (ego,), None if held is None else CONTRADICTS
        if held is None and self._fits:
            self._held = ego
            return (), None
        self._last = ego
        if held is None:
            return (ego,), None
        self._fits = _fit(held, ego)
        self.jumps += self._fits
        return (held, ego), None


def _fit(before: EgoState, after: EgoState) -> bool:
    dt_s = seconds(after.stamp_ns - before.stamp_ns)
    if abs(dt_s) > _LONGEST_S:
        return True
    travelled_m = 0.5 * (before.speed_mps + after.speed_mps) * dt_s
    off_m = math.hypot(
        after.x_m - before.x_m - travelled_m * math.cos(before.yaw_rad),
        after.y_m - before.y_m - travelled_m * math.sin(before.yaw_rad),
    )
    if off_m <= _SLACK_M:  # as nearly always
        return True
    return off_m <= _SLACK_M + _SHARE * abs(travelled_m) + _SIGMAS * math.sqrt(_variance(before) + _variance(after))


def _variance(ego: EgoState) -> float:
    """Variance of x and y together, 0 where the state has none; covariances are in the order of `EgoPose`."""
    return 0.0 if ego.covariance is None else max(ego.covariance[0] + ego.covariance[6], 0.0)
