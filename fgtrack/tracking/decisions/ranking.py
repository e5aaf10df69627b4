"""The best assignments of candidates to tracks, in the order of their likelihood."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import FloatArray, IntArray

LARGEST_LOSS = 9.2
"""An assignment is left out if it is less likely than the best one by a factor of exp(9.2), about 10,000."""
MISSED, ABSENT = -1, -2
"""Pair of a track that is missed, and of a track that the problem does not have."""


class Gains(NamedTuple):
    """Log-likelihood ratios of pairs of tracks and candidates to missed tracks.

    Track i has the pairs `first[i]` to `first[i + 1]`.
    """

    first: IntArray
    """Shape (n + 1,)."""
    candidates: IntArray
    """Candidate of each pair, which ascend for each track, shape (p,)."""
    values: FloatArray
    """Log-likelihood ratio of each pair, shape (p,)."""
    num_candidates: int


class Ranked(NamedTuple):
    """Assignments of several problems, the likeliest one first."""

    gains: FloatArray
    """Log-likelihood ratio to the assignment in which all tracks are missed, plus the gain of the problem, (r,)."""
    problems: IntArray
    """Number of the problem of each assignment, shape (r,)."""
    pairs: IntArray
    """Pair of each track; `MISSED` or `ABSENT` without a pair, shape (r, n)."""


def best_assignments(
    gains: Gains, problems: Sequence[tuple[float, IntArray]], most: int
) -> Ranked:
    """Return at most `most` assignments of all `problems`, the best one first.

    A problem is its gain and its tracks, in ascending order. Each track and each candidate of a problem is used at
    most once. Assignments that are less likely than the best one by more than `LARGEST_LOSS` are left out.
    """
    bases, rows = zip(*problems, strict=True)
    ends = np.cumsum([0, *map(len, rows)])
    return Ranked(
        *kernels("fgtrack.tracking.decisions.ranking_kernels").rank(
            *gains, np.array(bases), np.concatenate(rows), ends, most, LARGEST_LOSS
        )
    )
