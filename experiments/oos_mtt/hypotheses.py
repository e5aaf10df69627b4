"""Reference tracker of the benchmark: a few global hypotheses of Bernoulli tracks, in the order of the stamps.

Source: Williams, "Marginal multi-Bernoulli filters", IEEE T-AES 51(3), 2015, and
Garcia-Fernandez, Williams, Granstrom, Svensson, "Poisson multi-Bernoulli mixture
filter", IEEE T-AES 54(4), 2018. The tracker is written for clarity, in NumPy alone, and
shares no code with fgtrack. It knows the model of the scenes.
"""

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from scenes import (
    MODEL,
    Scene,
    Trajectory,
    transition,
)
from scipy.optimize import linear_sum_assignment

from fgtrack import FloatArray

_H = np.eye(2, 4)
_R = MODEL.std_m**2 * np.eye(2)
_BIRTH_COVARIANCE = np.diag(np.square(MODEL.birth_std))
_LEAST_EXISTENCE = 1e-4
_LEAST_DENSITY = 1e-5
_LEAST_WEIGHT = 1e-4
"""Tracks, unseen objects and hypotheses below these probabilities are dropped."""
_FORBIDDEN = 1e9


@dataclass(frozen=True)
class Gaussian:
    """A state x, y, vx, vy with its covariance."""

    mean: FloatArray
    covariance: FloatArray

    def after(self, dt_s: float) -> "Gaussian":
        """Return the prediction."""
        forward, noise = transition(dt_s)
        return Gaussian(
            forward @ self.mean, forward @ self.covariance @ forward.T + noise
        )

    def densities(self, points_m: FloatArray) -> FloatArray:
        """Return the density of each point, shape (n,)."""
        spread = _H @ self.covariance @ _H.T + _R
        apart = points_m - self.mean[:2]
        nis = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(spread), apart)
        norm = 2.0 * math.pi * math.sqrt(np.linalg.det(spread))
        return np.asarray(np.exp(-0.5 * nis) / norm)

    def given(self, point_m: FloatArray) -> "Gaussian":
        """Return the posterior."""
        spread = _H @ self.covariance @ _H.T + _R
        gain = self.covariance @ _H.T @ np.linalg.inv(spread)
        return Gaussian(
            self.mean + gain @ (point_m - self.mean[:2]),
            self.covariance - gain @ spread @ gain.T,
        )


@dataclass(frozen=True)
class Unseen:
    """Expected number of objects that no scan has shown, with their density."""

    number: float
    state: Gaussian


@dataclass(frozen=True, eq=False)
class Node:
    """A track up to a scan: the state now, and the detection of this scan or None."""

    state: Gaussian
    existed: float
    """Probability that the object has ever existed."""
    alive: float
    """Probability that the object exists now, if it has ever existed."""
    detection: tuple[float, FloatArray] | None
    parent: "Node | None"
    prior: Gaussian
    """State before the first detection."""

    def detections(self) -> list[tuple[float, FloatArray]]:
        """Return stamp and position of all detections, oldest first."""
        found = []
        node: Node | None = self
        while node is not None:
            if node.detection is not None:
                found.append(node.detection)
            node = node.parent
        return found[::-1]


Hypothesis = tuple[Node, ...]


def trajectories(scene: Scene, num_hypotheses: int) -> list[Trajectory]:
    """Return the final smoothed trajectories of the best hypothesis, at the times of the truth."""
    best: Hypothesis = ()
    for weighted in hypotheses(scene, num_hypotheses):
        best = weighted[0][1]
    return [_smoothed(node, scene) for node in best if node.existed > 0.5]


def hypotheses(
    scene: Scene, num_hypotheses: int
) -> Iterator[list[tuple[float, Hypothesis]]]:
    """Yield the hypotheses with their log-probabilities after each scan, the best one first."""
    unseen: list[Unseen] = []
    kept: list[tuple[float, Hypothesis]] = [(0.0, ())]
    before_s: float | None = None
    for scan in scene.in_order().scans:
        dt_s = scan.stamp_s if before_s is None else scan.stamp_s - before_s
        before_s = scan.stamp_s
        survival = math.exp(-MODEL.deaths_per_s * dt_s)
        unseen = [
            Unseen(each.number * survival, each.state.after(dt_s))
            for each in unseen
            if each.number > _LEAST_DENSITY
        ]
        new = MODEL.appearances_per_s / MODEL.deaths_per_s * (1.0 - survival)
        unseen.append(
            Unseen(new, Gaussian(np.array(MODEL.birth_mean), _BIRTH_COVARIANCE))
        )
        born, log_new = _births(unseen, scan.stamp_s, scan.points_m)
        children = {
            node: _children(node, dt_s, survival, scan.stamp_s, scan.points_m)
            for node in {node for _, tracks in kept for node in tracks}
        }
        kept = _best(kept, children, born, log_new, num_hypotheses)
        unseen = [
            Unseen(each.number * (1.0 - MODEL.detection_probability), each.state)
            for each in unseen
        ]
        yield kept


def _births(
    unseen: Sequence[Unseen], stamp_s: float, points_m: FloatArray
) -> tuple[list[Node | None], FloatArray]:
    """Return the new track of each point, and the log-density of a point without an old track, shape (n,)."""
    parts = np.array(
        [
            each.number * MODEL.detection_probability * each.state.densities(points_m)
            for each in unseen
        ]
    )
    of_objects = parts.sum(axis=0)
    total = of_objects + MODEL.clutter_per_m2
    born: list[Node | None] = []
    for index, point_m in enumerate(points_m):
        existed = float(of_objects[index] / total[index])
        prior = unseen[int(parts[:, index].argmax())].state
        born.append(
            Node(prior.given(point_m), existed, 1.0, (stamp_s, point_m), None, prior)
            if existed > _LEAST_EXISTENCE
            else None
        )
    return born, np.log(total)


def _children(
    node: Node, dt_s: float, survival: float, stamp_s: float, points_m: FloatArray
) -> dict[int | None, tuple[float, Node]]:
    """Return log-likelihood and track of each possible detection by its index; None for a miss."""
    state = node.state.after(dt_s)
    alive = node.alive * survival
    unseen = 1.0 - alive * MODEL.detection_probability
    missed = 1.0 - node.existed * alive * MODEL.detection_probability
    children: dict[int | None, tuple[float, Node]] = {
        None: (
            math.log(missed),
            Node(
                state,
                node.existed * unseen / missed,
                alive * (1.0 - MODEL.detection_probability) / unseen,
                None,
                node,
                node.prior,
            ),
        )
    }
    now = node.existed * alive
    if now > _LEAST_EXISTENCE:
        densities = state.densities(points_m)
        for index in np.flatnonzero(densities > 1e-8).tolist():
            likelihood = now * MODEL.detection_probability * float(densities[index])
            point_m = points_m[index]
            track = Node(
                state.given(point_m), 1.0, 1.0, (stamp_s, point_m), node, node.prior
            )
            children[index] = math.log(likelihood), track
    return children


def _best(
    kept: Sequence[tuple[float, Hypothesis]],
    children: dict[Node, dict[int | None, tuple[float, Node]]],
    born: Sequence[Node | None],
    log_new: FloatArray,
    num_hypotheses: int,
) -> list[tuple[float, Hypothesis]]:
    """Return the best successors of the hypotheses, with normalised log-probabilities."""
    found: dict[frozenset[Node], tuple[float, Hypothesis]] = {}
    for log_weight, tracks in kept:
        wanted = max(1, math.ceil(num_hypotheses * math.exp(log_weight)))
        for log_ratio, taken in _assignments(tracks, children, log_new, wanted):
            successors = [
                children[node][taken.get(number)][1]
                for number, node in enumerate(tracks)
            ]
            used = set(taken.values())
            successors += [
                node
                for index, node in enumerate(born)
                if node is not None and index not in used
            ]
            likely = tuple(
                node for node in successors if node.existed > _LEAST_EXISTENCE / 10.0
            )
            key = frozenset(likely)
            weight = log_weight + log_ratio
            if key in found:
                weight = float(np.logaddexp(found[key][0], weight))
            found[key] = weight, likely
    ranked = sorted(found.values(), key=lambda each: -each[0])[:num_hypotheses]
    least = ranked[0][0] + math.log(_LEAST_WEIGHT)
    ranked = [each for each in ranked if each[0] > least]
    total = np.logaddexp.reduce([weight for weight, _ in ranked])
    return [(weight - float(total), tracks) for weight, tracks in ranked]


def _assignments(
    tracks: Hypothesis,
    children: dict[Node, dict[int | None, tuple[float, Node]]],
    log_new: FloatArray,
    wanted: int,
) -> list[tuple[float, dict[int, int]]]:
    """Return the best assignments of points to tracks: log-likelihood, and the point of each track that has one."""
    missed = sum(children[node][None][0] for node in tracks)
    rows = [number for number, node in enumerate(tracks) if len(children[node]) > 1]
    if not rows:
        return [(missed, {})]
    points = sorted(
        {
            index
            for number in rows
            for index in children[tracks[number]]
            if index is not None
        }
    )
    cost = np.full((len(rows), len(points) + len(rows)), _FORBIDDEN)
    for row, number in enumerate(rows):
        own = children[tracks[number]]
        cost[row, len(points) + row] = 0.0
        for index, (log_likelihood, _) in own.items():
            if index is not None:
                gain = log_likelihood - own[None][0] - log_new[index]
                cost[row, points.index(index)] = -gain
    return [
        (
            missed - value,
            {
                rows[row]: points[column]
                for row, column in enumerate(columns)
                if column < len(points)
            },
        )
        for value, columns in murty(cost, wanted)
    ]


def murty(cost: FloatArray, wanted: int) -> list[tuple[float, list[int]]]:
    """Return the assignments with the lowest costs, best first: cost, and the column of each row.

    Source: Murty, "An algorithm for ranking all the assignments in order of increasing
    cost", Operations Research 16(3), 1968.
    """
    found: list[tuple[float, list[int]]] = []
    heap: list[tuple[float, int, list[int], FloatArray]] = []
    numbers = count()  # of entries with equal costs the earlier one comes first

    def add(restricted: FloatArray) -> None:
        rows, columns = linear_sum_assignment(restricted)
        value = float(restricted[rows, columns].sum())
        if value < _FORBIDDEN / 10.0:
            heapq.heappush(heap, (value, next(numbers), columns.tolist(), restricted))

    add(cost)
    while heap and len(found) < wanted:
        value, _, columns, restricted = heapq.heappop(heap)
        found.append((value, columns))
        restricted = restricted.copy()
        for row, column in enumerate(columns):
            without = restricted.copy()
            without[row, column] = _FORBIDDEN
            add(without)
            own = restricted[row, column]
            restricted[row] = restricted[:, column] = _FORBIDDEN
            restricted[row, column] = own
    return found


def _smoothed(node: Node, scene: Scene) -> Trajectory:
    """Return the smoothed positions from the first to the last detection (Rauch, Tung, Striebel)."""
    detections = dict(node.detections())
    first_s, last_s = min(detections), max(detections)
    stamps_s = sorted(
        {scan.stamp_s for scan in scene.scans if first_s <= scan.stamp_s <= last_s}
    )
    states = [node.prior]
    predicted = [node.prior]
    for number, stamp_s in enumerate(stamps_s):
        ahead = (
            node.prior
            if not number
            else states[-1].after(stamp_s - stamps_s[number - 1])
        )
        predicted.append(ahead)
        point_m = detections.get(stamp_s)
        states.append(ahead if point_m is None else ahead.given(point_m))
    smooth = states[-1].mean
    positions_m = {stamps_s[-1]: smooth[:2]}
    for number in range(len(stamps_s) - 2, -1, -1):
        forward, _ = transition(stamps_s[number + 1] - stamps_s[number])
        now, ahead = states[number + 1], predicted[number + 2]
        gain = now.covariance @ forward.T @ np.linalg.inv(ahead.covariance)
        smooth = now.mean + gain @ (smooth - ahead.mean)
        positions_m[stamps_s[number]] = smooth[:2]
    return {
        index: positions_m[stamp_s]
        for index, stamp_s in enumerate(scene.times_s.tolist())
        if stamp_s in positions_m
    }
