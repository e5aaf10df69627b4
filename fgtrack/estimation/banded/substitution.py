"""Back-substitution: smoothed means and covariances of the nodes of many tracks, from the newest back.

Each node is known given the next one, x - x0 = A (next - its x0) + b + N(0, C). New measurements are mostly near the
newest nodes and leave these conditionals as they are further back. There they are composed, over blocks of `_LONG`
nodes, to what is known of each node given the end of its block. So a state far back is a few products away from the
newest ones, and the rest of its block need not be visited.
"""

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.banded.steps import backwards

_LONG = 8
_SELDOM = 4  # blocks are made once in so many solutions, for many tracks together


class Blocks:
    """The blocks of each track, and from where on states are known one by one.

    A block ends at a node at `base` + `_LONG` k; the last one at the node at `solid`. Further back than `base`, behind
    the window, there are none.
    """

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self._base: IntArray = np.zeros(0, dtype=np.int64)
        self._solid: IntArray = np.zeros(0, dtype=np.int64)
        self._known: IntArray = np.zeros(0, dtype=np.int64)
        """From this place on covariances are known."""
        self._num_solved = 0
        self.any_far: BoolArray = np.zeros(0, dtype=bool)
        """Whether a node of the track is marked as `far`."""

    def begin(self, track: int) -> None:
        """A new track, with one node."""
        more = len(self._nodes.first) - len(self._base)
        if more:
            self._base, self._solid, self._known = (
                np.concatenate([values, np.zeros(more, dtype=np.int64)])
                for values in (self._base, self._solid, self._known)
            )
            self.any_far = np.concatenate([self.any_far, np.zeros(more, dtype=bool)])
        self._base[track] = self._solid[track] = self._known[track] = 0
        self.any_far[track] = False

    def cut(self, tracks: IntArray, places: IntArray) -> None:
        """The nodes of `tracks` from `places` on, one each, are eliminated anew."""
        base = self._base[tracks]
        solid = np.minimum(self._solid[tracks], base + (places - 1 - base) // _LONG * _LONG)
        first = self._nodes.first[tracks]
        gone = (solid < base) | (solid <= first)
        self._base[tracks] = np.where(gone, first, base)
        self._solid[tracks] = np.where(gone, first, solid)

    def moved(self, tracks: IntArray, numbers: IntArray) -> None:
        """The places of all nodes of `tracks` have changed by `numbers`."""
        for values in (self._base, self._solid, self._known):
            values[tracks] += numbers

    def solve_means(self, tracks: IntArray, thresholds: FloatArray, anchored: IntArray) -> None:
        """Find the steps of the newest nodes and of the ends of blocks of `tracks`; mark all that are too long.

        The steps of nodes in the windows, but for the first `anchored` ones, may be as long as `thresholds`; shapes
        (tracks,) and (tracks, n) of all tracks.
        """
        nodes, n = self._nodes, self._nodes.dim
        count, first = nodes.count[tracks], nodes.first[tracks]
        if (self._solid[tracks] < first).any():  # all blocks have left the window
            self.cut(tracks, count)
        self._known[tracks] = count
        free = first + anchored[tracks]
        newest = nodes.at(tracks, count - 1)
        nodes.step[newest] = nodes.filtered[newest, :, n]
        far = np.asarray((np.abs(nodes.step[newest]) > thresholds[tracks]).any(axis=-1) & (count - 1 >= free))
        nodes.far[newest] = far
        self.any_far[tracks] = far
        steps = backwards(tracks, self._solid[tracks], count - 1)
        if steps.ends:
            numbers = nodes.at(steps.tracks, steps.places)
            back = nodes.back.take(numbers, axis=0)
            A, found = back[..., :n], back[..., n].copy()
            step = nodes.step[newest[steps.order]]
            for begin, end in steps.slices():
                here = found[begin:end]
                here += np.matvec(A[begin:end], step[: end - begin])
                step = here
            nodes.step[numbers] = found
            far = np.asarray((np.abs(found) > thresholds[steps.tracks]).any(axis=-1))
            if far.any():
                far &= steps.places >= (nodes.first + anchored)[steps.tracks]
                self.any_far[steps.tracks[far]] = True
            nodes.far[numbers] = far
        self._num_solved += 1
        if self._num_solved % _SELDOM == 0:
            self._extend(tracks, thresholds)
        self._check_blocks(tracks, thresholds, anchored)

    def _extend(self, tracks: IntArray, thresholds: FloatArray) -> None:
        """Compose what has become older than two blocks."""
        nodes, n = self._nodes, self._nodes.dim
        solid = self._solid[tracks]
        more = (nodes.count[tracks] - 1 - solid) // _LONG - 1
        if not (more > 0).any():
            return
        more = np.maximum(more, 0)
        blocks = backwards(tracks, -more, np.zeros_like(more))
        of, ends = blocks.tracks, self._solid[blocks.tracks] - _LONG * blocks.places
        numbers = nodes.numbers[of, ends - _LONG + np.arange(_LONG)[:, None]]
        back, C = nodes.back[numbers], nodes.C[numbers]
        leap, leap_C = np.empty(back.shape), np.empty(C.shape)
        leap[-1], leap_C[-1] = back[-1], C[-1]
        for k in range(_LONG - 2, -1, -1):
            A = back[k, ..., :n]
            np.matmul(A, leap[k + 1], out=leap[k])
            leap[k, ..., n] += back[k, ..., n]
            leap_C[k] = congruence(A, leap_C[k + 1]) + C[k]
        nodes.leap[numbers], nodes.leap_C[numbers] = leap, symmetrise(leap_C)
        end = nodes.at(of, ends)
        at = nodes.limit_at[end] = nodes.step[end]
        steps = np.matvec(leap[..., :n], at) + leap[..., n]
        room = thresholds[of] - np.abs(steps)
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = np.where(room[..., None] > 0.0, np.abs(leap[..., :n]) / room[..., None], np.inf)
        nodes.limit[end] = limit.max(axis=0)
        nodes.far[numbers] = False
        self._solid[tracks] = solid + _LONG * more

    def _check_blocks(self, tracks: IntArray, thresholds: FloatArray, anchored: IntArray) -> None:
        """Find the steps of the ends of blocks, and mark those nodes in blocks whose steps are too long."""
        nodes, n = self._nodes, self._nodes.dim
        solid, first = self._solid[tracks], nodes.first[tracks]
        num = -(-(solid - first) // _LONG)
        many = int(num.max(initial=0))
        if many == 0:
            return
        pairs = backwards(tracks, -num, np.zeros_like(num))
        ends = self._solid[pairs.tracks] + _LONG * (pairs.places + 1)
        numbers = nodes.at(pairs.tracks, ends)
        leap = nodes.leap.take(nodes.at(pairs.tracks, ends - _LONG), axis=0)
        steps = np.empty((len(numbers), n))
        step = nodes.step[numbers[: pairs.ends[0]]]
        for begin, end in pairs.slices():
            m = end - begin
            steps[begin:end] = step[:m]
            step = np.matvec(leap[begin:end, :, :n], step[:m]) + leap[begin:end, :, n]
        nodes.step[numbers] = steps
        with np.errstate(invalid="ignore"):
            moves = np.matvec(nodes.limit[numbers], np.abs(steps - nodes.limit_at[numbers]))
        doubtful = ~(moves < 1.0).all(axis=-1)
        if not doubtful.any():
            return
        of, ends, steps = pairs.tracks[doubtful], ends[doubtful], steps[doubtful]
        places = np.maximum(ends - _LONG + np.arange(_LONG)[:, None], 0)  # some may be forgotten
        inner = nodes.at(of, places)
        leap = nodes.leap[inner]
        found = np.matvec(leap[..., :n], steps) + leap[..., n]
        far = (np.abs(found) > thresholds[of]).any(axis=-1) & (places >= (nodes.first + anchored)[of])
        nodes.step[inner], nodes.far[inner] = found, far
        self.any_far[of[far.any(axis=0)]] = True

    def find_far(self, tracks: IntArray, anchored: IntArray) -> tuple[IntArray, IntArray]:
        """Nodes of `tracks` that are marked as `far`: positions of their tracks, and their places."""
        nodes = self._nodes
        some = self.any_far[tracks].nonzero()[0]
        if not some.size:
            return some, some
        count = nodes.count[tracks[some]]
        free = (nodes.first + anchored)[tracks[some]]
        places = free[:, None] + np.arange(max(int((count - free).max()), 0))
        numbers = nodes.numbers[tracks[some, None], np.minimum(places, count[:, None] - 1)]
        rows, columns = np.nonzero(nodes.far[numbers] & (places < count[:, None]))
        return some[rows], places[rows, columns]

    def smoothed(self, tracks: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """Steps (m, n) and covariances (m, n, n) of the nodes at `places` of `tracks`."""
        nodes = self._nodes
        solid = self._solid[tracks]
        self._substitute(tracks, np.maximum(places, solid))
        numbers = nodes.at(tracks, np.maximum(places, solid))
        steps, covariances = nodes.step[numbers], nodes.P[numbers]
        deep = (places < solid).nonzero()[0]
        if not deep.size:
            return steps, covariances
        tracks, places, base, ends = tracks[deep], places[deep], self._base[tracks[deep]], solid[deep]
        step, P = steps[deep], covariances[deep]
        while True:  # from end to end
            further = ((places <= ends - _LONG) & (ends > base)).nonzero()[0]
            if not further.size:
                break
            ends[further] -= _LONG
            at = nodes.at(tracks[further], ends[further])
            step[further], P[further] = _given(nodes.leap[at], nodes.leap_C[at], step[further], P[further])
        inside = ((places < ends) & (ends > base)).nonzero()[0]
        if inside.size:
            at = nodes.at(tracks[inside], places[inside])
            step[inside], P[inside] = _given(nodes.leap[at], nodes.leap_C[at], step[inside], P[inside])
            ends[inside] = places[inside]
        while True:  # behind the blocks node by node
            behind = (places < ends).nonzero()[0]
            if not behind.size:
                break
            ends[behind] -= 1
            at = nodes.at(tracks[behind], ends[behind])
            step[behind], P[behind] = _given(nodes.back[at], nodes.C[at], step[behind], P[behind])
        steps[deep], covariances[deep] = step, symmetrise(P)
        return steps, covariances

    def steps(self, tracks: IntArray, places: IntArray) -> FloatArray:
        """Steps (m, n) alone, for nodes in the windows."""
        nodes, n = self._nodes, self._nodes.dim
        steps = nodes.step[nodes.at(tracks, places)]
        base, solid = self._base[tracks], self._solid[tracks]
        deep = places < solid
        if deep.any():
            of, at = tracks[deep], places[deep]
            ends = base[deep] + ((at - base[deep]) // _LONG + 1) * _LONG
            leap = nodes.leap[nodes.at(of, at)]
            steps[deep] = np.matvec(leap[..., :n], nodes.step[nodes.at(of, ends)]) + leap[..., n]
        return steps

    def _substitute(self, tracks: IntArray, places: IntArray) -> None:
        """Find the covariances of the nodes of `tracks` back to `places`, not further than where their blocks end."""
        known = self._known[tracks]
        short = places < known
        if not short.any():
            return
        nodes, n = self._nodes, self._nodes.dim
        if not short.all():
            tracks, places, known = tracks[short], places[short], known[short]
        self._known[tracks] = places
        none = known == nodes.count[tracks]
        if none.any():
            newest = nodes.at(tracks[none], known[none] - 1)
            nodes.P[newest] = nodes.filtered[newest, :, :n]
            known = known - none
        steps = backwards(tracks, places, known)
        if not steps.ends:
            return
        numbers = nodes.at(steps.tracks, steps.places)
        A, C = nodes.back.take(numbers, axis=0)[..., :n], nodes.C.take(numbers, axis=0)
        P = nodes.P[nodes.at(tracks, known)[steps.order]]
        for begin, end in steps.slices():
            here = C[begin:end]
            A_here = A[begin:end]
            here += A_here @ P[: end - begin] @ A_here.mT
            P = here
        nodes.P[numbers] = symmetrise(C)


def _given(back: FloatArray, C: FloatArray, step: FloatArray, P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Steps and covariances of nodes known given others with `step` and `P`."""
    A = back[..., :-1]
    return np.matvec(A, step) + back[..., -1], congruence(A, P) + C
