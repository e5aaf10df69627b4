"""The iterated posterior linearisation smoother, over a window."""

import bisect
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.linalg import product, symmetrise
from fgtrack.core.time import NS_PER_S, seconds
from fgtrack.core.types import YAW, FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.ekf import OneCorrection, Prediction
from fgtrack.estimation.initiation import DEFAULT, SMOOTHER_ITERATIONS, Line, Search, along, fixes_of
from fgtrack.estimation.iteration import Iteration, largest_move, reweighted
from fgtrack.estimation.rts import rts_step
from fgtrack.estimation.sigma_points import Regression, measurement_regression, motion_regression
from fgtrack.estimation.ukf import UkfRecursion
from fgtrack.estimation.windowed import WindowedFilter
from fgtrack.models.motion import MotionModel

_INITIATION = Iteration(SMOOTHER_ITERATIONS, 1e-3)
#: Of the covariance, as spread of the states along a line, at which everything is linearised first.
_NARROW = 1e-6


@dataclass(frozen=True, slots=True)
class _Node:
    """The state at a stamp at which something was measured; yaws run on from node to node and are not wrapped."""

    stamp_ns: int
    measurements: tuple[Measurement, ...]
    mean: FloatArray
    """Smoothed; where everything is linearised next, over the spread of `covariance`."""
    covariance: FloatArray
    predicted: Prediction
    """From the node before; of the first node, from all that the window has forgotten."""
    filtered: tuple[FloatArray, FloatArray]
    """With the measurements up to this node."""


class PosteriorLinearisationSmoother(WindowedFilter):
    """Iterated posterior linearisation smoother over a window: averages over the spread of the smoothed states.

    Garcia-Fernandez, Svensson and Sarkka, Iterated posterior linearization smoother, IEEE Transactions on Automatic
    Control 62(4), 2017. Motion and measurements are regressed over the smoothed state of each stamp (see `regression`),
    the Kalman filter and the smoother of Rauch, Tung and Striebel solve the affine chain, and so on, a few times at
    each update. What the window forgets stays as the prediction of its first node.

    Parameters
    ----------
    motion, prior, lag_s
        See `WindowedFilter`.
    max_iterations
        Passes per update.
    tolerance
        Where all states move by less than this many standard deviations, the passes end.
    initiation
        How the direction of travel is found where `prior` gives none, see `Initiation`.
    """

    exact = "any lag, any number"
    nonlinear = "at convergence"
    smooths = True
    spreads = True
    solves = "ipls"
    initiates = True
    reports = True

    def __init__(
        self,
        motion: MotionModel,
        prior: Start,
        lag_s: float,
        max_iterations: int = 2,
        tolerance: float = 1e-3,
        initiation: str = DEFAULT,
    ) -> None:
        super().__init__(motion, prior, lag_s)
        self._iteration, self._recursion = Iteration(max_iterations, tolerance), UkfRecursion(motion)
        x, P = initial_state(motion, prior)
        self._nodes = [_Node(prior.stamp_ns, (), x, P, Prediction(x, P, P), (x, P))]
        self._first = prior.stamp_ns, x, P
        self._search = Search.of(motion, prior, initiation)
        self._final: list[TrackState] = []

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: smoothed, between two nodes and ahead of the newest under the motion model."""
        mean, covariance = self._state(stamp_ns)
        return TrackState(stamp_ns, self._wrapped(mean), covariance.copy())

    def take_final(self) -> list[TrackState]:
        """Smoothed states of the nodes that have left the window since the last call, in order."""
        final, self._final = self._final, []
        return final

    def take_rest(self) -> list[TrackState]:
        """Like `take_final`, and of the nodes that are still inside: for when the track ends."""
        return self.take_final() + [self.state_at(node.stamp_ns) for node in self._nodes]

    def converge(self, max_iterations: int = 50) -> None:
        """Pass until nothing moves; for comparisons."""
        self._nodes = self._iterated(self._nodes, Iteration(max_iterations, 1e-9))

    def _fuse(self, measurement: Measurement) -> OneCorrection:
        mean, covariance = self._state(measurement.stamp_ns)
        found = self._recursion.innovation(mean, covariance, measurement)
        nodes = self._with(measurement, mean, covariance)
        search = self._search
        if search is not None:
            nodes, search = self._begun(nodes, search, measurement.stamp_ns)
        nodes = self._iterated(nodes, self._iteration)
        if not all(np.isfinite(node.mean.dot(node.mean) + np.vdot(node.covariance, node.covariance)) for node in nodes):
            raise np.linalg.LinAlgError("smoothed state is not finite")
        self._nodes, self._search = nodes, search
        return OneCorrection(mean, covariance, found.innovation, found.nis, S=found.S)

    def _forget_before(self, stamp_ns: int) -> None:
        gone = self._place(stamp_ns)
        self._final += [self.state_at(node.stamp_ns) for node in self._nodes[:gone]]
        del self._nodes[:gone]

    def _place(self, stamp_ns: int) -> int:
        """Place of the last node that is not after `stamp_ns`; of the first one, where all are."""
        return max(bisect.bisect_right(self._nodes, stamp_ns, key=lambda node: node.stamp_ns) - 1, 0)

    def _with(self, measurement: Measurement, mean: FloatArray, covariance: FloatArray) -> list[_Node]:
        """The nodes with `measurement`, at a stamp where the state was `mean` (n,) and `covariance` (n, n)."""
        nodes, place = list(self._nodes), self._place(measurement.stamp_ns)
        node = nodes[place]
        if node.stamp_ns != measurement.stamp_ns:
            predicted = Prediction(mean, covariance, covariance)
            node = _Node(measurement.stamp_ns, (), mean, covariance, predicted, (mean, covariance))
            place += 1
            nodes.insert(place, node)
        found = tuple(sorted((*node.measurements, measurement), key=lambda each: each.order))
        nodes[place] = replace(node, measurements=found)
        return nodes

    def _state(self, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance at `stamp_ns`; the yaw runs on from that of the node before."""
        place = self._place(stamp_ns)
        node = self._nodes[place]
        if node.stamp_ns == stamp_ns:
            return node.mean, node.covariance
        if place + 1 == len(self._nodes):
            return self._recursion.predict(node.mean, node.covariance, seconds(stamp_ns - node.stamp_ns))[:2]
        after = self._nodes[place + 1]
        smoothed = self._recursion.predict(node.mean, node.covariance, seconds(stamp_ns - node.stamp_ns))
        first = self._moved(node.filtered, (node.mean, node.covariance), seconds(stamp_ns - node.stamp_ns))
        x, P = first.mean, first.covariance
        second = self._moved((x, P), smoothed[:2], seconds(after.stamp_ns - stamp_ns))
        return rts_step(x, P, second, after.mean - second.mean, after.covariance)[:2]

    def _moved(
        self, state: tuple[FloatArray, FloatArray], over: tuple[FloatArray, FloatArray], dt_s: float
    ) -> Prediction:
        """`state` after `dt_s`, under the motion as it is on average over another state."""
        regressed = motion_regression(self._motion, *over, dt_s)
        return _through(state, over[0], regressed, self._motion.process_noise(over[0], dt_s))

    def _iterated(self, nodes: list[_Node], iteration: Iteration) -> list[_Node]:
        """The nodes after passes over them."""
        for _ in range(iteration.max_iterations):
            before, nodes = nodes, self._smoothed(self._filtered(nodes))
            steps = np.array([node.mean - old.mean for node, old in zip(nodes, before, strict=True)])
            if largest_move(steps, np.array([node.covariance for node in nodes])) < iteration.tolerance:
                break
        return nodes

    @staticmethod
    def _smoothed(nodes: Sequence[_Node]) -> list[_Node]:
        """The nodes with new smoothed states."""
        mean, covariance = nodes[-1].filtered
        found = [replace(nodes[-1], mean=mean, covariance=covariance)]
        for node, after in zip(nodes[-2::-1], nodes[:0:-1], strict=True):
            mean, covariance, _ = rts_step(*node.filtered, after.predicted, mean - after.predicted.mean, covariance)
            found.append(_Node(node.stamp_ns, node.measurements, mean, covariance, node.predicted, node.filtered))
        return found[::-1]

    def _filtered(self, nodes: Sequence[_Node]) -> list[_Node]:
        """The nodes with new `predicted` and `filtered`."""
        means, covariances = np.array([node.mean for node in nodes]), np.array([node.covariance for node in nodes])
        gaps_s = np.diff([node.stamp_ns for node in nodes]) / NS_PER_S
        if len(nodes) > 1:
            steps = motion_regression(self._motion, means[:-1], covariances[:-1], gaps_s)
            Q = self._motion.process_noise(means[:-1], gaps_s)
        found: list[_Node] = []
        for place, node in enumerate(nodes):
            predicted = node.predicted
            if place:
                step = Regression(*(part[place - 1] for part in steps))
                predicted = _through(found[-1].filtered, means[place - 1], step, Q[place - 1])
            state = predicted.mean, predicted.covariance
            for measurement in node.measurements:
                state = self._updated(state, node, measurement)
            found.append(_Node(node.stamp_ns, node.measurements, node.mean, node.covariance, predicted, state))
        return found

    def _updated(
        self, state: tuple[FloatArray, FloatArray], node: _Node, measurement: Measurement
    ) -> tuple[FloatArray, FloatArray]:
        """`state` after `measurement`, as that is on average over the smoothed state of its node."""
        z, A, noise = measurement_regression(measurement, node.mean, node.covariance)
        residual, R = measurement.model.residual(measurement.z, z), measurement.R + noise
        return reweighted(*state, residual, A, R, measurement.loss, node.mean - state[0])[:2]

    def _begun(self, nodes: list[_Node], search: Search, new_ns: int) -> tuple[list[_Node], Search | None]:
        """The nodes, begun again along a straight line where the new stamp asks for it, and how the search goes on."""
        first_ns, mean, covariance = self._first
        if nodes[0].stamp_ns != first_ns:
            return nodes, None
        later = [(seconds(node.stamp_ns - first_ns), each) for node in nodes for each in node.measurements]
        found = search.next_line(lambda: fixes_of(mean, covariance, later), new_ns)
        if found is None:
            return nodes, search
        line, search = found
        return self._iterated(self._along(line, nodes), _INITIATION), search

    def _along(self, line: Line, nodes: Sequence[_Node]) -> list[_Node]:
        """The nodes on `line`; the prior's heading, which must be vague, is turned there."""
        found = []
        for node in nodes:
            mean = along(line, seconds(node.stamp_ns - self._first[0]), self._motion.state_names)
            found.append(replace(node, mean=mean, covariance=_NARROW * node.covariance))
        prior = nodes[0].predicted.mean.copy()
        if not self._motion.cartesian:
            prior[YAW] = found[0].mean[YAW]
        found[0] = replace(found[0], predicted=nodes[0].predicted._replace(mean=prior))
        return found


def _through(state: tuple[FloatArray, FloatArray], origin: FloatArray, step: Regression, Q: FloatArray) -> Prediction:
    """`state` through an affine step that was regressed at `origin` (n,), with the process noise Q (n, n)."""
    mean, P = state
    AP = product(step.A, P)
    covariance = symmetrise(product(AP, step.A.T) + step.noise + Q)
    return Prediction(step.mean + step.A.dot(mean - origin), covariance, AP)
