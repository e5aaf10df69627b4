"""The graph of one object's window: nodes, segments and measurement terms, and the solver behind them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise

import gtsam
import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.factor_graph.backends.base import Backend, Change, Marginalised
from fgtrack.estimation.factor_graph.backends.batch import BatchBackend
from fgtrack.estimation.factor_graph.chain import Chain, Node
from fgtrack.estimation.factor_graph.rows import Factor, PriorOf, Segment, Term
from fgtrack.estimation.factor_graph.states import Around, State, state
from fgtrack.estimation.factor_graph.window_update import Update
from fgtrack.estimation.failures import Failure, Failures
from fgtrack.estimation.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.marginalised_past import MarginalisedPast, Prior
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.terms import MeasurementTerm, NearMeasurement, curved, overshot
from fgtrack.models.motion import MotionModel

#: Variables are numbered from here.
FIRST_KEY: int = gtsam.symbol("x", 0)
#: A step of a state, in m, rad, m/s or rad/s, that is rounding.
_AT_REST = 1e-7
_BROKEN = (RuntimeError, ValueError, IndexError, np.linalg.LinAlgError)


class Window:
    """Nodes from the oldest that is kept to the newest, and what lies behind them.

    Parameters
    ----------
    motion
        Motion model of the segments.
    stamp_ns, prior
        The first node.
    settings
        Those of relinearisation and outputs.
    make_backend
        Makes an empty backend; called again after a failed update, and when the first measurement comes that is not
        linear.
    failures
        Counts how often the graph is built anew and steps are damped.
    """

    def __init__(
        self,
        motion: MotionModel,
        stamp_ns: int,
        prior: Prior,
        settings: SmootherSettings,
        make_backend: Callable[[], Backend],
        failures: Failures,
    ) -> None:
        self._motion = motion
        self._settings = settings
        self._make_backend = make_backend
        self._thresholds = settings.thresholds(motion, curved=False)
        self._curved = False
        self._first_ns = stamp_ns
        self._chain = Chain(Node(stamp_ns, FIRST_KEY, prior.mean))
        self._past = MarginalisedPast(motion, stamp_ns, prior)
        self._means: FloatArray | None = None
        self._places: dict[int, int] = {}
        self._far: list[tuple[Node, FloatArray]] | None = None
        self._covariances: dict[tuple[int, ...], FloatArray] = {}
        self._states: dict[int, State] = {}
        self._failures = failures
        self._anchored = False
        self._solver: Backend | None = None

    @property
    def _backend(self) -> Backend:
        """The graph, which is not made before something is fused: most tracks of clutter end as they began."""
        if self._solver is None:
            self._solver, prior = self._make_backend(), self._past.prior
            self._solver.update(Change({FIRST_KEY: prior.mean}, {FIRST_KEY: 0.0}, [PriorOf(FIRST_KEY, prior)], []))
        return self._solver

    @property
    def stamps_ns(self) -> list[int]:
        """Stamps of the nodes, oldest first."""
        return [node.stamp_ns for node in self._chain.nodes]

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest node."""
        return self._chain.newest.stamp_ns

    @property
    def reach_ns(self) -> int:
        """Oldest stamp at which something can still be fused."""
        return self._past.start_ns

    def update(self, measurements: Sequence[Measurement], start_ns: int, reach_ns: int) -> list[TrackState]:
        """Fuse `measurements` and marginalise the nodes that are not needed from `start_ns` on.

        One node at or before `start_ns` stays. Conditionals of marginalised nodes are kept from `reach_ns` on. Gives
        the states of the nodes that left, where the settings want them. Raises `RuntimeError` where it fails; all is as
        before then.
        """
        return self.solve(self.prepare(measurements, start_ns, reach_ns))

    def prepare(
        self,
        measurements: Sequence[Measurement],
        start_ns: int,
        reach_ns: int,
        whitened: Sequence[FloatArray | None] = (),
    ) -> Update:
        """All of `update` up to the solution, which must come next. Raises as `update`.

        `whitened` are the `whitened_term`s of the measurements at the states at their stamps, where they are known.
        """
        chain = self._chain
        leaving = chain.nodes[: max(chain.place(start_ns), 0)]
        anchor = chain.nodes[len(leaving)]
        update = Update(leaving, self._past.copy(), reach_ns)
        known = list(whitened) or [None] * len(measurements)
        try:
            if not self._curved and any(curved(item) for item in measurements):
                self._curved, self._thresholds = True, self._settings.thresholds(self._motion, curved=True)
                self._rebuild(self._estimates())
                known = [None] * len(measurements)  # the states are others now
            moved = self._moved()
            for node, right in zip(leaving, chain.nodes[1:], strict=False):
                update.past.pass_node(node.terms, self._mean(node), right.stamp_ns, self._mean(right))
            if self._settings.final:
                update.left = self._states_behind(update.past, anchor, leaving)
            guesses = [
                self.state_at(item.stamp_ns)[0] if item.stamp_ns >= anchor.stamp_ns else None for item in measurements
            ]
            fused: list[tuple[Node, MeasurementTerm, FloatArray, FloatArray | None]] = []
            inserted: list[Node] = []
            for item, guess, rows in zip(measurements, guesses, known, strict=True):
                if guess is None:
                    fused.append((anchor, update.past.fuse(item), self._mean(anchor), None))
                    continue
                at = chain.near(item.stamp_ns)
                if at is None:
                    at = chain.insert(item.stamp_ns, guess)
                    inserted.append(at)
                    update.new[at.key], update.stamps_s[at.key] = guess, self._seconds(item.stamp_ns)
                elif at.stamp_ns != item.stamp_ns:
                    near = NearMeasurement.at(item, at.stamp_ns, self._motion)
                    fused.append((at, near, update.new[at.key] if at.key in update.new else self._mean(at), None))
                    continue
                fused.append((at, item, guess, rows))
            self._relinearise(update, moved, inserted)
            for node, term, guess, rows in fused:
                update.add(Term(node.key, term, node.origin if curved(term) else guess, rows), node, term)
        except _BROKEN as error:
            raise self._undone(update, error) from error
        return update

    def solve(self, update: Update) -> list[TrackState]:
        """Solve what is prepared; see `update`."""
        try:
            self._solve(update)
        except _BROKEN as error:
            raise self._undone(update, error) from error
        update.past.forget_before(update.reach_ns)
        self._past = update.past
        self._chain.drop(len(update.leaving))
        return update.left

    def _undone(self, update: Update, error: Exception) -> RuntimeError:
        """Take `update` back; gives what to raise."""
        self._chain.remove(update.new)
        self._rebuild(self._estimates())
        self._failures.add(Failure.GRAPH_REBUILT)
        return RuntimeError(f"the graph cannot be solved with the new measurements ({error})")

    def state_at(self, stamp_ns: int) -> State:
        """Mean and covariance at any stamp from `reach_ns` on: interpolated in the past, predicted ahead."""
        found = self.known_at(stamp_ns)
        if found is None:
            found = state(self._motion, self.around(stamp_ns))
            self.know(stamp_ns, found)
        return found

    def known_at(self, stamp_ns: int) -> State | None:
        """The state at `stamp_ns` where it was asked for before, since the last update."""
        return self._states.get(stamp_ns)

    def know(self, stamp_ns: int, found: State) -> None:
        """`found` is the state at `stamp_ns`, of `states.state`."""
        self._states[stamp_ns] = found

    def around(self, stamp_ns: int) -> Around:
        """What is known around `stamp_ns`."""
        place, nodes = self._chain.place(stamp_ns), self._chain.nodes
        if place < 0:
            anchor = self._chain.oldest
            return Around(*self._past.state_at(stamp_ns, self._mean(anchor), self._covariance(anchor)))
        node = nodes[place]
        if node.stamp_ns == stamp_ns:
            return Around(self._mean(node), self._covariance(node))
        until_s = seconds(stamp_ns - node.stamp_ns)
        if node is self._chain.newest:
            return Around(self._mean(node), self._covariance(node), until_s)
        right = nodes[place + 1]
        after_s = seconds(right.stamp_ns - stamp_ns)
        return Around(self._mean(node), self._covariance(node, right), until_s, self._mean(right), after_s)

    def damp(self) -> None:
        """Solve again by Levenberg-Marquardt where the last step went beyond what its linearisation is good for.

        A Gauss-Newton step has no limit: while bearings hardly show the range, it can send an object kilometres away,
        where their gradient vanishes and no further step leads back.
        """
        if (
            not self._curved
            or self._backend.damped
            or not any(overshot(node.terms, node.origin, mean) for node, mean in self._moved())
        ):
            return
        origins = {node.key: node.origin for node in self._chain.nodes}
        with suppress(*_BROKEN):  # then the origins remain
            self._rebuild(origins, BatchBackend)
        self._rebuild(self._estimates())
        self._failures.add(Failure.STEP_DAMPED)

    def iterate(self, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is further than a threshold from its linearisation point."""
        for _ in range(max_iterations):
            moved = self._moved()
            if not moved:
                return
            update = Update([], self._past, self.reach_ns)
            self._relinearise(update, moved)
            self._solve(update)

    def converge(self, max_iterations: int) -> None:
        """Solve again, with all states linearised where the last step led, until none moves by more than rounding.

        Half a step is taken where a whole one comes no closer: process noise that follows its state can make
        Gauss-Newton oscillate.
        """
        at, last = self._estimates(), np.inf
        for _ in range(max_iterations):
            self._rebuild(at)
            steps = {key: mean - at[key] for key, mean in self._estimates().items()}
            longest = max(float(np.abs(step).max()) for step in steps.values())
            if longest < _AT_REST:
                return
            share = 1.0 if longest < 0.5 * last else 0.5
            at, last = {key: mean + share * steps[key] for key, mean in at.items()}, longest

    @property
    def whole(self) -> bool:
        """Whether nothing has left the window yet."""
        return self._chain.oldest.stamp_ns == self._first_ns

    def fixes(self) -> list[Fix]:
        """The positions measured at the nodes, after that of the prior."""
        prior = self._past.prior
        later = (
            (self._seconds(node.stamp_ns), term)
            for node in self._chain.nodes
            for term in node.terms
            if isinstance(term, Measurement)
        )
        return fixes_of(prior.mean, prior.covariance, later)

    def restart(self, line: Line) -> None:
        """Solve again from states along `line`, with the prior's heading, which must be vague, turned there."""
        nodes, prior = self._chain.nodes, self._past.prior
        means = {node.key: along(line, self._seconds(node.stamp_ns), self._motion.state_names) for node in nodes}
        mean = prior.mean.copy()
        if not self._motion.cartesian:
            mean[YAW] = means[nodes[0].key][YAW]
        self._past = MarginalisedPast(self._motion, self._first_ns, Prior(mean, prior.covariance))
        self._rebuild(means)

    def _rebuild(self, means: Mapping[int, FloatArray], make_backend: Callable[[], Backend] | None = None) -> None:
        """Build the graph anew from the window's own records, near `means` by key, if wanted in another backend."""
        nodes = self._chain.nodes
        self._solver, self._anchored = (make_backend or self._make_backend)(), False
        for place, node in enumerate(nodes):
            self._chain.move(place, means[node.key])
        factors: list[Factor] = [self._segment(left, right) for left, right in pairwise(nodes)]
        factors.append(PriorOf(nodes[0].key, self._past.prior))
        factors += [Term(node.key, item, node.origin) for node in nodes for item in node.terms]
        stamps_s = {node.key: self._seconds(node.stamp_ns) for node in nodes}
        slots = self._solver.update(Change(dict(means), stamps_s, factors, []))
        terms = iter(slots[len(nodes) :])
        for place, node in enumerate(nodes):
            node.slot = slots[place] if node is not nodes[-1] else None
            node.term_slots = [next(terms) for _ in node.terms]
        self._forget_estimates()

    def _states_behind(self, past: MarginalisedPast, anchor: Node, leaving: Sequence[Node]) -> list[TrackState]:
        if not leaving:
            return []
        mean, covariance = self._mean(anchor), self._covariance(anchor)
        return [TrackState(node.stamp_ns, *past.state_at(node.stamp_ns, mean, covariance)) for node in leaving]

    def _relinearise(
        self, update: Update, moved: Sequence[tuple[Node, FloatArray]], inserted: Sequence[Node] = ()
    ) -> None:
        """Add the segments of new nodes to `update`, and what has to be linearised where nodes have `moved`."""
        chain = self._chain
        lefts = set[int]()
        for node in inserted:
            place = chain.place(node.stamp_ns)
            lefts.update((place - 1, place))
        for node, mean in moved:
            place = chain.place(node.stamp_ns)
            chain.move(place, mean)
            lefts.add(place)
        for place in sorted(lefts.intersection(range(len(chain.nodes) - 1))):
            left, right = chain.nodes[place : place + 2]
            update.replace(self._segment(left, right), left, left.slot)
        for node, _ in moved if self._curved else ():
            for place, term in enumerate(node.terms):
                if curved(term):
                    update.replace(Term(node.key, term, node.origin), node, node.term_slots[place], place)

    def _solve(self, update: Update) -> None:
        """Update the backend, and note the slots of the factors."""
        nodes, leaving = self._chain.nodes, update.leaving
        marginalised = None
        if leaving:
            oldest = nodes[len(leaving)]
            cutoff_s = 0.5 * (self._seconds(leaving[-1].stamp_ns) + self._seconds(oldest.stamp_ns))
            prior = PriorOf(oldest.key, update.past.prior)
            marginalised = Marginalised([node.key for node in leaving], cutoff_s, prior)
        slots = self._backend.update(Change(update.new, update.stamps_s, update.factors, update.removed, marginalised))
        update.place(slots)
        self._anchored |= bool(leaving)
        self._forget_estimates()

    def _moved(self) -> list[tuple[Node, FloatArray]]:
        """The nodes that are too far from their linearisation points, and where they are.

        The oldest one stays linearised where it was, once it has a marginalised past.
        """
        if self._far is None:
            nodes, means = self._chain.nodes, self._all_means()
            far = np.abs(means - self._chain.origins) > self._thresholds
            places = np.flatnonzero(far.any(axis=1)).tolist() if np.count_nonzero(far) else []
            self._far = [(nodes[place], means[place]) for place in places if place >= self._anchored]
        return self._far

    def _segment(self, left: Node, right: Node) -> Segment:
        dt_s = seconds(right.stamp_ns - left.stamp_ns)
        return Segment(self._motion, (left.key, right.key), dt_s, (left.origin, right.origin))

    def _seconds(self, stamp_ns: int) -> float:
        return seconds(stamp_ns - self._first_ns)

    def _estimates(self) -> dict[int, FloatArray]:
        return {node.key: self._estimate(node) for node in self._chain.nodes}

    def _estimate(self, node: Node) -> FloatArray:
        """The mean of a node in a backend that may be broken."""
        try:
            mean = self._mean(node)
        except _BROKEN:
            return node.origin
        return mean if np.isfinite(mean).all() else node.origin

    def _mean(self, node: Node) -> FloatArray:
        means = self._all_means()
        return np.asarray(means[self._places[node.key]])

    def _all_means(self) -> FloatArray:
        """Of all nodes, shape (nodes, n)."""
        if self._means is None:
            keys = self._chain.keys
            self._means = self._chain.origins.copy() if self._solver is None else self._solver.means(keys)
            self._places = dict(zip(keys, range(len(keys)), strict=True))
        return self._means

    def _covariance(self, *nodes: Node) -> FloatArray:
        keys = tuple(node.key for node in nodes)
        covariance = self._covariances.get(keys)
        if covariance is None:
            unfused = self._solver is None
            covariance = self._past.prior.covariance.copy() if unfused else self._backend.covariance(keys)
            self._covariances[keys] = covariance
        return covariance

    def _forget_estimates(self) -> None:
        self._means = self._far = None
        self._covariances.clear()
        self._states.clear()
