"""Fronts of tracks from yaws that are read again after late lists: the result follows the order of stamps."""

from bisect import bisect_left
from collections.abc import Iterable
from operator import itemgetter
from typing import ClassVar

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.tracking.facing import MEMORY, Facing, shares_of

_stamp = itemgetter(0)


class StampedFacing(Facing):
    """Belief about the front of each track. It does not depend on the order of arrival.

    A yaw is read with the older detections of its track, and with the shares of wrong yaws of its sensor. At each
    stamp, these shares are learned only from lists that are older than the stamp by more than the horizon. Late lists
    cannot change these older lists.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *Facing.STATE,
        "_noted",
        "_settled",
        "_stamp_ns",
    )

    def __init__(self, cartesian: bool, horizon_ns: int) -> None:
        """`horizon_ns` is the time after which no late list changes the decisions about a list."""
        super().__init__(cartesian)
        self._horizon_ns = horizon_ns
        # Probabilities that a yaw is flipped, or wrong otherwise, by sensor and stamp, and by index of the candidate.
        self._noted: dict[tuple[str, int], dict[int, tuple[float, float]]] = {}
        # By sensor, the stamp of each list that is decided for good. Each stamp has the numbers of right, flipped and
        # other yaws up to this list.
        self._settled: dict[str, list[tuple[int, FloatArray]]] = {}
        self._stamp_ns = 0

    def turn_to(self, stamp_ns: int) -> None:
        """Use the shares of wrong yaws at `stamp_ns` for the next readings."""
        self._stamp_ns = stamp_ns

    def belief(self, track_id: int) -> tuple[float, int]:
        """Return the log-odds of the front of a track, and their stamp."""
        row = self._rows[track_id]
        return float(self._log_odds[row]), int(self._stamps_ns[row])

    def believe(self, track_id: int, belief: tuple[float, int]) -> None:
        """Restore an earlier `belief` about the front of a track."""
        row = self._rows[track_id]
        self._log_odds[row], self._stamps_ns[row] = belief
        self._least_log_odds = None

    def settle(self, sensor: str, stamp_ns: int, chosen: Iterable[int]) -> None:
        """Learn the shares of wrong yaws of `sensor` from a list that no late list can change any more.

        `chosen` are the indices of the candidates that belong to tracks; the others are not counted.
        """
        noted = self._noted.pop((sensor, stamp_ns), None)
        if noted is None:
            return
        history = self._settled.setdefault(sensor, [])
        seen = history[-1][1] if history else np.zeros(3)
        for position in chosen:
            if position in noted:
                flipped, other = noted[position]
                kept = min(1.0, MEMORY / (float(seen.sum()) + 1.0))
                seen = kept * seen + [1.0 - flipped - other, flipped, other]
        history.append((stamp_ns, seen))
        oldest_ns = stamp_ns - 2 * self._horizon_ns
        while len(history) > 1 and history[1][0] < oldest_ns:
            history.pop(0)

    def _shares_of(self, sensor: str) -> FloatArray:
        """See `Facing._shares_of`."""
        history = self._settled.get(sensor, [])
        row = bisect_left(history, self._stamp_ns - self._horizon_ns, key=_stamp)
        return shares_of(history[row - 1][1] if row else np.zeros(3))

    def _is_new(
        self, sensor: str, stamp_ns: int, candidates: IntArray, evidence: FloatArray
    ) -> bool:
        """See `Facing._is_new`. A yaw that is read once more is counted once."""
        noted = self._noted.setdefault((sensor, stamp_ns), {})
        is_new = not noted.keys() >= set(candidates.tolist())
        for position, (_, flipped, other) in zip(
            candidates.tolist(), evidence.tolist(), strict=True
        ):
            noted[position] = flipped, other
        return is_new
