"""The windows of all tracks: insertion, relinearisation, elimination, marginalisation and states at any stamp."""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded.damping import DampedWindow
from fgtrack.estimation.banded.linearisation import linearise_segments, linearise_terms
from fgtrack.estimation.banded.ring import fuse_behind
from fgtrack.estimation.banded.solver import Moved, Solver
from fgtrack.estimation.banded.undo import Undo
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import propagated
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.interpolation import between
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.terms import EquivalentMeasurement, curved, overshot
from fgtrack.estimation.whitening import Innovations
from fgtrack.models.motion import MotionModel

#: Nodes behind the window are forgotten when there are so many that nobody needs.
_MANY = 16
#: Further than any place.
_NEVER = np.iinfo(np.int64).max


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
    failures
        Counts how often steps are damped.
    """

    def __init__(self, motion: MotionModel, settings: SmootherSettings, failures: Failures) -> None:
        self._motion = motion
        self._settings = settings
        self.solver = Solver(motion, settings)
        self.nodes = self.solver.nodes
        self.failures = failures

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
        steps, covariances = self.solver.smoothed(tracks, known)
        means = nodes.origin[nodes.at(tracks, known)] + steps
        inner = between.nonzero()[0]
        if inner.size == len(tracks):
            return self._between(tracks, known, stamps_ns, steps, means, covariances)
        if inner.size:
            means[inner], covariances[inner] = self._between(
                tracks[inner], known[inner], stamps_ns[inner], steps[inner], means[inner], covariances[inner]
            )
        ahead = ((until_ns > 0) & ~between).nonzero()[0]
        if ahead.size == len(tracks):
            return self._ahead(means, covariances, until_ns)
        if ahead.size:
            means[ahead], covariances[ahead] = self._ahead(means[ahead], covariances[ahead], until_ns[ahead])
        return States(means, covariances)

    def _ahead(self, means: FloatArray, covariances: FloatArray, until_ns: IntArray) -> States:
        """States so long after those of the newest nodes."""
        means, F, Q = self._motion.transition(means, until_ns / NS_PER_S)
        return States(means, propagated(F, covariances, Q))

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
        inner = between(self._motion, left, right, until_s, after_s)
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
        undo = Undo(nodes, tracks)
        try:
            moved = self.solver.move_far(tracks, undo)
            starts = moved.starts
            if old.any():
                linearise_segments(nodes, self._motion, moved.tracks, moved.places)
                moved = Moved(starts, tracks[:0], tracks[:0])
                self.solver.eliminate(tracks[old], starts[old])
                for row in old.nonzero()[0].tolist():
                    nodes.first[tracks[row]] = anchors[row]
                    undo.keep_ring(int(tracks[row]))
                    term = fuse_behind(nodes, self._motion, int(tracks[row]), measurements[row])
                    starts[row] = anchors[row] = nodes.first[tracks[row]]
                    self._add(int(tracks[row]), int(starts[row]), term, undo)
            live = ~old
            numbers = self._insert(tracks, stamp_ns, places, live, guesses, moved)
            self._measure(numbers, measurements, groups, guesses, live, undo)
            self.solver.eliminate(tracks, starts)
        except np.linalg.LinAlgError:
            undo()
            self.solver.rebuild(tracks)
            raise
        self.solver.anchored[tracks] |= anchors > undo.first
        nodes.first[tracks] = anchors
        self.solver.solve_means(tracks)
        self._forget_before(tracks, reach_ns)
        return left

    def damp(self, tracks: IntArray) -> None:
        """Solve again by Levenberg-Marquardt where the last step went beyond what its linearisation is good for.

        See `Window.damp` of the smoother with gtsam.
        """
        solver, nodes = self.solver, self.nodes
        tracks = tracks[solver.curved[tracks]]
        if not tracks.size:
            return
        rows, places = solver.far(tracks)
        moved = nodes.at(tracks[rows], places)
        far = zip(rows.tolist(), moved.tolist(), nodes.origin[moved], nodes.step[moved], strict=True)
        for row in sorted({row for row, number, x, step in far if overshot(nodes.terms[number], x, x + step)}):
            track = int(tracks[row])
            means = nodes.origin[solver.window(track)]
            with suppress(np.linalg.LinAlgError):  # then the linearisation points remain
                means = DampedWindow(solver, self._motion, track).solved()
            solver.solve_anew(track, means)
            self.failures.add(Failure.STEP_DAMPED)

    def _leaving(self, tracks: IntArray, anchors: IntArray) -> Leaving:
        nodes = self.nodes
        going = anchors - nodes.first[tracks]
        if not self._settings.final or not going.any():
            n = nodes.dim
            return Leaving(np.empty(0, np.int64), np.empty(0, np.int64), States(np.empty((0, n)), np.empty((0, n, n))))
        rows, columns = np.nonzero(np.arange(int(going.max())) < going[:, None])
        tracks, places = tracks[rows], (nodes.first[tracks[rows]] + columns)
        steps, covariances = self.solver.smoothed(tracks, places)
        means = nodes.origin[nodes.at(tracks, places)] + steps
        return Leaving(tracks, nodes.stamps_ns[tracks, places], States(means, covariances))

    def _insert(
        self, tracks: IntArray, stamp_ns: int, places: IntArray, live: BoolArray, guesses: FloatArray, moved: Moved
    ) -> IntArray:
        """Make nodes at `stamp_ns` where there are none, after those at `places`; gives the numbers of the nodes there.

        Linearises the motion from and to them, and from the nodes that have `moved`. The windows are eliminated from
        there on: `moved.starts` becomes smaller.
        """
        nodes = self.nodes
        new = live & (nodes.stamps_ns[tracks, places] != stamp_ns)
        places = places + new
        of, at = moved.tracks, moved.places
        if new.any():
            all_new = bool(new.all())
            to, inner, origins = (tracks, places, guesses) if all_new else (tracks[new], places[new], guesses[new])
            nodes.insert_at(to, inner, stamp_ns, origins)
            if of.size:
                inserted = np.full(len(nodes.first), _NEVER)
                inserted[to] = inner
                at = at + (at >= inserted[of])
            of, at = np.concatenate([of, to, to]), np.concatenate([at, inner - 1, inner])
        if of.size:
            linearise_segments(nodes, self._motion, of, at)
        np.minimum(moved.starts, places, out=moved.starts, where=live)
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
            y, H, R = (values[chosen] for values in (group.y, group.H, group.R))
            nodes.observe(at, y, H, R, guesses[rows] - nodes.origin[at])

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
        bent = [row for row, item in enumerate(measurements) if curved(item) and not self.solver.curved[tracks[row]]]
        if not bent:
            return guesses
        for track in tracks[bent].tolist():
            self.solver.bend(track)
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

    # --- one track

    def whole(self, track: int) -> bool:
        """Whether nothing has left the window yet."""
        return bool(self.nodes.first[track] == 0)  # a node that left stays behind the window

    def fixes(self, track: int) -> list[Fix]:
        """The positions measured at the nodes, after that of the prior, of a window that nothing has left yet."""
        nodes, at = self.nodes, self.solver.window(track)
        stamps_ns = self.solver.stamps_ns(track)
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
        nodes, at = self.nodes, self.solver.window(track)
        times_s = (np.array(self.solver.stamps_ns(track)) - self.solver.stamps_ns(track)[0]) / NS_PER_S
        means = np.array([along(line, time_s, self._motion.state_names) for time_s in times_s.tolist()])
        if not self._motion.cartesian:
            nodes.predicted[at[0], YAW, -1] = means[0, YAW] - nodes.origin[at[0], YAW]
        self.solver.solve_at(track, means)
