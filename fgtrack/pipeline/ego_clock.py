"""Jumps of the clock of the ego's stamps."""

from fgtrack.core.errors import DataError
from fgtrack.core.time import seconds
from fgtrack.core.types import EgoState
from fgtrack.tracking.ego import LARGEST_STEP_BACK_S

__all__ = ["EgoClock"]

_FEWEST = 3
_LONGEST_S = 1.0


class EgoClock:
    """Tells a stray stamp, which the tracker refuses, from a clock that was set, after which nothing fits together.

    A jump lasts where no state between fits the old clock, for at least three states and one second of receipts: back
    as where a recording starts over, or ahead of the receipts by more than it was before.
    """

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._fitting = 0
        self._strays = 0  # in a row
        self._first_ns = 0
        self._jump = ""

    def check(self, ego: EgoState) -> None:
        """Look at the next state in order of receipt. Raises `DataError` once a jump has lasted."""
        if self._newest_ns is None:
            self._newest_ns = ego.stamp_ns
        back_s = seconds(self._newest_ns - ego.stamp_ns)
        ahead_s = seconds(ego.stamp_ns - max(self._newest_ns, ego.receipt_ns))
        if max(back_s, ahead_s) <= LARGEST_STEP_BACK_S:
            self._newest_ns = max(self._newest_ns, ego.stamp_ns)
            self._fitting += 1
            self._strays = 0
            return
        if not self._strays:
            self._first_ns = ego.receipt_ns
            self._jump = (
                f"back by {back_s:g} s at receipt {ego.receipt_ns} ns and stay there, as in a looping recording"
                if back_s > 0.0
                else f"ahead by {ahead_s:g} s at receipt {ego.receipt_ns} ns and stay there, as where a clock is set"
            )
        self._strays += 1
        if self._strays < _FEWEST:
            return
        if self._fitting < 2:
            self._newest_ns, self._fitting, self._strays = ego.stamp_ns, self._strays, 0
        elif seconds(ego.receipt_ns - self._first_ns) >= _LONGEST_S:
            raise DataError(f"ego stamps jump {self._jump}: cut it there")
