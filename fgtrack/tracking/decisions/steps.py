"""Hypotheses about the tracks after each object list: a Poisson multi-Bernoulli mixture.

A hypothesis assigns each detection up to a list to a track, to a new track, or to clutter. The
few best hypotheses are kept. A track of a hypothesis is a Bernoulli component: the probability
that its object has ever existed, the probability that the object still exists, and a Gaussian
state.

Sources: Williams, "Marginal multi-Bernoulli filters", IEEE T-AES 51(3), 2015, and
Garcia-Fernandez, Williams, Granstrom, Svensson, "Poisson multi-Bernoulli mixture filter",
IEEE T-AES 54(4), 2018.
"""

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
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
from fgtrack.tracking.decisions.ranking import Ranked, best_assignments
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.second_returns import second_returns
from fgtrack.tracking.decisions.states import judged, predicted, started, updated
from fgtrack.tracking.decisions.unseen import Unseen, not_shown

_KERNELS = "fgtrack.tracking.decisions.step_kernels"


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
    ranked = _ranked(before, table, rules.most)
    every, hypotheses = _explained(nodes, entry, views, table, unseen, ranked, rules)
    result, apart = judged(every, hypotheses[0].rows, entry, before.apart, rules)
    return Step(stamp_ns, entry, result, hypotheses, not_shown(entry, unseen), apart)


def _ranked(before: Step, table: Table, most: int) -> Ranked:
    """Return the best `most` successors of the hypotheses, the best one first."""
    problems = [
        (each.log_weight + float(table.log_missed[each.rows].sum()), each.rows)
        for each in before.hypotheses
    ]
    return best_assignments(table.gains, problems, most)


def _explained(
    nodes: Nodes,
    entry: Entry,
    views: BoolArray,
    table: Table,
    unseen: tuple[Unseen, ...],
    ranked: Ranked,
    rules: Rules,
) -> tuple[Nodes, tuple[Hypothesis, ...]]:
    """Return the tracks of the ranked successors, and the hypotheses, the best one first."""
    gains = table.gains
    rows, pairs, candidates, members, ends = kernels(_KERNELS).distinct(
        gains.first, gains.candidates, ranked.pairs, table.born >= rules.least_existence
    )
    every = updated(nodes.at(rows), entry, rows, pairs, table, rules)
    births = candidates[: len(candidates) - len(rows)].tolist()
    if births:
        new = started(entry, births, table, unseen, views.shape[1], rules)
        every = joined(new, every)
    log_weights = ranked.gains - np.logaddexp.reduce(ranked.gains)
    in_use, *merged = kernels(_KERNELS).merge(
        every.probabilities,
        candidates,
        members,
        ends,
        log_weights,
        ranked.problems,
        len(entry.candidates),
        rules.least_existence,
    )
    hypotheses = _merged(every, *merged)
    kept = every if len(in_use) == len(every) else every.at(in_use)
    return kept, hypotheses


def _merged(
    every: Nodes,
    log_weights: FloatArray,
    parents: IntArray,
    rows: IntArray,
    row_ends: IntArray,
    taken: IntArray,
    gone: IntArray,
    gone_ends: IntArray,
) -> tuple[Hypothesis, ...]:
    """Return hypotheses from the arrays of `fgtrack.tracking.decisions.step_kernels.merge`."""
    roots = np.append(every.roots, NONE)[taken].tolist()
    ends = [ended(every, row) for row in gone.tolist()]
    return tuple(
        [
            Hypothesis(
                weight,
                rows[row_ends[k] : row_ends[k + 1]],
                tuple(roots[k]),
                parent,
                tuple(ends[gone_ends[k] : gone_ends[k + 1]]),
            )
            for k, (weight, parent) in enumerate(
                zip(log_weights.tolist(), parents.tolist(), strict=True)
            )
        ]
    )
