"""Hypotheses about the tracks after each object list: a Poisson multi-Bernoulli mixture.

A hypothesis assigns each detection up to a list to a track, to a new track, or to clutter. The
few best hypotheses are kept. A track of a hypothesis is a Bernoulli component: the probability
that its object has ever existed, the probability that the object still exists, and a Gaussian
state.

Sources: Williams, "Marginal multi-Bernoulli filters", IEEE T-AES 51(3), 2015, and
Garcia-Fernandez, Williams, Granstrom, Svensson, "Poisson multi-Bernoulli mixture filter",
IEEE T-AES 54(4), 2018.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import kernels, stacked
from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import StatesAt
from fgtrack.estimation.filters.ekf import propagated
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import compiled_form
from fgtrack.tracking.association import near, reaches_m
from fgtrack.tracking.decisions.entries import NOTHING, Description, Entry
from fgtrack.tracking.decisions.ranking import LARGEST_LOSS, best_assignments
from fgtrack.tracking.lives.existence import densities
from fgtrack.tracking.lives.latency import Views
from fgtrack.tracking.objects import differ
from fgtrack.tracking.preprocess import Group

_KALMAN = "fgtrack.estimation.kernels.kalman"
_GATE_PROBABILITY = 0.99999
_LEAST_GAIN = -LARGEST_LOSS
_LEAST_UNSEEN = 1e-5
NONE = -1
_HULL_STD_MPS = 0.5
"""Standard deviation of the velocity between both ends of a hull that turns."""


@dataclass(frozen=True)
class BirthPrior:
    """Objects that appear: their rate, and mean and covariance of their first state."""

    per_s: float
    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Returns:
    """Second returns of a sensor."""

    share: float
    std_m: float
    log_new_per_m2: float
    """Logarithm of the density of new objects in a list."""
    detection_probability: float

    def log_seen(self, hits: int, misses: int) -> float:
        """Return the log-likelihood ratio of an object against second returns, of detections in `hits` lists.

        An object is detected with its probability. Each hull has a share of second returns of its own, which has a
        beta distribution of the strength of two lists.
        """
        a, b = 2.0 * self.share, 2.0 * (1.0 - self.share)
        own = hits * math.log(self.detection_probability) + misses * math.log1p(
            -self.detection_probability
        )
        return own - _log_beta(a + hits, b + misses) + _log_beta(a, b)


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@dataclass(frozen=True)
class Rules:
    """Numbers of the decisions."""

    motion: MotionModel
    views: Views
    most: int
    lifetime_s: float
    visible_share: float
    visible_s: float
    out_of_view_s: float
    hidden_s: float
    least_existence: float
    confirm_probability: float
    birth_odds: float
    min_travel_m: float
    speed_std_mps: float
    returns: Mapping[int, Returns]
    """By sensor."""
    prior: BirthPrior | None = None


@dataclass(frozen=True)
class Nodes:
    """Tracks of all hypotheses at the stamp of a list. Arrays have n tracks."""

    means: FloatArray
    covariances: FloatArray
    existed: FloatArray
    """Probability that the object has ever existed."""
    alive: FloatArray
    """Probability that the object still exists, if it has ever existed."""
    visible: FloatArray
    """Probability that the object is visible to each sensor, shape (n, sensors)."""
    is_confirmed: BoolArray
    has_travelled: BoolArray
    first_m: FloatArray
    """First positions, shape (n, 2)."""
    roots: IntArray
    """Numbers of the tracks: of the detections that started them."""
    hazards_hz: FloatArray
    """Rates at which the probability of existence decays until the next list."""
    counts: IntArray
    """Numbers of detections by `sensors`."""
    misses: IntArray
    """Numbers of lists of `sensors` in whose view the object was, without a detection."""
    sensors: IntArray
    """Numbers of the sensors that started the tracks."""
    own: FloatArray
    """Probability that the track is no second return of another track."""
    descriptions: tuple[Description, ...]

    def at(self, rows: IntArray) -> "Nodes":
        """Return the tracks in `rows`."""
        return Nodes(
            self.means.take(rows, axis=0),
            self.covariances.take(rows, axis=0),
            self.existed.take(rows),
            self.alive.take(rows),
            self.visible.take(rows, axis=0),
            self.is_confirmed.take(rows),
            self.has_travelled.take(rows),
            self.first_m.take(rows, axis=0),
            self.roots.take(rows),
            self.hazards_hz.take(rows),
            self.counts.take(rows),
            self.misses.take(rows),
            self.sensors.take(rows),
            self.own.take(rows),
            tuple([self.descriptions[row] for row in rows.tolist()]),
        )


class Ended(NamedTuple):
    """A track that has ended."""

    root: int
    probability: float
    """Probability that the object has ever existed."""
    is_confirmed: bool


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of all detections up to a list."""

    log_weight: float
    rows: IntArray
    """Rows of its tracks that may still exist."""
    taken: tuple[int, ...]
    """Track of each candidate of the list, by root; `NONE` for clutter."""
    parent: int
    """Index of the hypothesis of the step before."""
    ended: tuple[Ended, ...] = ()
    """Tracks that end with this list."""


@dataclass(frozen=True)
class Step:
    """Hypotheses after a list, the best one first."""

    stamp_ns: int
    entry: Entry | None
    nodes: Nodes
    hypotheses: tuple[Hypothesis, ...]
    unseen: tuple[tuple[float, FloatArray, FloatArray], ...] = ()
    """Expected number, mean and covariance of the objects that no list has shown."""


def first_step(motion: MotionModel, num_sensors: int, stamp_ns: int) -> Step:
    """Return the step before the first list, without tracks."""
    n = motion.dim
    nodes = Nodes(
        np.zeros((0, n)),
        np.zeros((0, n, n)),
        np.zeros(0),
        np.zeros(0),
        np.zeros((0, num_sensors)),
        np.zeros(0, dtype=bool),
        np.zeros(0, dtype=bool),
        np.zeros((0, 2)),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0, dtype=np.int64),
        np.zeros(0),
        (),
    )
    return Step(
        stamp_ns, None, nodes, (Hypothesis(0.0, np.zeros(0, dtype=np.int64), (), 0),)
    )


@dataclass
class _Table:
    """Log-likelihoods of a list."""

    rows: IntArray
    """Track of each pair."""
    columns: IntArray
    """Candidate of each pair."""
    gains: FloatArray
    """Log-likelihood ratio of each pair to a missed track and a candidate without a track."""
    log_missed: FloatArray
    """Log-likelihood of each track without a candidate."""
    log_free: FloatArray
    """Log-density of each candidate without a track."""
    born: FloatArray
    """Probability that each candidate without a track is a new object."""
    detectable: FloatArray
    """Probability that each track is detected, if it exists."""
    in_view: BoolArray
    jumps: set[tuple[int, int]]
    """Pairs whose correlated error is probably new."""
    by_node: dict[int, list[tuple[int, float]]] = field(default_factory=dict)


def following(before: Step, entry: Entry, rules: Rules) -> Step:
    """Return the step after the list `entry`, which is not older than the step `before`."""
    stamp_ns, sensor = entry.batch.stamp_ns, entry.sensor
    dt_s = 0.0 if before.entry is None else seconds(stamp_ns - before.stamp_ns)
    nodes = _predicted(before.nodes, dt_s, rules)
    views = rules.views.of(nodes.means[:, :2], entry.scan.ego)
    unseen = _unseen(before, dt_s, rules)
    returns = second_returns(entry, nodes, before.hypotheses[0].rows, rules)
    table = _table(nodes, entry, views[:, entry.index], unseen, returns, rules)
    born = (table.born >= rules.least_existence).nonzero()[0].tolist()
    kept = _ranked(before, table, born, rules)
    result, hypotheses = _updated(nodes, entry, views, table, unseen, kept, rules)
    if sensor.gives_position and sensor.scan:
        unseen = tuple(
            (number * (1.0 - sensor.detection_probability), mean, P)
            for number, mean, P in unseen
        )
    return Step(stamp_ns, entry, result, hypotheses, unseen)


def _predicted(nodes: Nodes, dt_s: float, rules: Rules) -> Nodes:
    """Return the tracks `dt_s` later."""
    if not len(nodes.roots) or dt_s == 0.0:
        return nodes
    mean, F, Q = rules.motion.transition(nodes.means, np.full(len(nodes.means), dt_s))
    covariances, _ = kernels(_KALMAN).predict(F, nodes.covariances, Q)
    forgotten = math.exp(-dt_s / rules.visible_s)
    visible = rules.visible_share + (nodes.visible - rules.visible_share) * forgotten
    alive = nodes.alive * np.exp(-nodes.hazards_hz * dt_s)
    return replace(
        nodes, means=mean, covariances=covariances, alive=alive, visible=visible
    )


def _unseen(
    before: Step, dt_s: float, rules: Rules
) -> tuple[tuple[float, FloatArray, FloatArray], ...]:
    """Return the objects that no list has shown, and that have appeared, `dt_s` after a step."""
    prior = rules.prior
    if prior is None:
        return ()
    survival = math.exp(-dt_s / rules.lifetime_s)
    found = []
    kept = [each for each in before.unseen if each[0] > _LEAST_UNSEEN]
    if kept:
        numbers, means, covariances = zip(*kept, strict=True)
        x, F, Q = rules.motion.transition(np.array(means), np.full(len(kept), dt_s))
        P = propagated(F, np.array(covariances), Q)
        found = [
            (number * survival, *each)
            for number, *each in zip(numbers, x, P, strict=True)
        ]
    is_first = before.entry is None
    appeared = prior.per_s * rules.lifetime_s * (1.0 if is_first else 1.0 - survival)
    found.append((appeared, prior.mean, prior.covariance))
    return tuple(found)


def _table(
    nodes: Nodes,
    entry: Entry,
    in_view: BoolArray,
    unseen: Sequence[tuple[float, FloatArray, FloatArray]],
    returns: FloatArray,
    rules: Rules,
) -> _Table:
    """Return the log-likelihoods of a list."""
    sensor = entry.sensor
    detectable = sensor.detection_probability * nodes.visible[:, entry.index]
    now = nodes.existed * nodes.alive
    misses = sensor.gives_position and sensor.scan and entry.batch.last
    missed = (
        np.where(in_view, 1.0 - now * detectable, 1.0) if misses else np.ones(len(now))
    )
    log_free, born = _free(entry, unseen, returns, rules)
    rows, columns, log_densities, jumps = _pairs(nodes, entry)
    more = _described(nodes, entry, rows, columns)
    gains = (
        np.log(np.maximum(now * detectable, 1e-300))[rows]
        - np.log(missed)[rows]
        + log_densities
        + more
        - log_free[columns]
    )
    likely = gains > _LEAST_GAIN
    table = _Table(
        rows[likely],
        columns[likely],
        gains[likely],
        np.log(missed),
        log_free,
        born,
        detectable,
        in_view & misses,
        set(zip(rows[jumps].tolist(), columns[jumps].tolist(), strict=True)),
    )
    for row, column, gain in zip(
        table.rows.tolist(), table.columns.tolist(), table.gains.tolist(), strict=True
    ):
        table.by_node.setdefault(row, []).append((column, gain))
    return table


def second_returns(
    entry: Entry, nodes: Nodes, rows: IntArray, rules: Rules
) -> FloatArray:
    """Return the density of second returns of the tracks in `rows` at each candidate, in 1/m^2, shape (m,)."""
    own = entry.sensor.second_returns
    result = np.zeros(len(entry.candidates))
    if own is None or not len(rows) or not entry.placed.any():
        return result
    detected = (nodes.existed * nodes.alive * nodes.visible[:, entry.index])[
        rows
    ] * entry.sensor.detection_probability
    y_m = entry.candidates.lines[:, None, :2] - nodes.means[None, rows, :2]
    P = nodes.covariances[rows][:, :2, :2] + own.std_m**2 * np.eye(2)
    m, t = y_m.shape[:2]
    spreads = np.tile(P, (m, 1, 1))
    found = densities(y_m.reshape(-1, 2), spreads, np.zeros(spreads.shape))
    returned = own.share * found.reshape(m, t) @ detected
    return np.asarray(np.where(entry.placed, returned, 0.0))


def _free(
    entry: Entry,
    unseen: Sequence[tuple[float, FloatArray, FloatArray]],
    returns: FloatArray,
    rules: Rules,
) -> tuple[FloatArray, FloatArray]:
    """Return the log-density of candidates without a track (m,), and the probability that they start a track (m,).

    A candidate without a track is clutter, a second return of a track, or a new object.
    """
    clutter = np.exp(entry.log_clutter)
    if rules.prior is None:
        new = rules.birth_odds * np.exp(entry.log_clutter + entry.scores)
    else:
        new = _unseen_densities(entry, unseen).sum(axis=0)
    new = np.where(entry.may_start, new, 0.0)
    starts = np.where(entry.may_start, new + returns, 0.0)
    total = clutter + np.maximum(starts, returns)
    return np.log(total), starts / total


def _unseen_densities(
    entry: Entry, unseen: Sequence[tuple[float, FloatArray, FloatArray]]
) -> FloatArray:
    """Return the density of each candidate as a first detection of each kind of unseen objects, shape (k, m)."""
    result = np.zeros((len(unseen), len(entry.candidates)))
    means = np.array([mean for _, mean, _ in unseen])
    P = np.array([covariance for _, _, covariance in unseen])
    numbers = np.array([number for number, _, _ in unseen])
    for group in entry.groups:
        m = len(group.rows)
        members = np.tile(np.arange(m), len(unseen))
        of = np.repeat(np.arange(len(unseen)), m)
        log_density = _log_densities(group, members, of, means, P)
        result[:, group.rows] = np.exp(log_density).reshape(len(unseen), m)
    weights = numbers * entry.sensor.detection_probability
    return np.asarray(weights[:, None] * result)


def _log_densities(
    group: Group,
    members: IntArray,
    of: IntArray,
    means: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Return log N(z; h(x), S) of pairs of members of a group and states, shape (p,); NaN if S is not definite."""
    own = group.stack
    x = means.take(of, axis=0)
    y, H = own.model.linearised(own.z.take(members, axis=0), x, own.pose)
    R = group.noise(members, x, covariances, of)
    every = np.arange(y.shape[1])
    _, nis, logdet = kernels(_KALMAN).innovations(
        y, stacked(H), np.ascontiguousarray(covariances), of, R, every
    )
    return np.asarray(-0.5 * (nis + logdet + y.shape[1] * math.log(math.tau)))


def _pairs(
    nodes: Nodes, entry: Entry
) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Return the pairs of tracks and candidates inside the gate, their log-densities, and the pairs with a jump.

    The correlated error of a pair is that of the track's last detection, or with the probability of a jump new.
    """
    m = len(entry.candidates)
    if not m or not len(nodes.roots):
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, np.zeros(0), np.zeros(0, dtype=bool)
    renewed = _renewed(nodes.means, nodes.covariances, entry)
    states = StatesAt((), nodes.means, nodes.covariances)
    reach_m = reaches_m(entry.groups, states, _GATE_PROBABILITY, 5000.0)
    if renewed is not None:
        reach_m = np.maximum(
            reach_m,
            reaches_m(entry.groups, StatesAt((), *renewed), _GATE_PROBABILITY, 5000.0),
        )
    pairs = near(entry.candidates, nodes.means, reach_m)
    columns, rows = pairs.rows, pairs.columns
    log_densities = _pair_densities(
        entry, rows, columns, nodes.means, nodes.covariances
    )
    jumps = np.zeros(len(rows), dtype=bool)
    if renewed is not None:
        p = entry.jump_probability
        stays = log_densities + math.log1p(-p)
        moves = _pair_densities(entry, rows, columns, *renewed) + math.log(p)
        log_densities, jumps = np.logaddexp(stays, moves), moves > stays
    return rows, columns, log_densities, jumps


def _renewed(
    means: FloatArray, covariances: FloatArray, entry: Entry
) -> tuple[FloatArray, FloatArray] | None:
    """Return states whose errors of the sensor are new; None if errors do not jump."""
    if not (entry.jump_probability and entry.errors):
        return None
    x, P = means.copy(), covariances.copy()
    x[:, entry.errors] = 0.0
    P[:, entry.errors] = P[:, :, entry.errors] = 0.0
    P[:, entry.errors, entry.errors] = 1.0
    return x, P


def _pair_densities(
    entry: Entry,
    rows: IntArray,
    columns: IntArray,
    means: FloatArray,
    covariances: FloatArray,
) -> FloatArray:
    """Return the log-densities of pairs of states and candidates, shape (p,)."""
    result = np.empty(len(rows))
    for group, members, here in _split(entry.groups, columns):
        result[here] = _log_densities(
            group, members, rows.take(here), means, covariances
        )
    return np.nan_to_num(result, nan=-1e300)


def _split(
    groups: Sequence[Group], columns: IntArray
) -> list[tuple[Group, IntArray, IntArray]]:
    """Return each group with candidates of `columns`, their indices in the group, and their indices in `columns`."""
    if len(groups) == 1:
        return [(groups[0], columns, np.arange(len(columns)))]
    parts = []
    for group in groups:
        members = np.searchsorted(group.rows, columns)
        here = np.flatnonzero(group.rows.take(members, mode="clip") == columns)
        if len(here):
            parts.append((group, members[here], here))
    return parts


def _described(
    nodes: Nodes, entry: Entry, rows: IntArray, columns: IntArray
) -> FloatArray:
    """Return the log-likelihood ratio of classes and identities of each pair."""
    result = np.zeros(len(rows))
    if not entry.is_described:
        return result
    wrong = entry.sensor.wrong_id_probability
    weight = math.log((1.0 - wrong) / wrong)
    own = entry.descriptions
    for k, (row, column) in enumerate(
        zip(rows.tolist(), columns.tolist(), strict=True)
    ):
        track, candidate = nodes.descriptions[row], own[column]
        if track is NOTHING or candidate is NOTHING:
            continue
        if differ(track.class_name, candidate.class_name):
            result[k] = -1e300
            continue
        if track.ids and candidate.ids:
            result[k] = weight if track.identity == candidate.identity else -weight
    return result


def _first_state(
    entry: Entry,
    column: int,
    unseen: Sequence[tuple[float, FloatArray, FloatArray]],
) -> tuple[FloatArray, FloatArray]:
    """Return the state of the likeliest unseen object, given the candidate."""
    densities = _unseen_densities(entry, unseen)[:, column]
    _, mean, P = unseen[int(densities.argmax())]
    for group, members, _ in _split(entry.groups, np.array([column])):
        x, covariance = mean[None].copy(), P[None].copy()
        _correct(group, members, x, covariance)
        return x[0], covariance[0]
    return mean, P


def _correct(
    group: Group, members: IntArray, means: FloatArray, covariances: FloatArray
) -> None:
    """Fuse members of a group into the states (p, n), (p, n, n), which are overwritten."""
    own = group.stack
    y, H = own.model.linearised(own.z.take(members, axis=0), means, own.pose)
    p, k = y.shape
    R = group.noise(members, means, covariances, np.arange(p))
    loss, width = compiled_form(own.loss, k)
    kernels(_KALMAN).correct(
        means,
        covariances,
        np.ascontiguousarray(y),
        stacked(H),
        np.ascontiguousarray(R),
        np.arange(k),
        loss,
        width,
        np.empty((p, k, k)),
        np.empty(p),
        np.empty(p),
    )


@dataclass(frozen=True)
class _Successor:
    log_weight: float
    parent: int
    pairs: tuple[tuple[int, int], ...]
    nodes: tuple[tuple[int, int], ...]
    """Track and candidate of each track, (track, NONE) for a miss, (NONE, candidate) for a birth."""


def _ranked(
    before: Step, table: _Table, born: Sequence[int], rules: Rules
) -> list[_Successor]:
    """Return the best successors of the hypotheses, the best one first."""
    found: dict[tuple[tuple[int, int], ...], _Successor] = {}
    best = -math.inf
    for parent, hypothesis in enumerate(before.hypotheses):
        rows = hypothesis.rows.tolist()
        base = hypothesis.log_weight + float(table.log_missed[hypothesis.rows].sum())
        gains = [
            (row, column, gain)
            for row in rows
            for column, gain in table.by_node.get(row, ())
        ]
        for gain, pairs in best_assignments(gains, rules.most):
            weight = base + gain
            if weight < best - LARGEST_LOSS:
                break
            best = max(best, weight)
            taken = dict(pairs)
            used = set(taken.values())
            nodes = tuple(
                [(row, taken.get(row, NONE)) for row in rows]
                + [(NONE, column) for column in born if column not in used]
            )
            known = found.get(nodes)
            if known is None:
                found[nodes] = _Successor(weight, parent, pairs, nodes)
            else:
                total = float(np.logaddexp(known.log_weight, weight))
                better = known if known.log_weight >= weight else None
                found[nodes] = (
                    _Successor(total, known.parent, known.pairs, nodes)
                    if better
                    else _Successor(total, parent, pairs, nodes)
                )
    ranked = sorted(found.values(), key=lambda each: (-each.log_weight, each.nodes))
    ranked = [
        each
        for each in ranked[: rules.most]
        if each.log_weight > ranked[0].log_weight - LARGEST_LOSS
    ]
    total = float(np.logaddexp.reduce([each.log_weight for each in ranked]))
    return [
        _Successor(each.log_weight - total, each.parent, each.pairs, each.nodes)
        for each in ranked
    ]


def _updated(
    nodes: Nodes,
    entry: Entry,
    views: BoolArray,
    table: _Table,
    unseen: Sequence[tuple[float, FloatArray, FloatArray]],
    kept: Sequence[_Successor],
    rules: Rules,
) -> tuple[Nodes, tuple[Hypothesis, ...]]:
    """Return the tracks of the kept successors, and the hypotheses."""
    codes = sorted({code for each in kept for code in each.nodes})
    number = {code: k for k, code in enumerate(codes)}
    new = [column for row, column in codes if row == NONE]  # the first ones
    rows = np.array([row for row, _ in codes if row != NONE], dtype=np.int64)
    columns = np.array([column for row, column in codes if row != NONE], dtype=np.int64)
    old = _moved(nodes.at(rows), entry, rows, columns, table, views, rules)
    every = _joined(_new(entry, new, table, unseen, views.shape[1], rules), old)
    least = rules.least_existence
    alive = every.existed * every.alive >= least
    in_use: dict[int, int] = {}
    drafts = []
    roots = every.roots.tolist()
    for each in kept:
        own = [number[code] for code in each.nodes]
        living = [k for k in own if alive[k]]
        taken = [NONE] * len(entry.candidates)
        for k, (_, column) in zip(own, each.nodes, strict=True):
            if column != NONE:
                taken[column] = roots[k]
        ended = tuple([_ended(every, k) for k in own if not alive[k]])
        for k in living:
            in_use.setdefault(k, len(in_use))
        drafts.append((each, living, tuple(taken), ended))
    order = np.array(list(in_use), dtype=np.int64)
    hypotheses: dict[tuple[int, ...], Hypothesis] = {}
    for each, living, own_taken, ended in drafts:
        own_rows = [in_use[k] for k in living]
        key = tuple(sorted(own_rows))
        known = hypotheses.get(key)
        if known is None:
            hypotheses[key] = Hypothesis(
                each.log_weight,
                np.array(own_rows, dtype=np.int64),
                own_taken,
                each.parent,
                ended,
            )
        else:
            hypotheses[key] = Hypothesis(
                float(np.logaddexp(known.log_weight, each.log_weight)),
                known.rows,
                known.taken,
                known.parent,
                known.ended,
            )
    ranked = sorted(hypotheses.values(), key=lambda each: -each.log_weight)
    result = _judged(every.at(order), ranked[0].rows, entry, rules)
    return result, tuple(ranked)


def _ended(nodes: Nodes, row: int) -> Ended:
    """Return a track as one that ends."""
    probability = float(nodes.existed[row] * nodes.own[row])
    return Ended(int(nodes.roots[row]), probability, bool(nodes.is_confirmed[row]))


def living(step: Step) -> list[Ended]:
    """Return the tracks of the best hypothesis as if they ended now."""
    return [_ended(step.nodes, row) for row in step.hypotheses[0].rows.tolist()]


def _new(
    entry: Entry,
    columns: Sequence[int],
    table: _Table,
    unseen: Sequence[tuple[float, FloatArray, FloatArray]],
    num_sensors: int,
    rules: Rules,
) -> Nodes:
    """Return the tracks that `columns` start."""
    n, dim = len(columns), rules.motion.dim
    means, P = np.zeros((n, dim)), np.zeros((n, dim, dim))
    for k, column in enumerate(columns):
        state = entry.state(column) if rules.prior is None else None
        means[k], P[k] = _first_state(entry, column, unseen) if state is None else state
    visible = np.full((n, num_sensors), rules.visible_share)
    visible[:, entry.index] = 1.0
    return Nodes(
        means,
        P,
        table.born[list(columns)],
        np.ones(n),
        visible,
        np.zeros(n, dtype=bool),
        np.full(n, rules.min_travel_m == 0.0),
        means[:, :2].copy(),
        np.array([entry.roots[column] for column in columns], dtype=np.int64),
        np.zeros(n),
        np.ones(n, dtype=np.int64),
        np.zeros(n, dtype=np.int64),
        np.full(n, entry.index),
        np.ones(n),
        tuple([entry.descriptions[column] for column in columns]),
    )


def _moved(
    nodes: Nodes,
    entry: Entry,
    rows: IntArray,
    columns: IntArray,
    table: _Table,
    views: BoolArray,
    rules: Rules,
) -> Nodes:
    """Return tracks after their detections or misses; `rows` are their rows in the table."""
    if not len(rows):
        return nodes
    hit = columns != NONE
    chosen = hit.nonzero()[0]
    means, P = nodes.means, nodes.covariances
    for group, members, here in (
        _split(entry.groups, columns[chosen]) if len(chosen) else ()
    ):
        own = chosen[here]
        x, covariances = means[own], P[own]
        new = [
            k
            for k, one in enumerate(own.tolist())
            if (int(rows[one]), int(columns[one])) in table.jumps
        ]
        renewed = _renewed(x[new], covariances[new], entry) if new else None
        if renewed is not None:
            x[new], covariances[new] = renewed
        _correct(group, members, x, covariances)
        means[own], P[own] = x, covariances
    detectable = table.detectable[rows]
    missable = np.where(table.in_view[rows], detectable, 0.0)
    unseen_alive = 1.0 - nodes.alive * missable
    missed = 1.0 - nodes.existed * nodes.alive * missable
    placed = np.zeros(len(rows), dtype=bool)
    placed[chosen] = entry.placed[columns[chosen]]
    existed = np.where(placed, 1.0, nodes.existed * unseen_alive / missed)
    alive = np.where(placed, 1.0, nodes.alive * (1.0 - missable) / unseen_alive)
    existed = np.where(hit & ~placed, nodes.existed, existed)
    alive = np.where(hit & ~placed, nodes.alive, alive)
    visible = nodes.visible.copy()
    own_visible = visible[:, entry.index]
    P_D = entry.sensor.detection_probability
    after_miss = own_visible * (1.0 - P_D) / np.maximum(1.0 - own_visible * P_D, 1e-12)
    visible[:, entry.index] = np.where(
        hit, 1.0, np.where(table.in_view[rows], after_miss, rules.visible_share)
    )
    descriptions = list(nodes.descriptions)
    if entry.is_described:
        for k in chosen.tolist():
            descriptions[k] = descriptions[k].learned(
                entry.descriptions[int(columns[k])]
            )
    of_sensor = nodes.sensors == entry.index
    travelled = nodes.has_travelled | (
        hit & (np.hypot(*(means[:, :2] - nodes.first_m).T) >= rules.min_travel_m)
    )
    return replace(
        nodes,
        means=means,
        covariances=P,
        existed=existed,
        alive=alive,
        visible=visible,
        has_travelled=travelled,
        counts=nodes.counts + (hit & of_sensor),
        misses=nodes.misses + (~hit & of_sensor & table.in_view[rows]),
        descriptions=tuple(descriptions),
    )


def _joined(first: Nodes, second: Nodes) -> Nodes:
    if not len(second.roots):
        return first
    if not len(first.roots):
        return second
    joined = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in Nodes.__annotations__
        if name != "descriptions"
    }
    return Nodes(**joined, descriptions=first.descriptions + second.descriptions)


def _judged(nodes: Nodes, rows: IntArray, entry: Entry, rules: Rules) -> Nodes:
    """Return the tracks with their confirmation, and with the rate at which their existence decays from now on.

    `rows` are the tracks of the best hypothesis, of which other tracks may be second returns.
    """
    own = _own(nodes, rows, rules)
    exists = nodes.existed * nodes.alive * own
    confirmed = nodes.is_confirmed | (
        nodes.has_travelled & (exists >= rules.confirm_probability)
    )
    views = rules.views.of(nodes.means[:, :2], entry.scan.ego)
    seen = np.where(views, nodes.visible, 0.0).max(axis=1, initial=0.0)
    in_view = views.any(axis=1)
    hazards_hz = np.where(
        in_view,
        1.0 / rules.lifetime_s + (1.0 - seen) / rules.hidden_s,
        1.0 / rules.lifetime_s + 1.0 / rules.out_of_view_s,
    )
    return replace(nodes, is_confirmed=confirmed, hazards_hz=hazards_hz, own=own)


def _own(nodes: Nodes, rows: IntArray, rules: Rules) -> FloatArray:
    """Return the probability that each track is an object of its own, shape (n,), and no second return of a track in
    `rows`.

    The second return moves with the hull: the distance of both tracks is normal with the standard deviation
    of the sensor's second returns, and their velocities are nearly equal. Another object is anywhere, and has a
    velocity of its own. A track with fewer detections may be a second return of a track with more detections.
    """
    own = np.ones(len(nodes.roots))
    if not rules.returns or len(rows) < 2:
        return own
    position, velocity = slice(0, 2), slice(2, 4)
    exists = nodes.existed * nodes.alive
    speeds_m2ps2 = 2.0 * rules.speed_std_mps**2 * np.eye(2)
    slow_m2ps2 = _HULL_STD_MPS**2 * np.eye(2)
    for k in range(len(own)):
        given = rules.returns.get(int(nodes.sensors[k]))
        if given is None:
            continue
        hosts = rows[
            (nodes.counts[rows] > nodes.counts[k])
            & (
                np.hypot(*(nodes.means[rows, :2] - nodes.means[k, :2]).T)
                < 6.0 * given.std_m
            )
        ]
        if not len(hosts):
            continue
        x = nodes.means[hosts] - nodes.means[k]
        P = nodes.covariances[hosts] + nodes.covariances[k]
        size_m2 = given.std_m**2 * np.eye(2)
        log_return = (
            np.log(given.share * exists[hosts])
            + _log_normal(x[:, position], P[:, position, position] + size_m2)
            + _log_normal(x[:, velocity], P[:, velocity, velocity] + slow_m2ps2)
        )
        log_object = given.log_new_per_m2 + _log_normal(
            x[:, velocity], P[:, velocity, velocity] + speeds_m2ps2
        )
        log_object = log_object + given.log_seen(
            int(nodes.counts[k]), int(nodes.misses[k])
        )
        odds = np.exp(np.clip(log_return - log_object, -50.0, 50.0)).sum()
        own[k] = 1.0 / (1.0 + odds)
    return own


def _log_normal(x: FloatArray, P: FloatArray) -> FloatArray:
    """Return log N(x; 0, P) of vectors (m, 2) with covariances (m, 2, 2), shape (m,)."""
    own = densities(np.ascontiguousarray(x), P, np.zeros(P.shape))
    return np.asarray(np.log(np.maximum(own, 1e-300)))
