"""The windows of all tracks: insertion, relinearisation, elimination, marginalisation and states at any stamp."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded.elimination import eliminate, substitute, substitute_means
from fgtrack.estimation.banded.linearisation import linearise_segments, linearise_terms, move
from fgtrack.estimation.banded.nodes import Nodes, Place
from fgtrack.estimation.banded.ring import fuse_behind
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
        self._thresholds = np.empty((0, motion.dim))
        self._curved: BoolArray = np.zeros(0, dtype=bool)
        self._anchored: IntArray = np.zeros(0, dtype=np.int64)
        """1 where the oldest node of the window keeps its linearisation, because it has a marginalised past."""
        self._far: BoolArray = np.zeros(0, dtype=bool)
        """Whether a node is too far from its linearisation point."""
        self._known: IntArray = np.zeros(0, dtype=np.int64)
        """From this place on smoothed means and covariances are known."""

    def begin(self, track: int, stamp_ns: int, mean: FloatArray, covariance: FloatArray) -> None:
        """Start the window of a track with its first node."""
        self.nodes.begin(track, stamp_ns, mean, covariance)
        more = len(self.nodes.first) - len(self._known)
        if more:
            self._thresholds = np.concatenate([self._thresholds, np.zeros((more, self._motion.dim))])
            self._curved, self._far = (
                np.concatenate([values, np.zeros(more, dtype=bool)]) for values in (self._curved, self._far)
            )
            self._anchored, self._known = (
                np.concatenate([values, np.zeros(more, dtype=np.int64)]) for values in (self._anchored, self._known)
            )
        self._thresholds[track] = self._settings.thresholds(self._motion, curved=False)
        self._curved[track] = self._far[track] = False
        self._anchored[track], self._known[track] = 0, 1

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
        self._substitute(tracks, places)
        left = nodes.at(tracks, places)
        means, covariances = nodes.origin[left] + nodes.step[left], nodes.P[left]
        until_ns = stamps_ns - nodes.stamps_ns[tracks, places]
        newest = places == nodes.count[tracks] - 1
        ahead = np.flatnonzero(newest & (until_ns > 0))
        if ahead.size:
            means[ahead], F, Q = self._motion.steps(means[ahead], until_ns[ahead] / NS_PER_S)
            covariances[ahead] = propagated(F, covariances[ahead], Q)
        inner = np.flatnonzero(~newest & (until_ns > 0))
        if inner.size:
            means[inner], covariances[inner] = self._between(
                tracks[inner], places[inner], stamps_ns[inner], means[inner]
            )
        return States(means, covariances)

    def _between(self, tracks: IntArray, places: IntArray, stamps_ns: IntArray, left: FloatArray) -> States:
        """States between the nodes at `places`, with means `left`, and the next ones."""
        nodes = self.nodes
        at, after = nodes.at(tracks, places), nodes.at(tracks, places + 1)
        until_s = (stamps_ns - nodes.stamps_ns[tracks, places]) / NS_PER_S
        after_s = (nodes.stamps_ns[tracks, places + 1] - stamps_ns) / NS_PER_S
        right = nodes.origin[after] + nodes.step[after]
        inner = between_all(self._motion, left, right, until_s, after_s)
        by_right = inner.Lambda @ nodes.A[at] + inner.Psi
        given = congruence(inner.Lambda, nodes.C[at]) + inner.Sigma
        return States(inner.mean, symmetrise(congruence(by_right, nodes.P[after]) + given))

    def _substitute(self, tracks: IntArray, places: IntArray) -> None:
        """Make means and covariances known from `places` on."""
        known = self._known[tracks]
        short = places < known
        if short.any():
            substitute(self.nodes, tracks[short], known[short], places[short])
            self._known[tracks] = np.minimum(known, places)

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
        anchors = np.maximum(nodes.place_before(tracks, start_ns), nodes.first[tracks])
        left = self._leaving(tracks, anchors)
        undo = Undo(nodes, tracks)
        try:
            starts = self._relinearise(tracks, undo)
            old = stamp_ns < nodes.stamps_ns[tracks, anchors]
            if old.any():
                eliminate(nodes, tracks[old], starts[old])
                for row in np.flatnonzero(old).tolist():
                    nodes.first[tracks[row]] = anchors[row]
                    undo.keep_ring(int(tracks[row]))
                    term = fuse_behind(nodes, self._motion, int(tracks[row]), measurements[row])
                    starts[row] = anchors[row] = nodes.first[tracks[row]]
                    self._add(int(tracks[row]), int(starts[row]), term, undo)
            starts = self._insert(tracks, stamp_ns, ~old, guesses, starts)
            self._measure(tracks, stamp_ns, measurements, groups, guesses, ~old, undo)
            eliminate(nodes, tracks, starts)
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
            tracks, starts = tracks[starts < self.nodes.count[tracks]], starts[starts < self.nodes.count[tracks]]
            if not tracks.size:
                return
            eliminate(self.nodes, tracks, starts)
            self._solved(tracks)

    def _solved(self, tracks: IntArray) -> None:
        self._far[tracks] = False
        self._far[substitute_means(self.nodes, tracks, self._thresholds, self._anchored)] = True
        self._known[tracks] = self.nodes.count[tracks]

    def _leaving(self, tracks: IntArray, anchors: IntArray) -> Leaving:
        nodes = self.nodes
        going = anchors > nodes.first[tracks]
        if not self._settings.final or not going.any():
            n = nodes.dim
            return Leaving(np.empty(0, np.int64), np.empty(0, np.int64), States(np.empty((0, n)), np.empty((0, n, n))))
        tracks, anchors = tracks[going], anchors[going]
        self._substitute(tracks, nodes.first[tracks])
        places = nodes.first[tracks, None] + np.arange(int((anchors - nodes.first[tracks]).max()))
        rows, columns = np.nonzero(places < anchors[:, None])
        tracks, places = tracks[rows], places[rows, columns]
        at = nodes.at(tracks, places)
        states = States(nodes.origin[at] + nodes.step[at], nodes.P[at])
        return Leaving(tracks, nodes.stamps_ns[tracks, places], states)

    def _relinearise(self, tracks: IntArray, undo: Undo | None = None) -> IntArray:
        """Move the linearisation points that are too far from their states; gives their first places, or `count`."""
        nodes = self.nodes
        starts = nodes.count[tracks].copy()
        if not self._far[tracks].any():
            return starts
        free = nodes.first[tracks] + self._anchored[tracks]
        places = free[:, None] + np.arange(max(int((starts - free).max()), 0))
        slots = nodes.slots[tracks[:, None], np.minimum(places, starts[:, None] - 1)]
        far = (np.abs(nodes.step[tracks[:, None], slots]) > self._thresholds[tracks, None]).any(axis=-1)
        far &= places < starts[:, None]
        if far.any():
            rows, columns = np.nonzero(far)
            places = places[rows, columns]
            at = Place(tracks[rows], slots[rows, columns])
            if undo is not None:
                undo.keep_origins(at)
            move(nodes, at, nodes.step[at])
            linearise_segments(nodes, self._motion, at.tracks, places)
            np.minimum.at(starts, rows, places)
        return starts

    def _insert(
        self, tracks: IntArray, stamp_ns: int, live: BoolArray, guesses: FloatArray, starts: IntArray
    ) -> IntArray:
        """Make nodes at `stamp_ns` where there are none; gives the places from which on to eliminate."""
        nodes = self.nodes
        places = nodes.place_before(tracks, np.full(len(tracks), stamp_ns))
        new = live & (nodes.stamps_ns[tracks, places] != stamp_ns)
        places = places + new
        if new.any():
            to, at = tracks[new], places[new]
            nodes.insert(to, at, np.full(len(to), stamp_ns), guesses[new])
            linearise_segments(nodes, self._motion, np.concatenate([to, to]), np.concatenate([at - 1, at]))
        return np.where(live, np.minimum(starts, places), starts)

    def _measure(
        self,
        tracks: IntArray,
        stamp_ns: int,
        measurements: Sequence[Measurement],
        groups: Sequence[Innovations],
        guesses: FloatArray,
        live: BoolArray,
        undo: Undo,
    ) -> None:
        nodes = self.nodes
        places = nodes.place_before(tracks, np.full(len(tracks), stamp_ns))
        for group in groups:
            rows = group.positions[live[group.positions]]
            if not rows.size:
                continue
            at = nodes.at(tracks[rows], places[rows])
            for row, slot in zip(rows.tolist(), at.slots.tolist(), strict=True):
                nodes.terms[tracks[row]][slot].append(measurements[row])
                undo.added.append((int(tracks[row]), slot))
            if curved(measurements[rows[0]]):
                for track, slot in zip(at.tracks.tolist(), at.slots.tolist(), strict=True):
                    linearise_terms(nodes, track, slot)
                continue
            y, G = whitened(group.y, group.H, group.R)
            if len(rows) < len(group.positions):
                chosen = live[group.positions]
                y, G = y[chosen], G[chosen]
            nodes.measure(at, G, y + np.vecdot(G, (guesses[rows] - nodes.origin[at])[:, None]))

    def _add(self, track: int, place: int, term: EquivalentMeasurement, undo: Undo) -> None:
        nodes = self.nodes
        slot = int(nodes.slots[track, place])
        nodes.terms[track][slot].append(term)
        undo.added.append((track, slot))
        linearise_terms(nodes, track, slot)

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
        numbers = np.minimum(nodes.place_before(tracks, stamps_ns), nodes.first[tracks] - 1)
        many = numbers >= _MANY
        if many.any():
            nodes.drop(tracks[many], numbers[many])
            self._known[tracks[many]] -= numbers[many]

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
        mean, covariance = (nodes.origin[at] + nodes.predicted[at])[0], nodes.P_predicted[at][0]
        later = (
            (seconds(stamp_ns - stamps_ns[0]), term)
            for slot, stamp_ns in zip(at.slots.tolist(), stamps_ns, strict=True)
            for term in nodes.terms[track][slot]
            if isinstance(term, Measurement)
        )
        return fixes_of(mean, covariance, later)

    def restart(self, track: int, line: Line) -> None:
        """Solve again from states along `line`, with the prior's heading, which must be vague, turned there."""
        nodes, at = self.nodes, self._window(track)
        times_s = (np.array(self.stamps_ns(track)) - self.stamps_ns(track)[0]) / NS_PER_S
        means = np.array([along(line, time_s, self._motion.state_names) for time_s in times_s.tolist()])
        if not self._motion.cartesian:
            first = track, at.slots[0]
            nodes.predicted[first][YAW] = means[0, YAW] - nodes.origin[first][YAW]
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
        at = self._window(track)
        return np.asarray(self.nodes.origin[at] + self.nodes.step[at])

    def _window(self, track: int) -> Place:
        """All nodes of the window."""
        first, count = int(self.nodes.first[track]), int(self.nodes.count[track])
        return Place(np.full(count - first, track), self.nodes.slots[track, first:count])

    def _to(self, track: int, means: FloatArray) -> None:
        """Linearise the whole window at `means`, and solve it."""
        nodes, at = self.nodes, self._window(track)
        move(nodes, at, means - nodes.origin[at])
        self._rebuild(np.array([track]))

    def _rebuild(self, tracks: IntArray) -> None:
        """Linearise everything anew where it stands, and solve it."""
        nodes = self.nodes
        for track in tracks.tolist():
            at = self._window(track)
            first = nodes.first[track]
            linearise_segments(nodes, self._motion, at.tracks, first + np.arange(len(at.slots)))
            for slot in at.slots.tolist():
                linearise_terms(nodes, track, slot)
        eliminate(nodes, tracks, nodes.first[tracks])
        self._solved(tracks)
