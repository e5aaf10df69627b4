"""The best assignments of candidates to tracks, in the order of their likelihood."""

import heapq
import math
from bisect import insort
from collections.abc import Iterator, Sequence
from itertools import count
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import FloatArray, IntArray

LARGEST_LOSS = 9.2
"""An assignment is left out if it is less likely than the best one by a factor of exp(9.2), about 10,000."""
NONE = -1
"""Candidate of a track that is missed."""
_KERNELS = "fgtrack.tracking.decisions.assignment_kernels"
_FREE, _BLOCKED = -1, -2
_ROUNDING = 1e-9


class Gains(NamedTuple):
    """Log-likelihood ratios of pairs of tracks and candidates to missed tracks. Track i has the pairs `first[i]` to
    `first[i + 1]`.
    """

    first: IntArray
    """Shape (n + 1,)."""
    candidates: IntArray
    """Candidate of each pair, shape (p,)."""
    values: FloatArray
    """Log-likelihood ratio of each pair, shape (p,)."""
    num_candidates: int

    @classmethod
    def of(
        cls,
        tracks: IntArray,
        candidates: IntArray,
        values: FloatArray,
        num_tracks: int,
        num_candidates: int,
    ) -> "Gains":
        """Return the gains of pairs in any order; the arrays have the shape (p,)."""
        order = np.lexsort((candidates, tracks))
        counts = np.bincount(tracks, minlength=num_tracks)
        first = np.concatenate([[0], np.cumsum(counts)])
        return cls(first, candidates[order], values[order], num_candidates)

    def at(self, rows: IntArray) -> "Gains":
        """Return the gains of the tracks in `rows`."""
        counts = np.diff(self.first)[rows]
        first = np.concatenate([[0], np.cumsum(counts)])
        chosen = np.arange(first[-1]) + np.repeat(self.first[rows] - first[:-1], counts)
        return Gains(
            first, self.candidates[chosen], self.values[chosen], self.num_candidates
        )


class Ranked(NamedTuple):
    """An assignment of one of several problems."""

    gain: float
    """Log-likelihood ratio to the assignment in which all tracks are missed, plus the gain of the problem."""
    problem: int
    """Number of the problem."""
    candidates: IntArray
    """Candidate of each track, `NONE` for a missed one, shape (n,)."""


def best_assignments(
    problems: Sequence[tuple[float, Gains]], most: int
) -> list[Ranked]:
    """Return at most `most` assignments of all `problems`, the best one first.

    `problems` are the gains of problems, and of pairs. Each track and each candidate of a problem is used at most
    once. Assignments that are less likely than the best one by more than `LARGEST_LOSS` are left out.
    """
    solved = [
        _Problem(number, gain, gains) for number, (gain, gains) in enumerate(problems)
    ]
    gains = sorted(each.best.gain for each in solved)  # of the best `most` solutions
    lowest = gains[-1] - LARGEST_LOSS
    numbers = count()  # the earlier of two equal gains comes first
    heap: list[tuple[float, int, _Problem, _Solution, int | None]] = [
        (-each.best.gain, next(numbers), each, each.best, None)
        for each in solved
        if each.best.gain >= lowest
    ]
    heapq.heapify(heap)
    found: list[Ranked] = []
    while heap and len(found) < most:
        _, _, problem, solution, position = heapq.heappop(heap)
        if position is None:
            found.append(problem.ranked(solution))
            if solution is problem.best:
                problem.restrict(lowest)
            least = _least(gains, most, lowest)
            for position, bound in problem.bounds(solution, least):
                entry = (-bound, next(numbers), problem, solution, position)
                heapq.heappush(heap, entry)
            continue
        branch = problem.branch(solution, position)
        if branch is not None and branch.gain >= _least(gains, most, lowest):
            insort(gains, branch.gain)
            heapq.heappush(heap, (-branch.gain, next(numbers), problem, branch, None))
    return found


def _least(gains: Sequence[float], most: int, lowest: float) -> float:
    """Return the gain of the last of the best `most` solutions, at least `lowest`. The `gains` of solutions ascend."""
    return max(lowest, gains[-most]) if len(gains) >= most else lowest


class _Solution(NamedTuple):
    """The best assignment among those with the same pairs for the first `decided` open tracks."""

    gain: float
    chosen: IntArray
    """Pair of each track, or `NONE`, shape (n,)."""
    decided: int
    excluded: tuple[int, ...]
    """Pairs that the open track number `decided` may not have; `NONE` excludes a miss."""


class _Problem:
    """Search for the best assignments.

    Source: Murty, "An algorithm for ranking all the assignments in order of increasing cost", Operations Research
    16(3), 1968. The prices of the best assignment bound the loss of each pair, so most tracks have one pair left.
    """

    def __init__(self, number: int, gain: float, gains: Gains) -> None:
        self._number, self._base, self._gains = number, gain, gains
        n = self._num_tracks = len(gains.first) - 1
        self._num_columns = gains.num_candidates + n
        self._costs = -gains.values
        self._lengths = np.full(self._num_columns, math.inf)
        self._work = np.zeros((4, self._num_columns), dtype=np.int64)
        self._is_allowed = np.ones(len(self._costs), dtype=bool)
        self._is_missable = np.ones(n, dtype=bool)
        self._prices = np.zeros(n), np.zeros(self._num_columns)
        chosen, holders = np.full(n, NONE), np.full(self._num_columns, _FREE)
        self._assign(np.arange(n), holders, chosen, *self._prices)
        self.best = _Solution(self._gain(chosen), chosen, 0, ())
        """The best assignment."""

    def ranked(self, solution: _Solution) -> Ranked:
        """Return a solution with candidates."""
        candidates = solution.chosen.copy()
        taken = candidates != NONE
        candidates[taken] = self._gains.candidates[candidates[taken]]
        return Ranked(solution.gain, self._number, candidates)

    def restrict(self, least: float) -> None:
        """Leave out the pairs whose assignments have gains below `least`; find the tracks that still have a choice."""
        n, m = self._num_tracks, self._gains.num_candidates
        row_prices, column_prices = self._prices
        limit = self.best.gain - least + _ROUNDING
        counts = np.diff(self._gains.first)
        owners = np.repeat(np.arange(n), counts)
        losses = (
            self._costs - row_prices[owners] - column_prices[self._gains.candidates]
        )
        missed_losses = -row_prices - column_prices[m:]
        self._is_allowed = losses <= limit
        self._is_missable = missed_losses <= limit
        kept = self._is_allowed.nonzero()[0]
        is_open = self._is_missable + np.bincount(owners[kept], minlength=n) > 1
        self._clusters = _clusters(owners[kept], self._gains.candidates[kept], n, m)
        order = np.argsort(self._clusters, kind="stable")
        self._open = order[is_open[order]]
        self._positions = np.full(n, len(order))
        self._positions[self._open] = np.arange(len(self._open))
        # The pair with the least loss of each track, and the least loss of another pair.
        every = np.full((n, 1 + int(counts.max(initial=0))), math.inf)
        of_pair = np.arange(len(losses)) - self._gains.first[owners]
        every[owners, of_pair] = np.where(self._is_allowed, losses, math.inf)
        every[:, -1] = missed_losses
        likeliest = every.argmin(axis=1)
        every[np.arange(n), likeliest] = math.inf
        is_missed = likeliest == every.shape[1] - 1
        self._likeliest = np.where(is_missed, NONE, self._gains.first[:-1] + likeliest)
        self._second_losses = every.min(axis=1, initial=math.inf)

    def bounds(self, solution: _Solution, least: float) -> Iterator[tuple[int, float]]:
        """Yield the open tracks that may have another pair than in `solution`, and an upper bound of the gain then.

        Bounds below `least` are left out.
        """
        tracks = self._open
        is_likeliest = solution.chosen[tracks] == self._likeliest[tracks]
        losses = np.where(is_likeliest, self._second_losses[tracks], 0.0)
        bounds = np.minimum(solution.gain, self.best.gain - losses)
        for position in (bounds >= least - _ROUNDING).nonzero()[0].tolist():
            if position >= solution.decided:
                yield position, float(bounds[position])

    def branch(self, parent: _Solution, position: int) -> _Solution | None:
        """Return the best assignment with the pairs of `parent` for the open tracks before `position`, and with
        another pair for the open track there; None without one.
        """
        track = int(self._open[position])
        own = int(parent.chosen[track])
        excluded = (*(parent.excluded if position == parent.decided else ()), own)
        members = (self._clusters == self._clusters[track]).nonzero()[0]
        is_decided = self._positions[members] < position
        chosen, holders = parent.chosen.copy(), np.full(self._num_columns, _FREE)
        pairs = chosen[members[is_decided]]
        holders[self._gains.candidates[pairs[pairs != NONE]]] = _BLOCKED
        changed = [pair for pair in excluded if pair != NONE]
        kept, is_missable = self._is_allowed[changed], self._is_missable[track]
        self._is_allowed[changed] = False
        self._is_missable[track] = is_missable and NONE not in excluded
        is_solved = self._assign(
            members[~is_decided],
            holders,
            chosen,
            np.zeros(self._num_tracks),
            np.zeros(self._num_columns),
        )
        self._is_allowed[changed], self._is_missable[track] = kept, is_missable
        if not is_solved:
            return None
        return _Solution(self._gain(chosen), chosen, position, excluded)

    def _assign(
        self,
        rows: IntArray,
        holders: IntArray,
        chosen: IntArray,
        row_prices: FloatArray,
        column_prices: FloatArray,
    ) -> bool:
        return bool(
            kernels(_KERNELS).assign(
                rows,
                self._gains.first,
                self._gains.candidates,
                self._costs,
                self._is_allowed,
                self._is_missable,
                holders,
                chosen,
                row_prices,
                column_prices,
                self._lengths,
                self._work,
            )
        )

    def _gain(self, chosen: IntArray) -> float:
        return self._base + float(self._gains.values[chosen[chosen != NONE]].sum())


def _clusters(
    tracks: IntArray, candidates: IntArray, num_tracks: int, num_candidates: int
) -> IntArray:
    """Return the number of the cluster of each track, shape (n,). Clusters share no candidate of the pairs (p,)."""
    labels = np.empty(num_tracks, dtype=np.int64)
    holders = np.full(num_candidates, _FREE)
    kernels(_KERNELS).label_clusters(tracks, candidates, holders, labels)
    return labels
