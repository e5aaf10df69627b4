"""Status and existence of the tracks that the decisions hold."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar

import numpy as np

from fgtrack.core.state import Stateful
from fgtrack.core.time import seconds
from fgtrack.core.types import IntArray, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.tracking.decisions.history import Doubt
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.lives.existence import ExistenceRules
from fgtrack.tracking.lives.latency import FOREVER
from fgtrack.tracking.preprocess import Candidate, Candidates


class Life:
    """Existence of one track after the newest list."""

    __slots__ = (
        "doubt",
        "exists",
        "hazard_hz",
        "is_coasting",
        "is_confirmed",
        "stamp_ns",
    )

    def __init__(
        self,
        exists: float,
        stamp_ns: int,
        hazard_hz: float,
        is_confirmed: bool,
        is_coasting: bool,
        doubt: Doubt | None = None,
    ) -> None:
        self.exists, self.stamp_ns, self.hazard_hz = exists, stamp_ns, hazard_hz
        self.is_confirmed, self.is_coasting = is_confirmed, is_coasting
        self.doubt = doubt

    def at(self, stamp_ns: int) -> float:
        """Return the probability that the object exists at a stamp."""
        dt_s = max(seconds(stamp_ns - self.stamp_ns), 0.0)
        return self.exists * math.exp(-self.hazard_hz * dt_s)


class DecidedLives(Stateful):
    """Lives of the tracks according to the decisions; see `fgtrack.tracking.lives.existence` for the other methods."""

    STATE: ClassVar[tuple[str, ...]] = (
        "lives",
        "_present_ns",
        "_known_ns",
        "_processed_ns",
        "_watermarks_ns",
        "_ended",
        "_confirmed",
    )

    birth_probability = 0.5

    def __init__(self, rules: ExistenceRules) -> None:
        self._rules = rules
        self.lives: dict[int, Life] = {}
        """By track."""
        self._confirmed = set[int]()
        """Tracks that were confirmed when their life was last known."""
        self._ended: dict[int, int] = {}
        """Tracks that have ended, and may come back by a late list."""
        self._present_ns = self._known_ns = 0
        self._processed_ns = FOREVER
        self._watermarks_ns: IntArray | None = None

    @property
    def doubt_probability(self) -> float:
        """Probability below which a confirmed track is doubted."""
        return self._rules.doubt_probability

    def suspend(self, track_id: int, stamp_ns: int) -> None:
        """Note that a track has ended with the list at `stamp_ns`, and may come back."""
        self._ended.setdefault(track_id, stamp_ns)
        self.lives.pop(track_id, None)

    def live(self, track_id: int, life: Life) -> None:
        """Note the life of a track."""
        self.lives[track_id] = life
        if life.is_confirmed:
            self._confirmed.add(track_id)
        else:
            self._confirmed.discard(track_id)
        self._ended.pop(track_id, None)

    def was_confirmed(self, track_id: int) -> bool:
        """True for a track that was confirmed when its life was last known."""
        return track_id in self._confirmed

    def unconfirm(self, track_id: int) -> None:
        """Note that a track has lost a detection, so an earlier confirmation does not count."""
        self._confirmed.discard(track_id)

    def is_suspended(self, track_id: int) -> bool:
        """True for a track that has ended, and may come back."""
        return track_id in self._ended

    def ended_before(self, oldest_ns: int) -> list[int]:
        """Return the tracks that ended before `oldest_ns`."""
        return [i for i, stamp_ns in self._ended.items() if stamp_ns < oldest_ns]

    def born(self, track_id: int, scan: Scan, candidate: Candidate) -> None:
        """Nothing is to do: the decisions contain the birth."""

    def matched(
        self,
        scan: Scan,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        states: StatesAt,
    ) -> None:
        """Nothing is to do: the decisions contain the match."""

    def fused(self, track_ids: Iterable[int]) -> None:
        """Nothing is to do: the decisions contain the match."""

    def expired(
        self,
        present_ns: int,
        watermarks_ns: IntArray | None = None,
        processed_ns: int = FOREVER,
    ) -> list[int]:
        """Suspend the tracks that have become improbable without any list: a late list may still show them."""
        self._present_ns = present_ns
        known_ns = present_ns
        if watermarks_ns is not None and len(watermarks_ns):
            known_ns = min(known_ns, int(watermarks_ns.min()))
        self._known_ns = min(known_ns, processed_ns)
        self._processed_ns, self._watermarks_ns = processed_ns, watermarks_ns
        least = self._rules.delete_probability
        for each in [
            i for i, life in self.lives.items() if life.at(self._known_ns) < least
        ]:
            self.suspend(each, self._known_ns)
        return []

    def suspended(self, stamp_ns: int | None = None) -> frozenset[int]:
        """Return the tracks that are not published."""
        return frozenset(self._ended)

    def existing(self, track_ids: Sequence[int], stamp_ns: int) -> np.ndarray:
        """Return the probabilities that objects exist at a stamp."""
        return np.array([self.lives[i].at(stamp_ns) for i in track_ids])

    def forget(self, track_id: int) -> None:
        """Forget a track."""
        self.lives.pop(track_id, None)
        self._ended.pop(track_id, None)
        self._confirmed.discard(track_id)

    def reported(
        self, track_ids: Sequence[int]
    ) -> tuple[list[TrackStatus], Sequence[float | None]]:
        """Return status and probability of existence of tracks at present."""
        statuses, probabilities = [], []
        for each in track_ids:
            life = self.lives.get(each)
            exists = 0.0 if life is None else life.at(self._present_ns)
            probabilities.append(exists)
            if life is None or not life.is_confirmed or self._is_doubted(life):
                statuses.append(TrackStatus.TENTATIVE)
            elif life.is_coasting:
                statuses.append(TrackStatus.COASTING)
            else:
                statuses.append(TrackStatus.CONFIRMED)
        return statuses, probabilities

    def _is_doubted(self, life: Life) -> bool:
        """True for a track that is improbable, whatever the lists that are still due show.

        So a late sensor does not make its tracks tentative.
        """
        if life.doubt is None:
            return life.at(self._known_ns) < self._rules.doubt_probability
        known_ns = min(self._present_ns, self._processed_ns)
        if self._watermarks_ns is not None and life.doubt.awaited.any():
            due_ns = self._watermarks_ns[life.doubt.awaited].min()
            known_ns = min(known_ns, int(due_ns))
        return known_ns >= life.doubt.since_ns


Lives = Mapping[int, Life]
