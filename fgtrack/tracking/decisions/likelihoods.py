"""The table of log-likelihoods of a list: each candidate with each track, as clutter, and as a new object."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.base import StatesAt
from fgtrack.tracking.association import near, reaches_m
from fgtrack.tracking.decisions.entries import NOTHING, Entry
from fgtrack.tracking.decisions.measurements import log_densities, renewed
from fgtrack.tracking.decisions.nodes import Nodes
from fgtrack.tracking.decisions.ranking import LARGEST_LOSS, Gains
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.unseen import Unseen, densities_of
from fgtrack.tracking.objects import differ

_GATE_PROBABILITY = 0.99999
_EXCLUDING_WRONG_ID_PROBABILITY = 1e-3
"""If wrong identities are rarer, a detection does not belong to a track with another identity."""
_LEAST_GAIN = -LARGEST_LOSS
_FARTHEST_M = 5000.0
_KERNELS = "fgtrack.tracking.decisions.step_kernels"


@dataclass(frozen=True)
class Table:
    """Log-likelihoods of a list with m candidates, for n tracks and p pairs."""

    gains: Gains
    """Log-likelihood ratios of pairs to a missed track and a candidate without a track."""
    log_missed: FloatArray
    """Log-likelihood of each track without a candidate, shape (n,)."""
    born: FloatArray
    """Probability that each candidate without a track is a new object, shape (m,)."""
    detectable: FloatArray
    """Probability that each track is detected, if it exists, shape (n,)."""
    in_view: BoolArray
    """True for each track that the list would show, shape (n,)."""
    ratios: FloatArray
    """Likelihood ratio of each pair, if the track is detected, to a candidate without a track, shape (p,)."""
    jumps: BoolArray
    """True for each pair whose correlated error is probably new, shape (p,)."""


def likelihoods(
    nodes: Nodes,
    entry: Entry,
    in_view: BoolArray,
    unseen: Sequence[Unseen],
    returns: FloatArray | None,
    rules: Rules,
) -> Table:
    """Return the log-likelihoods of a list. `returns` (m,) are the densities of second returns, None for 0."""
    sensor, num_candidates = entry.sensor, len(entry.candidates)
    detectable = sensor.detection_probability * nodes.visible[:, entry.index]
    shows_misses = sensor.gives_position and sensor.scan and entry.batch.last
    log_free, born = _free(entry, unseen, returns, rules)
    if entry.is_described:
        log_free, born = _without_owned(nodes, entry, log_free, born)
    rows, columns, densities, jumps = _pairs(nodes, entry)
    if entry.is_described:
        densities = densities + _described(nodes, entry, rows, columns)
    first, candidates, gains, ratios, is_jump, log_missed = kernels(_KERNELS).tabulate(
        rows,
        columns,
        densities,
        jumps,
        log_free,
        nodes.existed * nodes.alive * nodes.own,
        detectable,
        in_view,
        shows_misses,
        num_candidates,
        _LEAST_GAIN,
    )
    return Table(
        Gains(first, candidates, gains, num_candidates),
        log_missed,
        born,
        detectable,
        in_view & shows_misses,
        ratios,
        is_jump,
    )


def _free(
    entry: Entry,
    unseen: Sequence[Unseen],
    returns: FloatArray | None,
    rules: Rules,
) -> tuple[FloatArray, FloatArray]:
    """Return the log-density of candidates without a track (m,), and the probability that they start a track (m,).

    A candidate without a track is clutter, a second return of a track, or a new object.
    """
    if returns is None and rules.prior is None:
        if entry.free is None:
            entry.free = _sum_of(entry, _new(entry, rules), 0.0)
        return entry.free
    new = _new(entry, rules)
    if rules.prior is not None:
        shown = densities_of(entry, unseen).sum(axis=0)
        new = np.where(entry.may_start, shown, 0.0)
    return _sum_of(entry, new, 0.0 if returns is None else returns)


def _without_owned(
    nodes: Nodes, entry: Entry, log_free: FloatArray, born: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the result of `_free` without new objects whose identity a track has.

    Such an object is new only if the identity is wrong.
    """
    owned: dict[str, float] = {}
    for track, probability in zip(
        nodes.descriptions, nodes.existed.tolist(), strict=True
    ):
        if track.identity is not None:
            own = owned.get(track.identity, 0.0)
            owned[track.identity] = max(own, probability)
    right = 1.0 - entry.sensor.wrong_id_probability
    shares = np.array(
        [
            1.0 - right * owned.get(each.identity or "", 0.0)
            for each in entry.descriptions
        ]
    )
    total = 1.0 - born + born * shares
    return log_free + np.log(total), born * shares / total


def _new(entry: Entry, rules: Rules) -> FloatArray:
    """Return the density of new objects at each candidate, without a prior of their states, shape (m,)."""
    density = rules.birth_odds * np.exp(entry.log_clutter + entry.scores)
    return np.where(entry.may_start, density, 0.0)


def _sum_of(
    entry: Entry, new: FloatArray, returns: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return the result of `_free` for densities of new objects and of second returns."""
    starts = np.where(entry.may_start, new + returns, 0.0)
    total = np.exp(entry.log_clutter) + np.maximum(starts, returns)
    return np.log(total), starts / total


def _pairs(
    nodes: Nodes, entry: Entry
) -> tuple[IntArray, IntArray, FloatArray, BoolArray]:
    """Return the pairs of tracks and candidates inside the gate, their log-densities, and the pairs with a jump.

    A pair keeps the correlated error of the track's last detection. With the probability of a jump the error is new.
    """
    m = len(entry.candidates)
    if not m or not len(nodes):
        nothing = np.zeros(0, dtype=np.int64)
        return nothing, nothing, np.zeros(0), np.zeros(0, dtype=bool)
    new = renewed(nodes.means, nodes.covariances, entry)
    states = StatesAt((), nodes.means, nodes.covariances)
    reach_m = reaches_m(entry.groups, states, _GATE_PROBABILITY, _FARTHEST_M)
    if new is not None:
        reach_m = np.maximum(
            reach_m,
            reaches_m(entry.groups, StatesAt((), *new), _GATE_PROBABILITY, _FARTHEST_M),
        )
    pairs = near(entry.candidates, nodes.means, reach_m)
    columns, rows = pairs.rows, pairs.columns
    found = log_densities(entry, rows, columns, nodes.means, nodes.covariances)
    jumps = np.zeros(len(rows), dtype=bool)
    if new is not None:
        p = entry.jump_probability
        stays = found + math.log1p(-p)
        moves = log_densities(entry, rows, columns, *new) + math.log(p)
        found, jumps = np.logaddexp(stays, moves), moves > stays
    return rows, columns, found, jumps


def _described(
    nodes: Nodes, entry: Entry, rows: IntArray, columns: IntArray
) -> FloatArray:
    """Return the log-likelihood ratio of classes and identities of each pair."""
    result = np.zeros(len(rows))
    wrong = entry.sensor.wrong_id_probability
    same = math.log((1.0 - wrong) / wrong)
    different = -1e300 if wrong < _EXCLUDING_WRONG_ID_PROBABILITY else -same
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
            result[k] = same if track.identity == candidate.identity else different
    return result
