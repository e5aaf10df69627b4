"""States and probabilities of the tracks of hypotheses: prediction, detections and misses, births."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.likelihoods import Table
from fgtrack.tracking.decisions.measurements import correct, renewed, split
from fgtrack.tracking.decisions.nodes import NONE, Nodes
from fgtrack.tracking.decisions.rules import Rules
from fgtrack.tracking.decisions.second_returns import own_probabilities
from fgtrack.tracking.decisions.unseen import Unseen, first_state

_KALMAN = "fgtrack.estimation.kernels.kalman"


def predicted(nodes: Nodes, dt_s: float, rules: Rules) -> Nodes:
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
    return Nodes(
        means,
        P,
        table.born[list(columns)],
        table.born[list(columns)],
        np.ones(n),
        visible,
        np.zeros(n, dtype=bool),
        np.full(n, rules.min_travel_m == 0.0),
        means[:, :2].copy(),
        np.array([entry.roots[column] for column in columns], dtype=np.int64),
        np.zeros(n),
        np.ones(n, dtype=np.int64),
        np.ones(n, dtype=np.int64),
        np.zeros(n, dtype=np.int64),
        np.full(n, entry.index),
        np.ones(n),
        np.zeros(n, dtype=bool),
        tuple([entry.descriptions[column] for column in columns]),
    )


def updated(
    nodes: Nodes,
    entry: Entry,
    rows: IntArray,
    columns: IntArray,
    table: Table,
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
        split(entry.groups, columns[chosen]) if len(chosen) else ()
    ):
        own = chosen[here]
        x, covariances = means[own], P[own]
        new = [
            k
            for k, one in enumerate(own.tolist())
            if (int(rows[one]), int(columns[one])) in table.jumps
        ]
        fresh = renewed(x[new], covariances[new], entry) if new else None
        if fresh is not None:
            x[new], covariances[new] = fresh
        correct(group, members, x, covariances)
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
    believed = _believed(nodes, rows, columns, table, detectable, missable, placed)
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
        believed=np.where(hit & ~placed, nodes.believed, believed),
        alive=alive,
        visible=visible,
        has_travelled=travelled,
        hits=nodes.hits + hit,
        counts=nodes.counts + (hit & of_sensor),
        misses=nodes.misses + (~hit & of_sensor & table.in_view[rows]),
        coasts=~hit & (nodes.coasts | table.in_view[rows]),
        descriptions=tuple(descriptions),
    )


def _believed(
    nodes: Nodes,
    rows: IntArray,
    columns: IntArray,
    table: Table,
    detectable: FloatArray,
    missable: FloatArray,
    placed: BoolArray,
) -> FloatArray:
    """Return the probabilities that the objects of tracks have ever existed, if a detection may also be clutter.

    The few hypotheses that are kept do not show each detection as clutter. So the alternative of a track with a
    detection is the same track without one.
    """
    exists = nodes.believed * nodes.alive
    missed = 1.0 - exists * missable
    if_missed = nodes.believed * (1.0 - nodes.alive * missable) / missed
    ratios = np.array(
        [
            table.ratios.get((row, column), 0.0) if is_placed else 0.0
            for row, column, is_placed in zip(
                rows.tolist(), columns.tolist(), placed.tolist(), strict=True
            )
        ]
    )
    odds = exists * detectable * ratios / missed
    return np.asarray((odds + if_missed) / (odds + 1.0))


def judged(nodes: Nodes, rows: IntArray, entry: Entry, rules: Rules) -> Nodes:
    """Return the tracks with their confirmation, and with the rate at which their existence decays from now on.

    `rows` are the tracks of the best hypothesis, of which other tracks may be second returns.
    """
    own = own_probabilities(nodes, rows, rules.returns, rules.speed_std_mps)
    exists = nodes.believed * nodes.alive * own
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
