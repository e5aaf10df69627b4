"""The graph of one object's window: nodes, segments and measurement terms, and the solver behind them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import pairwise

import gtsam
import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.ekf import predict_one, propagated
from fgtrack.estimation.factor_graph.backends.base import Backend, Change, Marginalised
from fgtrack.estimation.factor_graph.backends.batch import BatchBackend
from fgtrack.estimation.factor_graph.backends.incremental import FIRST_KEY
from fgtrack.estimation.factor_graph.chain import Chain, Node
from fgtrack.estimation.factor_graph.factors import map_motion_factor, measurement_factor, motion_factor, prior_factor
from fgtrack.estimation.initiation import Fix, Line, along, fixes_of
from fgtrack.estimation.interpolation import between
from fgtrack.estimation.marginalised_past import MarginalisedPast, Prior
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.estimation.terms import MeasurementTerm, curved, overshot
from fgtrack.models.motion import MotionModel

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
        Makes an empty backend with the given relinearisation thresholds; called again after a failed update, and when
        the first measurement comes that is not linear.
    """

    def __init__(
        self,
        motion: MotionModel,
        stamp_ns: int,
        prior: Prior,
        settings: SmootherSettings,
        make_backend: Callable[[FloatArray], Backend],
    ) -> None:
        self._motion = motion
        self._settings = settings
        self._make_backend = make_backend
        self._follows = settings.objective == "map" and not motion.linear
        self._thresholds = settings.thresholds(motion, curved=False)
        self._curved = False
        self._first_ns = stamp_ns
        self._chain = Chain(Node(stamp_ns, FIRST_KEY, prior.mean))
        self._past = MarginalisedPast(motion, stamp_ns, prior, self._follows)
        self._means: dict[int, FloatArray] = {}
        self._covariances: dict[tuple[int, ...], FloatArray] = {}
        self._states: dict[int, tuple[FloatArray, FloatArray]] = {}
        self.num_rebuilt = 0
        """How often the graph was built anew after a failed update."""
        self.num_damped = 0
        """How often a step went too far and was taken again with damping."""
        self._rebuild({FIRST_KEY: prior.mean})

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
        chain, past = self._chain, self._past.copy()
        leaving = chain.nodes[: max(chain.place(start_ns), 0)]
        anchor = chain.nodes[len(leaving)]
        new: dict[int, FloatArray] = {}
        try:
            if not self._curved and any(curved(item) for item in measurements):
                self._curved, self._thresholds = True, self._settings.thresholds(self._motion, curved=True)
                self._rebuild(self._estimates())
            moved = self._moved()
            for node, right in zip(leaving, chain.nodes[1:], strict=False):
                past.pass_node(node.terms, self._mean(node), right.stamp_ns, self._mean(right))
            left = self._states_behind(past, anchor, leaving) if self._settings.final else []
            old = [item for item in measurements if item.stamp_ns < anchor.stamp_ns]
            added: list[tuple[Node, MeasurementTerm]] = [(anchor, past.fuse(item)) for item in old]
            live = [item for item in measurements if item.stamp_ns >= anchor.stamp_ns]
            guesses = {item.stamp_ns: self.state_at(item.stamp_ns)[0] for item in live}
            for item in live:
                at = chain.at(item.stamp_ns)
                if at is None:
                    at = chain.insert(item.stamp_ns, guesses[item.stamp_ns])
                    new[at.key] = at.origin
                added.append((at, item))
            self._solve(moved, added, new, leaving, past.prior)
        except _BROKEN as error:
            chain.remove(new)
            self._rebuild(self._estimates())
            self.num_rebuilt += 1
            raise RuntimeError(f"the graph cannot be solved with the new measurements ({error})") from error
        past.forget_before(reach_ns)
        self._past = past
        chain.drop(len(leaving))
        for node, term in added:
            node.terms.append(term)
        return left

    def state_at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance at any stamp from `reach_ns` on: interpolated in the past, predicted ahead."""
        state = self._states.get(stamp_ns)
        if state is None:
            state = self._states[stamp_ns] = self._state_at(stamp_ns)
        return state

    def _state_at(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        place = self._chain.place(stamp_ns)
        if place < 0:
            anchor = self._chain.oldest
            return self._past.state_at(stamp_ns, self._mean(anchor), self._covariance(anchor))
        node = self._chain.nodes[place]
        mean = self._mean(node)
        if node.stamp_ns == stamp_ns:
            return mean, self._covariance(node)
        until_s = seconds(stamp_ns - node.stamp_ns)
        if node is self._chain.newest:
            return predict_one(mean, self._covariance(node), self._motion, until_s)
        right = self._chain.nodes[place + 1]
        after_s = seconds(right.stamp_ns - stamp_ns)
        inner = between(self._motion, mean.tolist(), self._mean(right), until_s, after_s)
        weights = np.hstack([inner.Lambda, inner.Psi])
        return inner.mean, propagated(weights, self._covariance(node, right), inner.Sigma)

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
        self.num_damped += 1

    def iterate(self, max_iterations: int) -> None:
        """Take Gauss-Newton steps while a state is further than a threshold from its linearisation point."""
        for _ in range(max_iterations):
            moved = self._moved()
            if not moved:
                return
            self._solve(moved, [], {}, [], self._past.prior)

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
        self._past = MarginalisedPast(self._motion, self._first_ns, Prior(mean, prior.covariance), self._follows)
        self._rebuild(means)

    def _rebuild(
        self, means: Mapping[int, FloatArray], make_backend: Callable[[FloatArray], Backend] | None = None
    ) -> None:
        """Build the graph anew from the window's own records, near `means` by key, if wanted in another backend."""
        nodes = self._chain.nodes
        self._backend, self._anchored = (make_backend or self._make_backend)(self._thresholds), False
        segments = list(pairwise(nodes))
        for node in nodes:
            node.origin = means[node.key]
        factors = [self._segment(left, right) for left, right in segments]
        factors.append(prior_factor(nodes[0].key, self._past.prior.mean, self._past.prior.covariance))
        factors += [measurement_factor(node.key, item, means[node.key]) for node in nodes for item in node.terms]
        stamps_s = {node.key: self._seconds(node.stamp_ns) for node in nodes}
        slots = self._backend.update(Change(dict(means), stamps_s, factors, []))
        for (left, _), slot in zip(segments, slots, strict=False):
            left.slot = slot
        self._forget_estimates()

    def _states_behind(self, past: MarginalisedPast, anchor: Node, leaving: Sequence[Node]) -> list[TrackState]:
        if not leaving:
            return []
        mean, covariance = self._mean(anchor), self._covariance(anchor)
        return [TrackState(node.stamp_ns, *past.state_at(node.stamp_ns, mean, covariance)) for node in leaving]

    def _solve(
        self,
        moved: Sequence[tuple[Node, FloatArray]],
        added: Sequence[tuple[Node, MeasurementTerm]],
        new: dict[int, FloatArray],
        leaving: Sequence[Node],
        prior: Prior,
    ) -> None:
        """Update the backend, and note the slots of the new segments and of those whose noise follows a moved node."""
        nodes, changed = self._chain.nodes, set(new)
        for node, mean in moved:
            node.origin = mean
            changed.add(node.key)
        segments = [pair for pair in pairwise(nodes) if pair[0].key in changed or pair[1].key in new]
        removed = [left.slot for left, _ in segments if left.slot is not None]
        factors = [self._segment(left, right) for left, right in segments]
        for node, term in added:
            mean = new[node.key] if node.key in new else self._mean(node)
            factors.append(measurement_factor(node.key, term, mean))
        stamps_s = {node.key: self._seconds(node.stamp_ns) for node in nodes if node.key in new}
        marginalised = None
        if leaving:
            oldest = nodes[len(leaving)]
            marginalised = Marginalised(
                [node.key for node in leaving],
                0.5 * (self._seconds(leaving[-1].stamp_ns) + self._seconds(oldest.stamp_ns)),
                prior_factor(oldest.key, prior.mean, prior.covariance),
            )
        slots = self._backend.update(Change(new, stamps_s, factors, removed, marginalised))
        for (left, _), slot in zip(segments, slots, strict=False):
            left.slot = slot
        self._anchored |= bool(leaving)
        self._forget_estimates()

    def _moved(self) -> list[tuple[Node, FloatArray]]:
        """The nodes that the next update of the backend relinearises, and where."""
        free = self._chain.nodes[self._anchored :]
        if not free:
            return []
        moves = self._backend.moves([node.key for node in free])
        far = np.flatnonzero((np.abs(moves) > self._thresholds).any(axis=1))
        return [(free[place], free[place].origin + moves[place]) for place in far]

    def _segment(self, left: Node, right: Node) -> gtsam.NonlinearFactor:
        dt_s = seconds(right.stamp_ns - left.stamp_ns)
        make = map_motion_factor if self._follows else motion_factor
        return make(self._motion, left.key, right.key, dt_s, left.origin)

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
        mean = self._means.get(node.key)
        if mean is None:
            mean = self._means[node.key] = self._backend.mean(node.key)
        return mean

    def _covariance(self, *nodes: Node) -> FloatArray:
        keys = tuple(node.key for node in nodes)
        covariance = self._covariances.get(keys)
        if covariance is None:
            covariance = self._covariances[keys] = self._backend.covariance(keys)
        return covariance

    def _forget_estimates(self) -> None:
        self._means.clear()
        self._covariances.clear()
        self._states.clear()
