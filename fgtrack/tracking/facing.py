"""Which end of an object is its front: the readings of yaws that a detector may have turned.

The states (yaw, speed) and (yaw + pi, -speed) are the same motion. An estimator keeps the one that it began with, and a
hidden variable of each track is the end, front or rear, to which its yaw belongs. The yaws z of a sensor are
right, half a turn off, or anything with the probabilities a, e and u. Their likelihood is

    p(z | front) = a N(z - yaw) + e N(z - yaw - pi) + u / (2 pi)
    p(z | rear)  = e N(z - yaw) + a N(z - yaw - pi) + u / (2 pi)

The gate, the cost of the association and the update use this one likelihood. The update takes the likeliest reading:
the yaw as it is, turned by pi, or no yaw. The tracker decides it when it associates. Late measurements are replayed as
they were read. A history needs no change when the belief about the front changes: only published states turn.

A speed and the curvature of a path are along the front. Where the yaw of the state is that of the rear, they are read
with the opposite sign. Position, yaw rate and Doppler shift do not depend on the front. The belief about the front
follows from the yaws and the signs of speeds, and from the motion: objects seldom drive backwards. Old evidence fades,
as in a Markov chain. The shares a, e and u of each sensor are learned.
"""

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.linalg import kernels, stacked
from fgtrack.core.time import seconds
from fgtrack.core.types import ACCEL, SPEED, YAW, BoolArray, FloatArray, IntArray, SmoothedReport, TrackState, YawWord
from fgtrack.estimation.base import Measurement, Start, StatesAt
from fgtrack.estimation.filters.propagation import States
from fgtrack.tracking.preprocess import Candidates, Group

#: Components that are opposite where front and rear are exchanged.
SIGNED = ("speed_mps", "curvature_radpm")
#: Numbers of yaws that count as seen before the first one: right, half a turn off, anything.
_PRIOR = (18.0, 1.0, 1.0)
#: Of a sensor so many yaws are remembered: a detector may begin to flip.
_MEMORY = 200.0
#: Largest log-likelihood ratio of one detection: a detector that errs often errs in rows.
_MOST_EVIDENCE = math.log(3.0)
#: Rates at which the yaw of a state changes between front and rear: seldom. Where it is the direction of the velocity,
#: as of a Cartesian state, it does so whenever an object begins to drive backwards.
_SWITCH_HZ, _CARTESIAN_SWITCH_HZ = 0.001, 0.05
#: Log-odds from which a published track is turned.
_SURE = math.log(9.0)
_RIGHT = np.array([1.0, 0.0, 0.0])
_KERNELS = "fgtrack.tracking.facing_kernels"
#: Bits of a reading, as the kernels have them.
HALF_TURN, WITHOUT_YAW, REVERSED = 1, 2, 4
_LOG_RATIO, _FLIPPED, _OTHER = range(3)


class Facings(NamedTuple):
    """Belief about the front of tracks, and the yaws of one sensor."""

    log_odds: FloatArray
    """Of the yaw of the state being that of the front, without the evidence of the speed, shape (tracks,)."""
    shares: FloatArray
    """Probabilities that a yaw is right, half a turn off, and anything, shape (3,)."""
    cartesian: bool
    """True if the states have velocities instead of yaw and speed."""


class Readings(NamedTuple):
    """Ways to read the detections of pairs, their costs, and their evidence."""

    readings: IntArray
    """Bits `HALF_TURN`, `WITHOUT_YAW`, `REVERSED`, or -1 outside the gate, shape (m,)."""
    costs: FloatArray
    """Shape (m,)."""
    evidence: FloatArray
    """Log-likelihood ratio of the front, probabilities that a yaw is half a turn off, and anything, shape (m, 3)."""


class YawsRead(NamedTuple):
    """Likeliest readings of detections, and the defects of their yaws."""

    readings: IntArray
    """Bits `HALF_TURN`, `WITHOUT_YAW`, `REVERSED`, shape (m,)."""
    words: "list[YawWord | None]"
    """None of a yaw that is used as it is, and where none is measured."""


def is_read(group: Group) -> bool:
    """True if a detection of `group` may be read in several ways."""
    return not _READ.isdisjoint(group.stack.model.components)


_READ = {"yaw_rad", *SIGNED}


def read(
    group: Group,
    members: IntArray,
    columns: IntArray,
    states: StatesAt,
    facings: Facings,
    limits: Sequence[float],
    more: FloatArray | None = None,
) -> Readings:
    """Return the readings of pairs of `members` (m,) of `group` and the tracks `columns` (m,) in these `states`.
    `limits` (k + 1,) are the largest NIS by number of components, `more` (m,) is added to the NIS.
    """
    own, names = group.stack, group.stack.model.components
    x = states.means.take(columns, axis=0)
    z = own.z.take(members, axis=0)
    y, H = own.model.linearised(z, x, own.pose)
    P = np.ascontiguousarray(states.covariances)
    R = group.noise(members, x, P, columns)
    yaw = names.index("yaw_rad") if "yaw_rad" in names else -1
    measures_yaw = yaw >= 0 and "yaw_rad" not in own.assumed
    readings, costs, evidence = kernels(_KERNELS).read(
        np.ascontiguousarray(y),
        z,
        stacked(H),
        np.ascontiguousarray(states.means),
        P,
        columns,
        np.ascontiguousarray(R),
        yaw,
        np.array([name in SIGNED for name in names]),
        facings.cartesian,
        facings.log_odds,
        facings.shares if measures_yaw else _RIGHT,
        np.zeros(len(columns)) if more is None else more,
        np.array(limits, dtype=np.float64),
    )
    return Readings(readings, costs, evidence)


def as_read(measurements: Measurement, readings: IntArray) -> list[tuple[IntArray | slice, Measurement]]:
    """Return the stack `measurements` as read by its `readings` (m,), and the rows of each part."""
    if not readings.any():
        return [(slice(None), measurements)]
    names, z, R = measurements.model.components, measurements.z.copy(), measurements.R.copy()
    turned = (readings & HALF_TURN) > 0
    if turned.any():
        yaw = names.index("yaw_rad")
        z[turned, yaw] = wrap_angles(z[turned, yaw] + math.pi)
    reversed_ = (readings & REVERSED) > 0
    if reversed_.any():
        signs = np.array([-1.0 if name in SIGNED else 1.0 for name in names])
        z[reversed_] *= signs
        R[reversed_] *= signs[:, None] * signs
    without = (readings & WITHOUT_YAW) > 0
    parts = list[tuple[IntArray | slice, Measurement]]()
    for rows, columns in (
        ((~without).nonzero()[0], list(range(len(names)))),
        (without.nonzero()[0], [k for k, name in enumerate(names) if name != "yaw_rad"]),
    ):
        if len(rows):
            model = measurements.model if len(columns) == len(names) else measurements.model.part(columns)
            own = R[rows][:, columns][:, :, columns]
            parts.append((rows, replace(measurements, model=model, z=z[rows][:, columns], R=own)))
    return parts


@dataclass(slots=True)
class _Front:
    """Belief about the front of one track."""

    log_odds: float
    stamp_ns: int
    is_turned: bool = False


class Facing:
    """Belief about the front of each track, and the shares of wrong yaws of each sensor; see the module."""

    def __init__(self, cartesian: bool) -> None:
        """`cartesian`: the states have velocities instead of yaw and speed."""
        self._cartesian = cartesian
        self._switch_hz = _CARTESIAN_SWITCH_HZ if cartesian else _SWITCH_HZ
        self._fronts: dict[int, _Front] = {}
        self._ended = set[int]()  # tracks that were published turned, until their last states are published
        self._seen: dict[str, FloatArray] = {}  # by sensor: numbers of yaws that were right, flipped, anything
        self.counts: dict[str, Counter[str]] = {}
        """By sensor: number of `yaws` that tracks used, of those `flipped`, and of those `unused`."""

    def at(self, sensor: str, track_ids: Iterable[int]) -> Facings:
        """Return the belief about some tracks for the detections of `sensor`."""
        fronts = self._fronts
        log_odds = np.array([fronts[i].log_odds if i in fronts else 0.0 for i in track_ids], dtype=np.float64)
        return Facings(log_odds, self._shares_of(sensor), self._cartesian)

    def _shares_of(self, sensor: str) -> FloatArray:
        counts = np.array(_PRIOR) + self._seen.get(sensor, 0.0)
        return np.asarray(counts / counts.sum())

    def born(self, track_id: int, sensor: str, start: Start, first: Measurement) -> None:
        """Begin the belief about a track with this `start` of its `first` measurement, by `sensor`."""
        log_odds = 0.0 if start.yaw_rad is None else _MOST_EVIDENCE
        if "yaw_rad" in first.model.components and "yaw_rad" not in first.assumed:
            right, flip, _ = self._shares_of(sensor).tolist()
            log_odds = _bounded(math.log(right / flip))
        self._fronts[track_id] = _Front(log_odds, start.stamp_ns)

    def read(
        self, sensor: str, stamp_ns: int, candidates: Candidates, pairs: Sequence[tuple[int, int]], states: StatesAt
    ) -> "YawsRead":
        """Return the likeliest readings of `pairs`.
        The belief about the tracks and the shares of `sensor` learn from them.
        """
        result = YawsRead(np.zeros(len(pairs), dtype=np.int64), [None] * len(pairs))
        if not any(map(is_read, candidates.groups)):
            return result
        rows, columns = np.array(pairs).T
        facings = self.at(sensor, states.track_ids)
        for group, members, here in candidates.split(rows):
            if is_read(group):
                of = columns.take(here)
                limits = [math.inf] * (len(group.stack.model.components) + 1)
                found = read(group, members, of, states, facings, limits)
                result.readings[here] = np.maximum(found.readings, 0)
                if "yaw_rad" not in group.stack.assumed:  # the same map is no new evidence
                    has_yaw = "yaw_rad" in group.stack.model.components
                    track_ids = [states.track_ids[column] for column in of.tolist()]
                    words = self._learn(sensor, stamp_ns, found, track_ids, has_yaw)
                    for k, word in zip(here.tolist(), words, strict=True):
                        result.words[k] = word
        return result

    def _learn(
        self, sensor: str, stamp_ns: int, found: Readings, track_ids: Sequence[int], has_yaw: bool
    ) -> list[YawWord | None]:
        """Learn from the evidence of detections of tracks; return the word on each yaw."""
        words = list[YawWord | None]()
        for reading, track_id, (ratio, flipped, other) in zip(
            found.readings.tolist(), track_ids, found.evidence.tolist(), strict=True
        ):
            front = self._fronts[track_id]
            front.log_odds = _later(front.log_odds, self._switch_hz, seconds(stamp_ns - front.stamp_ns))
            front.log_odds += _bounded(ratio)
            front.stamp_ns = max(front.stamp_ns, stamp_ns)
            word: YawWord | None = None
            if has_yaw:
                own, counts = self._seen.setdefault(sensor, np.zeros(3)), self.counts.setdefault(sensor, Counter())
                own *= min(1.0, _MEMORY / (own.sum() + 1.0))
                own += 1.0 - flipped - other, flipped, other
                word = "unused" if reading & WITHOUT_YAW else "flipped" if flipped > 0.5 else None
                counts["yaws"] += 1
                if word is not None:
                    counts[word] += 1
            words.append(word)
        return words

    def published(self, track_ids: Sequence[int], states: Sequence[TrackState]) -> Sequence[TrackState]:
        """Return the kinematic present `states` of tracks, with the yaw of the front; the belief is decided here."""
        fronts = self._fronts
        own = [fronts[track_id] for track_id in track_ids]
        if not own:
            return states
        means, covariances = _arrays(states)
        log_odds, before = np.array([each.log_odds for each in own]), np.array([each.is_turned for each in own])
        after = kernels(_KERNELS).turned(means, covariances, log_odds, before, _SURE)
        if not after.any():
            if before.any():
                for each in own:
                    each.is_turned = False
            return states
        for each, is_turned in zip(own, after.tolist(), strict=True):
            each.is_turned = is_turned
        return turned(states, after)

    def seen(self, track_ids: Sequence[int], states: Sequence[TrackState]) -> Sequence[TrackState]:
        """Return kinematic `states` of tracks at any stamp, with the yaw of what is published as their front."""
        rows = np.array([self._fronts[track_id].is_turned for track_id in track_ids], dtype=bool)
        return turned(states, rows) if rows.any() else states

    def smoothed(self, reports: Sequence[SmoothedReport]) -> Sequence[SmoothedReport]:
        """Return all smoothed `reports` of a tick, with the yaw of what is published as the front of their tracks."""
        fronts, ended, self._ended = self._fronts, self._ended, set()
        backwards = ended.union(track_id for track_id, each in fronts.items() if each.is_turned)
        if not backwards:
            return reports
        return [
            replace(each, state=_turned_one(each.state)) if each.track_id in backwards else each for each in reports
        ]

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended, but for its last smoothed states."""
        if self._fronts.pop(track_id).is_turned:
            self._ended.add(track_id)


def _bounded(log_ratio: float) -> float:
    """Return the evidence of one detection, which errs with those before it, see `_MOST_EVIDENCE`."""
    return min(max(log_ratio, -_MOST_EVIDENCE), _MOST_EVIDENCE)


def _later(log_odds: float, switch_hz: float, dt_s: float) -> float:
    """Return the log-odds after `dt_s`, in which front and rear are exchanged with the rate `switch_hz`."""
    if dt_s <= 0.0:
        return log_odds
    changed = -0.5 * math.expm1(-2.0 * switch_hz * dt_s)
    odds = math.exp(log_odds)
    return math.log((odds * (1.0 - changed) + changed) / (odds * changed + 1.0 - changed))


def _arrays(states: Sequence[TrackState]) -> tuple[FloatArray, FloatArray]:
    """Return means (m, n) and covariances (m, n, n) of kinematic states."""
    if isinstance(states, States):
        x, P = states.means, states.covariances
    else:
        x, P = np.array([each.mean for each in states]), np.array([each.covariance for each in states])
    return np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(P, dtype=np.float64)


def turned(states: Sequence[TrackState], rows: BoolArray) -> States:
    """Return kinematic `states`, those of `rows` (m,) as (yaw + pi, -speed, -acceleration): the same motion."""
    means, covariances = _arrays(states)
    means, covariances = means.copy(), covariances.copy()
    signs = np.ones(means.shape[1])
    signs[[k for k in (SPEED, ACCEL) if k < len(signs)]] = -1.0
    means[rows] *= signs
    means[rows, YAW] = wrap_angles(means[rows, YAW] + math.pi)
    covariances[rows] *= signs[:, None] * signs
    return States([each.stamp_ns for each in states], means, covariances)


def _turned_one(state: TrackState) -> TrackState:
    [result] = turned([state], np.array([True]))
    return result
