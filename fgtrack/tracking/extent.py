"""Extent of tracked objects by random matrices, and association of several detections of one list with a track.

Koch, "Bayesian approach to extended object and cluster tracking using random matrices", IEEE Trans. Aerospace and
Electronic Systems 44, 2008; Feldmann, Fränken, Koch, "Tracking of extended objects and group targets using random
matrices", IEEE Trans. Signal Processing 59, 2011. The extent D, shape (2, 2) in m^2, is the covariance of the
detections of an object about its middle, in map axes. Of n detections of a track with the mean z, the scatter
Z = sum (z_j - z)(z_j - z)' about it, the innovation y and S = H P H' + R + D / n (Feldmann et al., equations 21 to 26)

    sum of weights  += n,      sum of weighted extents  += D^1/2 (S^-1/2 y y' S^-1/2 + Y^-1/2 Z Y^-1/2) D^1/2

with Y = D + R, and the extent is the ratio of the sums. A prior of constant weight stays in them; the rest decays with
the time between stamps, whichever of them arrives first, and slowly: the extent at a late stamp is that of now.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from pydantic import PositiveFloat
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fgtrack.core.geometry import circular_mean
from fgtrack.core.linalg import congruence
from fgtrack.core.settings import OpenProbability, settings
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import StatesAt
from fgtrack.models.measurement import ANGULAR
from fgtrack.tracking.association import Assignment, chi_square_quantile
from fgtrack.tracking.preprocess import Candidates


@settings
class ExtentRules:
    """Several detections of an object in a list, with an extent that is estimated for each track."""

    std_m: PositiveFloat = 1.0
    """Standard deviation, on each axis, of the detections of an object about its middle, before any is known: a
    quarter of its length where detections are spread evenly over it."""
    weight: PositiveFloat = 5.0
    """Number of detections that this counts as."""
    memory_s: PositiveFloat = 30.0
    """After this time a detection counts for 1/e."""
    gate_probability: OpenProbability = 0.99
    """Probability with which two detections of an object are recognised as such."""


class Extents:
    """The extents of all tracks; see the module."""

    def __init__(self, rules: ExtentRules) -> None:
        self._rules = rules
        self._prior = rules.std_m**2 * np.eye(2)
        self._sums: dict[int, tuple[int, float, FloatArray]] = {}  # newest stamp, weight, weighted extent by track

    def of(self, track_ids: Sequence[int]) -> FloatArray:
        """Return the extents of tracks, shape (m, 2, 2)."""
        D, weight = np.empty((len(track_ids), 2, 2)), self._rules.weight
        for row, track_id in enumerate(track_ids):
            _, total, parts = self._sums.get(track_id, (0, 0.0, 0.0))
            D[row] = (weight * self._prior + parts) / (weight + total)
        return D

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended."""
        self._sums.pop(track_id, None)

    def joined(
        self, candidates: Candidates, assignment: Assignment, states: StatesAt, stamp_ns: int
    ) -> tuple[Candidates, Assignment]:
        """Return the candidates with those of one object as one, and their assignment.
        Candidates without a track join the set of the assigned one that they most probably share the object with, and
        else each other. Of a set the mean stands for all.
        """
        num, placed = len(candidates), np.array(candidates.placed)
        points_m, leads = candidates.lines[:, :2], np.arange(num)
        D = np.broadcast_to(self._prior, (num, 2, 2)).copy()
        own = np.array(assignment.pairs, dtype=np.int64).reshape(-1, 2)
        own = own[placed[own[:, 0]]]
        D[own[:, 0]] = self.of([states.track_ids[track] for track in own[:, 1].tolist()])
        R = _position_noise(candidates)
        limit = chi_square_quantile(self._rules.gate_probability, 2)
        loose = np.array([row for row in (*assignment.new, *assignment.refused) if placed[row]], dtype=np.int64)
        if len(loose) and len(own):
            apart = points_m[loose, None] - points_m[own[:, 0]]
            cost, logdet = _distances(apart, 2.0 * D[own[:, 0]] + R[loose, None] + R[own[:, 0]])
            cost[cost > limit] = np.inf
            nearest = (cost + logdet).argmin(axis=1)
            near = np.isfinite(cost[np.arange(len(loose)), nearest])
            leads[loose[near]] = own[nearest[near], 0]
            loose = loose[~near]
        loose = np.setdiff1d(loose, assignment.refused)
        if len(loose) > 1:
            i, j = np.triu_indices(len(loose), 1)
            a, b = loose[i], loose[j]
            linked = _distances(points_m[a] - points_m[b], 2.0 * self._prior + R[a] + R[b])[0] <= limit
            links = coo_array((linked[linked].astype(np.int8), (i[linked], j[linked])), shape=(len(loose), len(loose)))
            labels = connected_components(links, directed=False)[1]
            leads[loose] = loose[np.unique(labels, return_index=True)[1][labels]]
        sizes = np.bincount(leads, minlength=num)
        self._learn(candidates, own, leads, sizes, D, R, states, stamp_ns)
        return _merged(candidates, assignment, leads, sizes)

    def _learn(
        self,
        candidates: Candidates,
        own: IntArray,
        leads: IntArray,
        sizes: IntArray,
        D: FloatArray,
        R: FloatArray,
        states: StatesAt,
        stamp_ns: int,
    ) -> None:
        """Add the sets of the tracks of the pairs `own` (p, 2) to the extents of these."""
        if not len(own):
            return
        rows, tracks = own.T
        middles_m = np.zeros((len(leads), 2))
        np.add.at(middles_m, leads, candidates.lines[:, :2])
        middles_m /= np.maximum(sizes, 1)[:, None]
        off_m = candidates.lines[:, :2] - middles_m[leads]
        scatter = np.zeros((len(leads), 2, 2))
        np.add.at(scatter, leads, off_m[:, :, None] * off_m[:, None])
        y, HPH = _position_innovations(candidates, rows, tracks, states, middles_m)
        n, root = sizes[rows, None, None], _root(D[rows])
        y = root @ np.linalg.solve(_root(HPH + R[rows] + D[rows] / n), y[:, :, None])
        B = np.asarray(np.linalg.solve(_root(D[rows] + R[rows]), root).swapaxes(1, 2), dtype=np.float64)
        parts: FloatArray = y @ y.swapaxes(1, 2) + congruence(B, scatter[rows])
        nothing: FloatArray = np.zeros((2, 2))
        for track, count, part in zip(tracks.tolist(), sizes[rows].tolist(), parts, strict=True):
            track_id = states.track_ids[track]
            newest_ns, total, before = self._sums.get(track_id, (stamp_ns, 0.0, nothing))
            decay = np.exp(-abs(seconds(stamp_ns - newest_ns)) / self._rules.memory_s)
            if stamp_ns >= newest_ns:
                self._sums[track_id] = stamp_ns, decay * total + count, decay * before + part
            else:
                self._sums[track_id] = newest_ns, total + decay * count, before + decay * part


def _position_noise(candidates: Candidates) -> FloatArray:
    """Covariances of positions without correlated errors, shape (m, 2, 2); 0 where they are not measured as x and y."""
    R = np.zeros((len(candidates), 2, 2))
    for group in candidates.groups:
        if group.stack.model.components[:2] == ("x_m", "y_m"):
            R[group.rows] = group.stack.R[:, :2, :2]
    return R


def _position_innovations(
    candidates: Candidates, rows: IntArray, tracks: IntArray, states: StatesAt, middles_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Innovations (p, 2) of the positions `middles_m`, and H P H' of them (p, 2, 2)."""
    y, HPH = middles_m[rows] - states.means[tracks, :2], states.covariances[tracks, :2, :2].copy()
    for group, members, here in candidates.split(rows):
        if group.stack.model.components[:2] != ("x_m", "y_m"):
            continue
        x = states.means[tracks[here]]
        z = group.stack.z[members].copy()
        z[:, :2] = middles_m[rows[here]]
        off, H = group.stack.model.linearised(z, x, group.stack.pose)
        H = H[..., :2, :]
        y[here], HPH[here] = off[:, :2], H @ states.covariances[tracks[here]] @ np.swapaxes(H, -1, -2)
    return y, HPH


def _merged(
    candidates: Candidates, assignment: Assignment, leads: IntArray, sizes: IntArray
) -> tuple[Candidates, Assignment]:
    """Candidates of which each stands for its set, and the assignment of these."""
    kept = np.flatnonzero(leads == np.arange(len(leads)))
    result, sets = candidates.at(kept.tolist()), dict[int, IntArray]()
    for lead in np.flatnonzero(sizes > 1).tolist():
        sets[lead] = np.flatnonzero(leads == lead)
    more = dict(candidates.merged)
    for lead, members in sets.items():
        leader = candidates.leaders[lead]
        others = [candidates.leaders[row] for row in members.tolist() if row != lead]
        more[leader] = sum((candidates.merged.get(each, ()) for each in [leader, *others]), tuple(others))
    result.merged = more
    values: Mapping[int, FloatArray] = {
        row: _values(candidates, sets[lead], lead) for row, lead in enumerate(kept.tolist()) if lead in sets
    }
    groups = []
    for group in result.groups:
        own = group.stack
        if own.model.components[:2] != ("x_m", "y_m"):
            groups.append(group)
            continue
        z = own.z.copy()
        for k, row in enumerate(group.rows.tolist()):
            if row in values:
                z[k] = values[row]
                result.lines[row, :2] = z[k, :2]
        groups.append(group._replace(stack=replace(own, z=z)))
    result.groups = groups
    new_row = {lead: row for row, lead in enumerate(kept.tolist())}
    pairs = [(new_row[row], track) for row, track in assignment.pairs]
    new = [new_row[row] for row in assignment.new if row in new_row]
    refused = tuple(new_row[row] for row in assignment.refused if row in new_row)
    return result, assignment._replace(pairs=pairs, new=new, refused=refused)


def _values(candidates: Candidates, members: IntArray, lead: int) -> FloatArray:
    """Mean of what the `members` of the leading one's components measure."""
    [(first, _, _)] = candidates.split(np.array([lead]))
    names = first.stack.model.components
    z = [group.stack.z[rows] for group, rows, _ in candidates.split(members) if group.stack.model.components == names]
    stack = np.concatenate(z)
    return np.array(
        [
            circular_mean(column) if name in ANGULAR else column.mean()
            for name, column in zip(names, stack.T, strict=True)
        ]
    )


def _distances(apart_m: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distances y' S^-1 y of y (..., 2), and log det S, shapes (...)."""
    x, y = apart_m[..., 0], apart_m[..., 1]
    det = S[..., 0, 0] * S[..., 1, 1] - S[..., 0, 1] * S[..., 1, 0]
    squared = (S[..., 1, 1] * x * x - 2.0 * S[..., 0, 1] * x * y + S[..., 0, 0] * y * y) / det
    return squared, np.log(det)


def _root(M: FloatArray) -> FloatArray:
    """Symmetric roots of (m, 2, 2): (M + s I) / t with s = sqrt(det M) and t = sqrt(tr M + 2 s)."""
    s = np.sqrt(np.maximum(M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0], 0.0))
    t = np.sqrt(M[:, 0, 0] + M[:, 1, 1] + 2.0 * s)
    return np.asarray((M + s[:, None, None] * np.eye(2)) / t[:, None, None])
