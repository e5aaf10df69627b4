"""What many tracks do step by step, each as many steps as it needs, packed into one axis."""

from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, IntArray


class Steps(NamedTuple):
    """All entries of the first step, then all of the second, and so on, tracks with the most steps first."""

    tracks: IntArray
    """Track of each entry."""
    places: IntArray
    """Place of each entry."""
    order: IntArray
    """Positions of the tracks, those with the most steps first; without those that have none."""
    ends: list[int]
    """Where the entries of each step end."""

    def slices(self) -> list[tuple[int, int]]:
        """Where the entries of each step begin and end."""
        return list(zip([0, *self.ends[:-1]], self.ends, strict=True))


def forwards(tracks: IntArray, begins: IntArray, ends: IntArray) -> Steps:
    """From the places `begins` up to, without, `ends`, one each; all end at the last step."""
    lengths = ends - begins
    longest = int(lengths.max(initial=0))
    if (lengths == longest).all():
        return _even(tracks, begins + np.arange(longest)[:, None])
    order = np.argsort(-lengths, kind="stable")
    steps = np.arange(longest)[:, None]
    return _uneven(tracks, order, steps >= longest - lengths[order], steps + (ends[order] - longest))


def backwards(tracks: IntArray, begins: IntArray, ends: IntArray) -> Steps:
    """From the places `ends` - 1 down to `begins`, one each; all begin at the first step."""
    lengths = ends - begins
    longest = int(lengths.max(initial=0))
    if (lengths == longest).all():
        return _even(tracks, ends - 1 - np.arange(longest)[:, None])
    order = np.argsort(-lengths, kind="stable")
    steps = np.arange(longest)[:, None]
    return _uneven(tracks, order, steps < lengths[order], ends[order] - 1 - steps)


def _even(tracks: IntArray, places: IntArray) -> Steps:
    longest, m = places.shape
    if longest == 0:
        return Steps(tracks[:0], tracks[:0], tracks[:0], [])
    return Steps(np.concatenate([tracks] * longest), places.ravel(), np.arange(m), list(range(m, m * longest + 1, m)))


def _uneven(tracks: IntArray, order: IntArray, active: BoolArray, places: IntArray) -> Steps:
    rows, columns = np.nonzero(active)
    ends = active.sum(axis=1).cumsum().tolist()
    last = int(active.any(axis=0).sum())
    return Steps(tracks[order[columns]], places[rows, columns], order[:last], ends)
