"""The windows of all tracks: insertion, relinearisation, elimination, marginalisation and states at any stamp."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded.elimination import eliminate
from fgtrack.estimation.banded.linearisation import linearise_segments, linearise_terms, move
from fgtrack.estimation.banded.nodes import Nodes
from fgtrack.estimation.banded.ring import fuse_behind
from fgtrack.estimation.banded.substitution import Blocks
from fgtrack.estimation.banded.undo import Undo
from fgtrack.estimation.banded.whitening import Innovations, whitened
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import propagated
from fgtrack.estimation.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.interpolation import between_all
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.terms import EquivalentMeasurement, curved
from fgtrack.models.motion import MotionModel

#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
_AT_REST = 1e-7
#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16


class States(NamedTuple):
    """States of m tracks."""

    means: FloatArray
    """Shape (m, n)."""
    covariances: FloatArray
    """Shape (m, n, n)."""


class Leaving(NamedTuple):
    """Smoothed states of the nodes that leave their windows, oldest first for each track."""

    tracks: IntArray
    """Shape (m,)."""
    stamps_ns: IntArray
    """Shape (m,)."""
    states: States

    def at(self, chosen: BoolArray) -> "Leaving":
        """Those that are `chosen`, shape (m,)."""
        states = States(self.states.means[chosen], self.states.covariances[chosen])
        return Leaving(self.tracks[chosen], self.stamps_ns[chosen], states)


class Windows:
    """Windows of many tracks, each by its number.

    Parameters
    ----------
    motion
        Motion model of all of them.
    settings
        Those of relinearisation.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings) -> None:
        self._motion = motion
        self._settings = settings
        self.nodes = Nodes(motion.dim)
        self._blocks = Blocks(self.nodes)
        self._thresholds = np.empty((0, motion.dim))
        self._curved: BoolArray = np.zeros(0, dtype=bool)
        self._anchored: IntArray = np.zeros(0, dtype=np.int64)
        """1 where the oldest node of the window keeps its linearisation, because it has a marginalised past."""

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """Start the window of a track with its first node."""
        self.nodes.begin(track, stamp_ns, mean, covariance)
        self._blocks.begin(track)
        more = len(self.nodes.first) - len(self._curved)
        if more:
            self._thresholds = np.concatenate([self._thresholds, np.zeros((more, self._motion.dim))])
            self._curved = np.concatenate([self._curved, np.zeros(more, dtype=bool)])
            self._anchored = np.concatenate([self._anchored, np.zeros(more, dtype=np.int64)])
        self._thresholds[track] = self._settings.thresholds(self._motion, curved=False)
        self._curved[track], self._anchored[track] = False, 0

    # --- states

    def oldest_ns(self, tracks: IntArray) -> IntArray:
        """Oldest stamps at which something is known, behind the windows too."""
        return np.asarray(self.nodes.stamps_ns[tracks, 0])

    def newest_ns(self, tracks: IntArray) -> IntArray:
        """Stamps of the newest nodes."""
        return np.asarray(self.nodes.stamps_ns[tracks, self.nodes.count[tracks] - 1])

    def states_at(self, tracks: IntArray, stamps_ns: IntArray) -> States:
        """States of `tracks` at `stamps_ns`, not older than `oldest_ns`: interpolated, or predicted ahead."""
        nodes = self.nodes
        places = nodes.place_before(tracks, stamps_ns)
        until_ns = stamps_ns - nodes.stamps_ns[tracks, places]
        between = (until_ns > 0) & (places < nodes.count[tracks] - 1)
        known = places + between
        steps, covariances = self._blocks.smoothed(tracks, known)
        means = nodes.origin[nodes.at(tracks, known)] + steps
        inner = between.nonzero()[0]
        if inner.size == len(tracks):
            return self._between(tracks, known, stamps_ns, steps, means, covariances)
        if inner.size:
            means[inner], covariances[inner] = self._between(
                tracks[inner], known[inner], stamps_ns[inner], steps[inner], means[inner], covariances[inner]
            )
        ahead = ((until_ns > 0) & ~between).nonzero()[0]
        if ahead.size:
            means[ahead], F, Q = self._motion.steps(means[ahead], until_ns[ahead] / NS_PER_S)
            covariances[ahead] = propagated(F, covariances[ahead], Q)
        return States(means, covariances)

    def _between(
        self,
        tracks: IntArray,
        places: IntArray,
        stamps_ns: IntArray,
        steps: FloatArray,
        right: FloatArray,
        P_right: FloatArray,
    ) -> States:
        """States before the nodes at `places`, with these steps, means and covariances, and after those before them."""
        nodes, n = self.nodes, self._motion.dim
        at = nodes.at(tracks, places - 1)
        A, b = nodes.back[at, :, :n], nodes.back[at, :, n]
        until_s = (stamps_ns - nodes.stamps_ns[tracks, places - 1]) / NS_PER_S
        after_s = (nodes.stamps_ns[tracks, places] - stamps_ns) / NS_PER_S
        left = nodes.origin[at] + np.matvec(A, steps) + b
        inner = between_all(self._motion, left, right, until_s, after_s)
        by_right = inner.Lambda @ A + inner.Psi
        given = congruence(inner.Lambda, nodes.C[at]) + inner.Sigma
        return States(inner.mean, symmetrise(congruence(by_right, P_right) + given))

    # --- updates

    def fuse(
        self,
        tracks: IntArray,
        stamp_ns: int,
        measurements: Sequence[Measurement],
        groups: Sequence[Innovations],
        guesses: FloatArray,
        start_ns: IntArray,
        reach_ns: IntArray,
    ) -> Leaving:
        """Fuse one measurement of each of `tracks`, all at `stamp_ns`, and move the windows up to `start_ns`.

        `groups` are their innovations at `guesses`, shape (m, n), the states at `stamp_ns`. One node at or before
        `start_ns` stays in each window; behind it, what `reach_ns` needs is kept. Gives the states of the nodes that
        left. Raises `numpy.linalg.LinAlgError` where it fails; all is as before then.
        """
        nodes = self.nodes
        guesses = self._bend(tracks, stamp_ns, measurements, guesses)
        anchors = nodes.last_before(tracks, nodes.first[tracks], start_ns)
        left = self._leaving(tracks, anchors)
        places = nodes.place_before(tracks, np.full(len(tracks), stamp_ns))
        old = places < anchors
        undo = Undo(nodes, tracks, 0 if old.any() else int(places.min()))
        try:
            starts = self._relinearise(tracks, undo)
            if old.any():
                self._eliminate(tracks[old], starts[old])
                for row in old.nonzero()[0].tolist():
                    nodes.first[tracks[row]] = anchors[row]
                    undo.keep_ring(int(tracks[row]))
                    term = fuse_behind(nodes, self._motion, int(tracks[row]), measurements[row])
                    starts[row] = anchors[row] = nodes.first[tracks[row]]
                    self._add(int(tracks[row]), int(starts[row]), term, undo)
            live = ~old
            numbers = self._insert(tracks, stamp_ns, places, live, guesses, starts)
            self._measure(numbers, measurements, groups, guesses, live, undo)
            self._eliminate(tracks, starts)
        except np.linalg.LinAlgError:
            undo()
            self._rebuild(tracks)
            raise
        self._anchored[tracks] |= anchors > undo.first
        nodes.first[tracks] = anchors
        self._solved(tracks)
        self._forget_before(tracks, reach_ns)
        return left

    def iterate(self, tracks: IntArray, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is further than a threshold from its linearisation point."""
        for _ in range(max_iterations):
            starts = self._relinearise(tracks)
            moved = starts < self.nodes.count[tracks]
            tracks, starts = tracks[moved], starts[moved]
            if not tracks.size:
                return
            self._eliminate(tracks, starts)
            self._solved(tracks)

    def _eliminate(self, tracks: IntArray, places: IntArray) -> None:
        self._blocks.cut(tracks, places)
        eliminate(self.nodes, tracks, places)

    def _solved(self, tracks: IntArray) -> None:
        self._blocks.solve_means(tracks, self._thresholds, self._anchored)

    def _leaving(self, tracks: IntArray, anchors: IntArray) -> Leaving:
        nodes = self.nodes
        going = anchors - nodes.first[tracks]
        if not self._settings.final or not going.any():
            n = nodes.dim
            return Leaving(np.empty(0, np.int64), np.empty(0, np.int64), States(np.empty((0, n)), np.empty((0, n, n))))
        rows, columns = np.nonzero(np.arange(int(going.max())) < going[:, None])
        tracks, places = tracks[rows], (nodes.first[tracks[rows]] + columns)
        steps, covariances = self._blocks.smoothed(tracks, places)
        means = nodes.origin[nodes.at(tracks, places)] + steps
        return Leaving(tracks, nodes.stamps_ns[tracks, places], States(means, covariances))

    def _relinearise(self, tracks: IntArray, undo: Undo | None = None) -> IntArray:
        """Move the linearisation points that are too far from their states; gives their first places, or `count`."""
        nodes = self.nodes
        starts = nodes.count[tracks]
        some = self._blocks.any_far[tracks].nonzero()[0]
        if not some.size:
            return starts
        free = (nodes.first + self._anchored)[tracks[some]]
        places = free[:, None] + np.arange(max(int((starts[some] - free).max()), 0))
        numbers = nodes.numbers[tracks[some, None], np.minimum(places, starts[some, None] - 1)]
        rows, columns = np.nonzero(nodes.far[numbers] & (places < starts[some, None]))
        if rows.size:
            moved, of, places = numbers[rows, columns], tracks[some[rows]], places[rows, columns]
            if undo is not None:
                undo.keep_origins(of, moved)
            move(nodes, of, moved, nodes.step[moved])
            nodes.far[moved] = False
            linearise_segments(nodes, self._motion, of, places)
            np.minimum.at(starts, some[rows], places)
        return starts

    def _insert(
        self,
        tracks: IntArray,
        stamp_ns: int,
        places: IntArray,
        live: BoolArray,
        guesses: FloatArray,
        starts: IntArray,
    ) -> IntArray:
        """Make nodes at `stamp_ns` where there are none, after those at `places`; gives the numbers of the nodes there.

        The windows are eliminated from there on: `starts` becomes smaller.
        """
        nodes = self.nodes
        new = live & (nodes.stamps_ns[tracks, places] != stamp_ns)
        places = places + new
        if new.any():
            all_new = bool(new.all())
            to, at, origins = (tracks, places, guesses) if all_new else (tracks[new], places[new], guesses[new])
            nodes.insert(to, at, stamp_ns, origins)
            linearise_segments(nodes, self._motion, np.concatenate([to, to]), np.concatenate([at - 1, at]))
        np.minimum(starts, places, out=starts, where=live)
        return nodes.at(tracks, places)

    def _measure(
        self,
        numbers: IntArray,
        measurements: Sequence[Measurement],
        groups: Sequence[Innovations],
        guesses: FloatArray,
        live: BoolArray,
        undo: Undo,
    ) -> None:
        """What is measured at the nodes `numbers`, where `live`."""
        nodes = self.nodes
        all_live = bool(live.all())
        for group in groups:
            chosen = slice(None) if all_live else live[group.positions]
            rows = group.positions[chosen]
            if not rows.size:
                continue
            at = numbers[rows]
            for row, number in zip(rows.tolist(), at.tolist(), strict=True):
                nodes.terms[number].append(measurements[row])
            undo.added += at.tolist()
            if curved(measurements[rows[0]]):
                for number in at.tolist():
                    linearise_terms(nodes, number)
                continue
            measured = whitened(group.y, group.H, group.R)[chosen]
            measured[..., -1] += np.matvec(measured[..., :-1], guesses[rows] - nodes.origin[at])
            nodes.measure(at, measured)

    def _add(self, track: int, place: int, term: EquivalentMeasurement, undo: Undo) -> None:
        number = int(self.nodes.numbers[track, place])
        self.nodes.terms[number].append(term)
        undo.added.append(number)
        linearise_terms(self.nodes, number)

    def _bend(
        self, tracks: IntArray, stamp_ns: int, measurements: Sequence[Measurement], guesses: FloatArray
    ) -> FloatArray:
        """Where the first measurement comes that is not linear, relinearise the window, and from then on by thresholds
        of its own; gives the states at `stamp_ns` after that.
        """
        bent = [row for row, item in enumerate(measurements) if not self._curved[tracks[row]] and curved(item)]
        if not bent:
            return guesses
        for track in tracks[bent].tolist():
            self._curved[track] = True
            self._thresholds[track] = self._settings.thresholds(self._motion, curved=True)
            self._anchored[track] = 0
            self._to(track, self._estimates(track))
        guesses = guesses.copy()
        guesses[bent] = self.states_at(tracks[bent], np.full(len(bent), stamp_ns)).means
        return guesses

    def _forget_before(self, tracks: IntArray, stamps_ns: IntArray) -> None:
        nodes = self.nodes
        most = nodes.first[tracks] - 1
        if not ((most >= _MANY) & (nodes.stamps_ns[tracks, _MANY - 1] <= stamps_ns)).any():
            return
        numbers = np.minimum(nodes.place_before(tracks, stamps_ns), most)
        many = numbers >= _MANY
        if many.any():
            nodes.drop(tracks[many], numbers[many])
            self._blocks.moved(tracks[many], -numbers[many])

    # --- one track

    def stamps_ns(self, track: int) -> list[int]:
        """Stamps of the nodes in the window."""
        first, count = self.nodes.first[track], self.nodes.count[track]
        stamps_ns: list[int] = self.nodes.stamps_ns[track, first:count].tolist()
        return stamps_ns

    def whole(self, track: int) -> bool:
        """Whether nothing has left the window yet."""
        return bool(self.nodes.first[track] == 0)  # a node that left stays behind the window

    def fixes(self, track: int) -> list[Fix]:
        """The positions measured at the nodes, after that of the prior, of a window that nothing has left yet."""
        nodes, at = self.nodes, self._window(track)
        stamps_ns = self.stamps_ns(track)
        known = nodes.predicted[at[0]]
        later = (
            (seconds(stamp_ns - stamps_ns[0]), term)
            for number, stamp_ns in zip(at.tolist(), stamps_ns, strict=True)
            for term in nodes.terms[number]
            if isinstance(term, Measurement)
        )
        return fixes_of(nodes.origin[at[0]] + known[:, -1], known[:, :-1].copy(), later)

    def restart(self, track: int, line: Line) -> None:
        """Solve again from states along `line`, with the prior's heading, which must be vague, turned there."""
        nodes, at = self.nodes, self._window(track)
        times_s = (np.array(self.stamps_ns(track)) - self.stamps_ns(track)[0]) / NS_PER_S
        means = np.array([along(line, time_s, self._motion.state_names) for time_s in times_s.tolist()])
        if not self._motion.cartesian:
            nodes.predicted[at[0], YAW, -1] = means[0, YAW] - nodes.origin[at[0], YAW]
        self._to(track, means)

    def converge(self, track: int, max_iterations: int) -> None:
        """Solve again, with all states linearised where the last step led, until none moves by more than rounding.

        Half a step is taken where a whole one comes no closer: process noise that follows its state can make
        Gauss-Newton oscillate.
        """
        means, last = self._estimates(track), np.inf
        for _ in range(max_iterations):
            self._to(track, means)
            steps = self._estimates(track) - means
            longest = float(np.abs(steps).max())
            if longest < _AT_REST:
                return
            share = 1.0 if longest < 0.5 * last else 0.5
            means, last = means + share * steps, longest

    def _estimates(self, track: int) -> FloatArray:
        places = np.arange(int(self.nodes.first[track]), int(self.nodes.count[track]))
        steps = self._blocks.steps(np.full(len(places), track), places)
        return np.asarray(self.nodes.origin[self._window(track)] + steps)

    def _window(self, track: int) -> IntArray:
        """Numbers of all nodes of the window."""
        return self.nodes.numbers[track, self.nodes.first[track] : self.nodes.count[track]].copy()

    def _to(self, track: int, means: FloatArray) -> None:
        """Linearise the whole window at `means`, and solve it."""
        nodes, at = self.nodes, self._window(track)
        move(nodes, np.full(len(at), track), at, means - nodes.origin[at])
        self._rebuild(np.array([track]))

    def _rebuild(self, tracks: IntArray) -> None:
        """Linearise everything anew where it stands, and solve it."""
        nodes = self.nodes
        for track in tracks.tolist():
            at = self._window(track)
            linearise_segments(nodes, self._motion, np.full(len(at), track), nodes.first[track] + np.arange(len(at)))
            for number in at.tolist():
                linearise_terms(nodes, number)
        self._eliminate(tracks, nodes.first[tracks])
        self._solved(tracks)
