"""States and probabilities of the tracks of hypotheses: prediction, detections and misses, births."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, IntArray
from fgtrack.estimation.filters.propagation import ExactPropagator
from fgtrack.tracking.decisions.columns import (
    ALIVE,
    BELIEVED,
    COUNT,
    EXISTED,
    FIRST_X_M,
    FIRST_Y_M,
    HAS_TRAVELLED,
    HITS,
    NUM_NUMBERS,
    NUM_PROBABILITIES,
    OWN,
    ROOT,
    SENSOR,
)
from fgtrack.tracking.decisions.entries import Description, Entry
from fgtrack.tracking.decisions.likelihoods import Table
from fgtrack.tracking.decisions.measurements import correct, renewed, split
from fgtrack.tracking.decisions.nodes import Nodes
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.second_returns import Evidence, own_probabilities
from fgtrack.tracking.decisions.unseen import Unseen, first_state
from fgtrack.tracking.lives.existence import densities

_KERNELS = "fgtrack.tracking.decisions.step_kernels"


def predicted(nodes: Nodes, dt_s: float, rules: Rules) -> Nodes:
    """Return the tracks `dt_s` later."""
    if not len(nodes) or dt_s == 0.0:
        return nodes
    one_step = np.ones(len(nodes), dtype=np.int64)
    mean, covariances = ExactPropagator(rules.motion).propagate(
        nodes.means, nodes.covariances, one_step, dt_s
    )
    probabilities, visible = nodes.probabilities.copy(), nodes.visible.copy()
    kernels(_KERNELS).fade(
        probabilities, visible, dt_s, rules.visible_share, rules.visible_s
    )
    return replace(
        nodes,
        means=mean,
        covariances=covariances,
        visible=visible,
        probabilities=probabilities,
    )


def started(
    entry: Entry,
    columns: Sequence[int],
    table: Table,
    unseen: Sequence[Unseen],
    num_sensors: int,
    rules: Rules,
) -> Nodes:
    """Return the tracks that `columns` start."""
    n, dim = len(columns), rules.motion.dim
    means, P = np.zeros((n, dim)), np.zeros((n, dim, dim))
    for k, column in enumerate(columns):
        state = entry.state(column) if rules.prior is None else None
        means[k], P[k] = first_state(entry, column, unseen) if state is None else state
    visible = np.full((n, num_sensors), rules.visible_share)
    visible[:, entry.index] = 1.0
    probabilities = np.zeros((n, NUM_PROBABILITIES))
    probabilities[:, EXISTED] = table.born[list(columns)]
    probabilities[:, BELIEVED] = table.born[list(columns)]
    probabilities[:, ALIVE] = probabilities[:, OWN] = 1.0
    probabilities[:, FIRST_X_M : FIRST_Y_M + 1] = means[:, :2]
    numbers = np.zeros((n, NUM_NUMBERS), dtype=np.int64)
    numbers[:, ROOT] = [entry.roots[column] for column in columns]
    numbers[:, HITS] = numbers[:, COUNT] = 1
    numbers[:, SENSOR] = entry.index
    numbers[:, HAS_TRAVELLED] = rules.min_travel_m == 0.0
    descriptions = tuple([entry.descriptions[column] for column in columns])
    return Nodes(means, P, visible, probabilities, numbers, descriptions)


def updated(
    nodes: Nodes,
    entry: Entry,
    rows: IntArray,
    pairs: IntArray,
    table: Table,
    rules: Rules,
) -> Nodes:
    """Return tracks after their detections or misses. `nodes` is a copy, which is overwritten.

    `rows` (k,) are the rows of the tracks in the table, `pairs` (k,) their pairs, below 0 for missed tracks.
    """
    if not len(rows):
        return nodes
    hits = (pairs >= 0).nonzero()[0]
    is_placed, ratios = np.zeros(len(rows), dtype=bool), np.zeros(len(rows))
    descriptions = nodes.descriptions
    if len(hits):
        chosen = pairs[hits]
        columns = table.gains.candidates[chosen]
        _correct(nodes, entry, hits, columns, table.jumps[chosen])
        is_placed[hits] = entry.placed[columns]
        ratios[hits] = table.ratios[chosen]
        if entry.is_described:
            descriptions = _described(nodes, entry, hits, columns)
    kernels(_KERNELS).update(
        nodes.probabilities,
        nodes.numbers,
        nodes.visible,
        nodes.means,
        pairs,
        is_placed,
        ratios,
        table.detectable[rows],
        table.in_view[rows],
        entry.index,
        entry.sensor.detection_probability,
        rules.visible_share,
        rules.min_travel_m,
    )
    if rules.min_travel_m:
        _note_movers(nodes, hits, rules)
    if descriptions is nodes.descriptions:
        return nodes
    return replace(nodes, descriptions=descriptions)


def _note_movers(nodes: Nodes, hits: IntArray, rules: Rules) -> None:
    """Note which of the tracks `hits` (h,) are objects that move: the probability is that of a confirmation.

    As many objects stand as move. The odds that an object stands are the density of the velocity 0 after all
    detections, over the density before them. Source: Dickey, "The weighted likelihood ratio, linear hypotheses on
    normal location parameters", Annals of Mathematical Statistics 42(1), 1971.
    """
    v, P = nodes.means[hits, 2:4], nodes.covariances[hits, 2:4, 2:4]
    before = 1.0 / (math.tau * rules.speed_std_mps**2)
    odds = densities(np.ascontiguousarray(v), P, np.zeros(P.shape)) / before
    moves = 1.0 / (1.0 + odds) >= rules.confirm_probability
    nodes.numbers[hits[moves], HAS_TRAVELLED] = 1


def _correct(
    nodes: Nodes, entry: Entry, hits: IntArray, columns: IntArray, jumps: BoolArray
) -> None:
    """Fuse the candidates `columns` (h,) into the tracks `hits` (h,), whose correlated errors are new where `jumps`."""
    for group, members, here in split(entry.groups, columns):
        own, is_new = hits[here], jumps[here]
        x, P = nodes.means[own], nodes.covariances[own]
        fresh = renewed(x[is_new], P[is_new], entry) if is_new.any() else None
        if fresh is not None:
            x[is_new], P[is_new] = fresh
        correct(group, members, x, P)
        nodes.means[own], nodes.covariances[own] = x, P


def _described(
    nodes: Nodes, entry: Entry, hits: IntArray, columns: IntArray
) -> tuple[Description, ...]:
    """Return the descriptions of the tracks, of which `hits` (h,) have the candidates `columns` (h,)."""
    descriptions = list(nodes.descriptions)
    for k, column in zip(hits.tolist(), columns.tolist(), strict=True):
        descriptions[k] = descriptions[k].learned(entry.descriptions[column])
    return tuple(descriptions)


def judged(
    nodes: Nodes, rows: IntArray, entry: Entry, before: Evidence, rules: Rules
) -> tuple[Nodes, Evidence]:
    """Return the tracks with their confirmation, and with the rate at which their existence decays from now on; and
    the evidence that tracks are two objects.

    A sensor that does not scan never shows that an object is hidden. `nodes` is a copy, which is overwritten.
    `rows` are the tracks of the best hypothesis, of which other tracks may be second returns.
    """
    own, after = own_probabilities(
        nodes, rows, rules.returns, rules.speed_std_mps, before
    )
    kernels(_KERNELS).judge(
        nodes.probabilities,
        nodes.numbers,
        np.where(rules.views.scanning, nodes.visible, 1.0),
        rules.views.of(nodes.means[:, :2], entry.scan.ego),
        own,
        rules.confirm_probability,
        rules.lifetime_s,
        rules.hidden_s,
        rules.out_of_view_s,
    )
    return nodes, after
