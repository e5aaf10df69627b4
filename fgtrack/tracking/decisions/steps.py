"""Hypotheses about the tracks after each object list: a Poisson multi-Bernoulli mixture.

A hypothesis assigns each detection up to a list to a track, to a new track, or to clutter. The
few best hypotheses are kept. A track of a hypothesis is a Bernoulli component: the probability
that its object has ever existed, the probability that the object still exists, and a Gaussian
state.

Sources: Williams, "Marginal multi-Bernoulli filters", IEEE T-AES 51(3), 2015, and
Garcia-Fernandez, Williams, Granstrom, Svensson, "Poisson multi-Bernoulli mixture filter",
IEEE T-AES 54(4), 2018.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, IntArray
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.likelihoods import Table, likelihoods
from fgtrack.tracking.decisions.nodes import (
    NONE,
    Hypothesis,
    Nodes,
    Step,
    ended,
    joined,
)
from fgtrack.tracking.decisions.ranking import best_assignments
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.second_returns import second_returns
from fgtrack.tracking.decisions.states import judged, predicted, started, updated
from fgtrack.tracking.decisions.unseen import Unseen, not_shown


def following(before: Step, entry: Entry, rules: Rules) -> Step:
    """Return the step after the list `entry`, which is not older than the step `before`."""
    is_first = before.entry is None
    stamp_ns = entry.batch.stamp_ns
    dt_s = 0.0 if is_first else seconds(stamp_ns - before.stamp_ns)
    nodes = predicted(before.nodes, dt_s, rules)
    views = rules.views.of(nodes.means[:, :2], entry.scan.ego)
    unseen: tuple[Unseen, ...] = ()
    if rules.prior is not None:
        unseen = rules.prior.predicted(
            before.unseen, dt_s, is_first, rules.lifetime_s, rules.motion
        )
    returns = second_returns(entry, nodes, before.hypotheses[0].rows)
    table = likelihoods(nodes, entry, views[:, entry.index], unseen, returns, rules)
    kept = _ranked(before, table, rules.most)
    result, hypotheses = _explained(nodes, entry, views, table, unseen, kept, rules)
    return Step(stamp_ns, entry, result, hypotheses, not_shown(entry, unseen))


class _Successor(NamedTuple):
    """A hypothesis of the step before, with an assignment of the list."""

    log_weight: float
    parent: int
    rows: IntArray
    """Tracks of the hypothesis, shape (n,)."""
    candidates: IntArray
    """Candidate of each track, `NONE` for a missed one, shape (n,)."""


def _ranked(before: Step, table: Table, most: int) -> list[_Successor]:
    """Return the best `most` successors of the hypotheses, the best one first."""
    problems = [
        (
            each.log_weight + float(table.log_missed[each.rows].sum()),
            table.gains.at(each.rows),
        )
        for each in before.hypotheses
    ]
    ranked = [
        _Successor(gain, parent, before.hypotheses[parent].rows, candidates)
        for gain, parent, candidates in best_assignments(problems, most)
    ]
    total = float(np.logaddexp.reduce([each.log_weight for each in ranked]))
    return [each._replace(log_weight=each.log_weight - total) for each in ranked]


class _Codes(NamedTuple):
    """Distinct tracks of the successors: births, and pairs of a track and a candidate or a miss."""

    rows: IntArray
    """Row of each track in the step before, `NONE` for a birth, shape (k,). Births come first."""
    candidates: IntArray
    """Candidate of each track, `NONE` for a missed one, shape (k,)."""
    members: list[IntArray]
    """Tracks of each successor."""

    @classmethod
    def of(cls, successors: list[_Successor], is_born: BoolArray) -> "_Codes":
        """Return the tracks of `successors`. Candidates without a track in `is_born` (m,) start tracks."""
        m = len(is_born)
        parts = []
        for each in successors:
            taken = each.candidates[each.candidates != NONE]
            free = is_born.copy()
            free[taken] = False
            kept = each.rows * (m + 1) + each.candidates + 1
            parts.append(np.concatenate([free.nonzero()[0] - m, kept]))
        codes, inverse = np.unique(np.concatenate(parts), return_inverse=True)
        ends = np.cumsum([len(part) for part in parts])[:-1]
        is_birth = codes < 0
        return cls(
            np.where(is_birth, NONE, codes // (m + 1)),
            np.where(is_birth, codes + m, codes % (m + 1) - 1),
            np.split(inverse, ends),
        )


def _explained(
    nodes: Nodes,
    entry: Entry,
    views: BoolArray,
    table: Table,
    unseen: tuple[Unseen, ...],
    kept: list[_Successor],
    rules: Rules,
) -> tuple[Nodes, tuple[Hypothesis, ...]]:
    """Return the tracks of the kept successors, and the hypotheses, the best one first."""
    codes = _Codes.of(kept, table.born >= rules.least_existence)
    is_birth = codes.rows == NONE
    rows, candidates = codes.rows[~is_birth], codes.candidates[~is_birth]
    births = codes.candidates[is_birth]
    every = joined(
        started(entry, births, table, unseen, views.shape[1], rules),
        updated(nodes.at(rows), entry, rows, candidates, table, views, rules),
    )
    is_alive = every.existed * every.alive >= rules.least_existence
    in_use = np.unique(np.concatenate([own[is_alive[own]] for own in codes.members]))
    hypotheses: dict[bytes, Hypothesis] = {}
    for each, own in zip(kept, codes.members, strict=True):
        own_rows = np.searchsorted(in_use, own[is_alive[own]])
        known = hypotheses.get(own_rows.tobytes())
        if known is not None:
            total = float(np.logaddexp(known.log_weight, each.log_weight))
            hypotheses[own_rows.tobytes()] = replace(known, log_weight=total)
            continue
        taken = np.full(len(entry.candidates), NONE)
        hits = own[codes.candidates[own] != NONE]
        taken[codes.candidates[hits]] = every.roots[hits]
        ends = [ended(every, k) for k in own[~is_alive[own]].tolist()]
        hypotheses[own_rows.tobytes()] = Hypothesis(
            each.log_weight, own_rows, tuple(taken.tolist()), each.parent, tuple(ends)
        )
    ranked = sorted(hypotheses.values(), key=lambda each: -each.log_weight)
    return judged(every.at(in_use), ranked[0].rows, entry, rules), tuple(ranked)
