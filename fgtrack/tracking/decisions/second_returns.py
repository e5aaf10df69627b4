"""Second returns: the other end of a long hull, or another object?"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.tracking.decisions.entries import Entry
from fgtrack.tracking.decisions.nodes import Nodes
from fgtrack.tracking.lives.existence import densities

Evidence = Mapping[tuple[int, int], float]
"""Evidence that two tracks are two objects, by the roots of both tracks.

This is a log-likelihood ratio: two objects against a hull and its second return. The greatest ratio of all
lists counts.
"""

_HULL_STD_MPS = 0.5
"""Standard deviation of the velocity between both ends of a hull that turns."""


@dataclass(frozen=True)
class Returns:
    """Second returns of a sensor."""

    share: float
    stds_m: tuple[float, float]
    """Standard deviations along and across the course."""
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


def second_returns(entry: Entry, nodes: Nodes, rows: IntArray) -> FloatArray | None:
    """Return the density of second returns of the tracks in `rows` at each candidate, in 1/m^2, shape (m,).

    None if there are no second returns.
    """
    own = entry.sensor.second_returns
    if own is None or not len(rows) or not entry.placed.any():
        return None
    exists = nodes.existed * nodes.alive * nodes.own
    detectable = entry.sensor.detection_probability * nodes.visible[:, entry.index]
    detected = (exists * detectable)[rows]
    y_m = entry.candidates.lines[:, None, :2] - nodes.means[None, rows, :2]
    P = nodes.covariances[rows][:, :2, :2] + _spreads_m2(nodes, rows, own.stds_m)
    m, t = y_m.shape[:2]
    spreads = np.tile(P, (m, 1, 1))
    found = densities(y_m.reshape(-1, 2), spreads, np.zeros(spreads.shape))
    returned = own.share * found.reshape(m, t) @ detected
    return np.asarray(np.where(entry.placed, returned, 0.0))


def own_probabilities(
    nodes: Nodes,
    rows: IntArray,
    returns: Mapping[int, Returns],
    speed_std_mps: float,
    before: Evidence,
) -> tuple[FloatArray, Evidence]:
    """Return the probability that each track is an object of its own, shape (n,), and the evidence after this list.

    Otherwise the track is a second return of a track in `rows`. The second return moves with the hull: the distance of
    both tracks is normal with the standard deviations of the sensor's second returns, and their velocities are nearly
    equal. Another object is anywhere, and has a velocity of its own. Objects that were apart once stay two objects, so
    the greatest ratio counts. A track may be a second return of a track with more detections, or with as many and a
    greater row number, which is older.
    """
    own = np.ones(len(nodes))
    if not returns or len(rows) < 2:
        return own, before
    roots = set(nodes.roots.tolist())
    after = {pair: ratio for pair, ratio in before.items() if roots.issuperset(pair)}
    best = set(rows.tolist())
    for k in range(len(own)):
        given = returns.get(int(nodes.sensors[k]))
        if given is None:
            continue
        distances_m = np.hypot(*(nodes.means[rows, :2] - nodes.means[k, :2]).T)
        hosts = rows[_is_host(nodes, rows, k) & (distances_m < 6.0 * max(given.stds_m))]
        if not len(hosts):
            continue
        ratios = _log_apart(nodes, hosts, k, given, speed_std_mps)
        root = int(nodes.roots[k])
        for j, host in enumerate(nodes.roots[hosts].tolist()):
            pair = min(root, host), max(root, host)
            ratios[j] = max(ratios[j], before.get(pair, -math.inf))
            if k in best:
                after[pair] = float(ratios[j])
        seen = given.log_seen(int(nodes.counts[k]), int(nodes.misses[k]))
        odds = np.exp(np.clip(-ratios - seen, -50.0, 50.0)).sum()
        own[k] = 1.0 / (1.0 + odds)
    return own, after


def _log_apart(
    nodes: Nodes, hosts: IntArray, k: int, given: Returns, speed_std_mps: float
) -> FloatArray:
    """Return the log-likelihood ratio of an object to a second return of each host, shape (t,).

    The position and the velocity of track `k` count.
    """
    position, velocity = slice(0, 2), slice(2, 4)
    x = nodes.means[hosts] - nodes.means[k]
    P = nodes.covariances[hosts] + nodes.covariances[k]
    exists = (nodes.existed * nodes.alive * nodes.own)[hosts]
    size_m2 = _spreads_m2(nodes, hosts, given.stds_m)
    slow_m2ps2 = _HULL_STD_MPS**2 * np.eye(2)
    speeds_m2ps2 = 2.0 * speed_std_mps**2 * np.eye(2)
    log_return = (
        np.log(np.maximum(given.share * exists, 1e-300))
        + _log_normal(x[:, position], P[:, position, position] + size_m2)
        + _log_normal(x[:, velocity], P[:, velocity, velocity] + slow_m2ps2)
    )
    log_object = given.log_new_per_m2 + _log_normal(
        x[:, velocity], P[:, velocity, velocity] + speeds_m2ps2
    )
    return np.asarray(log_object - log_return)


def _spreads_m2(
    nodes: Nodes, rows: IntArray, stds_m: tuple[float, float]
) -> FloatArray:
    """Return the covariances of second returns around the tracks in `rows`, shape (t, 2, 2).

    `stds_m` are those along and across the course. The mean over the uncertain direction of the velocity is taken: an
    angle with the variance a^2 has the mean cosine of its double exp(-2 a^2).
    """
    along_m, across_m = stds_m
    v = nodes.means[rows, 2:4]
    P = nodes.covariances[rows][:, 2:4, 2:4]
    speeds2 = np.maximum((v * v).sum(axis=1), 1e-12)
    variances_rad2 = 0.5 * P.trace(axis1=1, axis2=2) / speeds2
    is_known = np.exp(-2.0 * variances_rad2)[:, None, None]
    ahead = v[:, :, None] * v[:, None, :] / speeds2[:, None, None]
    lengthways = is_known * ahead + 0.5 * (1.0 - is_known) * np.eye(2)
    crossways = np.eye(2) - lengthways
    return np.asarray(along_m**2 * lengthways + across_m**2 * crossways)


def _is_host(nodes: Nodes, rows: IntArray, k: int) -> BoolArray:
    """Mask of the tracks in `rows` of which track `k` may be a second return."""
    is_more = nodes.hits[rows] > nodes.hits[k]
    is_equal = nodes.hits[rows] == nodes.hits[k]
    return np.asarray(is_more | (is_equal & (rows > k)))


def _log_normal(x: FloatArray, P: FloatArray) -> FloatArray:
    """Return log N(x; 0, P) of vectors (m, 2) with covariances (m, 2, 2), shape (m,)."""
    own = densities(np.ascontiguousarray(x), P, np.zeros(P.shape))
    return np.asarray(np.log(np.maximum(own, 1e-300)))
