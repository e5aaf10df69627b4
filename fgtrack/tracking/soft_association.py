"""Joint probabilistic data association: a track is updated by all detections that it may have given.

The probability b_ji that detection i stems from the object of track j follows from the joint events in which each
detection and each track is used at most once (Fortmann, Bar-Shalom, Scheffe, IEEE J. Oceanic Engineering 8, 1983), with
the weights P_D N(y_ji; 0, S_ji) / clutter density and 1 - P_D. The update by the innovations y_i of a track,

    x + W y,   P - W D W',   y = sum b_i y_i,   D = sum b_i S - sum b_i y_i y_i' + y y',   W = P H' S^-1,

equals that by one measurement with the innovation S D^-1 y and the covariance R + S D^-1 S - S. Estimators fuse and
repeat that one like any other. Approximate are: the probabilities are those of the arrival, later lists do not change
them; S is that of the assigned detection; the eigenvalues of S^-1 D are at least `LEAST_INFORMATION`, where innovations
spread so far that the covariance of the track would grow.
"""

import math
from dataclasses import replace

import numpy as np

from fgtrack.core.linalg import congruence, symmetrise
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.base import Measurement, StatesAt
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import Pairs
from fgtrack.tracking.facing import REVERSED, SIGNED
from fgtrack.tracking.lives.existence import position_densities
from fgtrack.tracking.preprocess import Candidates, Group

LEAST_INFORMATION = 0.05
"""Of an equivalent measurement, relative to that of a detection."""
_ITERATIONS = 30


def joint_probabilities(
    pairs: Pairs, candidates: Candidates, states: StatesAt, sensor: SensorModel
) -> Pairs:
    """Return the `pairs` whose candidates have a position, with the probabilities that candidate and track belong
    together.
    """
    pairs = pairs.at(np.array(candidates.placed, dtype=bool)[pairs.rows])
    rows, columns, _ = pairs
    densities = position_densities(
        candidates, rows, states.means[columns], states.covariances[columns]
    )
    odds = sensor.detection_probability / (1.0 - sensor.detection_probability)
    weights = np.zeros((len(states.means), len(candidates)))
    weights[columns, rows] = odds * np.nan_to_num(densities) / sensor.clutter_per_m2
    return pairs._replace(values=marginals(weights)[columns, rows])


def marginals(weights: FloatArray) -> FloatArray:
    """Return the probabilities that each of m tracks and each of n detections belong together, shape (m, n).

    Belief propagation sums over all joint events (Williams, Lau, IEEE T-AES 50, 2014). The sums are exact if the graph
    of tracks and detections with positive weights has no cycle. `weights` (m, n) are likelihood ratios of a detection
    of the track over a missed detection and clutter.
    """
    ratios = np.ones_like(weights)
    for _ in range(_ITERATIONS):
        messages = weights * ratios
        messages = weights / (1.0 + messages.sum(axis=1, keepdims=True) - messages)
        ratios = 1.0 / (1.0 + messages.sum(axis=0) - messages)
    messages = weights * ratios
    return np.asarray(messages / (1.0 + messages.sum(axis=1, keepdims=True)))


def equivalent(
    seen: Measurement,
    tracks: IntArray,
    group: Group,
    joint: Pairs,
    states: StatesAt,
    readings: IntArray | None = None,
) -> Measurement:
    """Return the equivalent measurements of all detections of `group` that belong to `tracks`, as in the module
    docstring.

    `seen` are the detections that are assigned to `tracks`, with their `readings` (m,), see `fgtrack.tracking.facing`.
    Tracks that are not in `joint` keep their assigned detection. Yaws of other detections are turned by half a turn if
    this brings them nearer, and their speeds have the sign of the reading.
    """
    z, R = seen.z.copy(), seen.R.copy()
    names = seen.model.components
    columns = [group.stack.model.components.index(name) for name in names]
    yaw = (
        names.index("yaw_rad") if "yaw_rad" in names and readings is not None else None
    )
    signed = [row for row, name in enumerate(names) if name in SIGNED]
    members = np.searchsorted(group.rows, joint.rows)
    in_group = group.rows.take(members, mode="clip") == joint.rows
    for k, track in enumerate(tracks.tolist()):
        own = in_group & (joint.columns == track)
        if not own.any():
            continue
        b, x = joint.values[own], states.means[track][None]
        every = np.concatenate([z[k : k + 1], group.stack.z[members[own]][:, columns]])
        if readings is not None and readings[k] & REVERSED:
            every[1:, signed] *= -1.0
        y, H = seen.model.linearised(
            every, np.broadcast_to(x, (len(every), x.shape[1])), seen.pose
        )
        if yaw is not None:
            y[1:, yaw] -= math.pi * np.round(y[1:, yaw] / math.pi)
        L = np.linalg.cholesky(
            congruence(H if H.ndim == 2 else H[0], states.covariances[track]) + R[k]
        )
        white = np.linalg.solve(L, y.T)
        mean = white[:, 1:] @ b
        D = (
            b.sum() * np.eye(len(mean))
            - (b * white[:, 1:]) @ white[:, 1:].T
            + np.outer(mean, mean)
        )
        information, axes = np.linalg.eigh(D)
        inverse = (axes / np.maximum(information, LEAST_INFORMATION)) @ axes.T
        z[k] += L @ (inverse @ mean - white[:, 0])
        R[k] = symmetrise(R[k] + L @ (inverse - np.eye(len(mean))) @ L.T)
    return replace(seen, z=z, R=R)
