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
with the opposite sign. The sign is changed only where that is sure: at rest the nearer one of both signs would bias the
speed. Position, yaw rate and Doppler shift do not depend on the front. The belief about the front follows from the yaws
and the signs of speeds, and from the motion: objects seldom drive backwards. Old evidence fades, as in a Markov chain.
The shares a, e and u of each sensor are learned.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import ClassVar, NamedTuple

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.linalg import kernels, stacked
from fgtrack.core.state import Stateful
from fgtrack.core.types import (
    ACCEL,
    SPEED,
    YAW,
    BoolArray,
    FloatArray,
    IntArray,
    SmoothedReport,
    TrackState,
    YawWord,
)
from fgtrack.estimation.base import Measurement, Start, StatesAt
from fgtrack.estimation.filters.propagation import States
from fgtrack.tracking.preprocess import Candidates, Group

#: Components that are opposite where front and rear are exchanged.
SIGNED = ("speed_mps", "curvature_radpm")
#: Numbers of yaws that count as seen before the first one: right, half a turn off, anything.
_PRIOR = np.array([18.0, 1.0, 1.0])
#: Of a sensor so many yaws are remembered: a detector may begin to flip.
MEMORY = 200.0
#: Largest log-likelihood ratio of one detection: a detector that errs often errs in rows.
MOST_EVIDENCE = math.log(3.0)
#: Rates at which the yaw of a state changes between front and rear: seldom. Where it is the direction of the velocity,
#: as of a Cartesian state, it does so whenever an object begins to drive backwards.
_SWITCH_HZ, _CARTESIAN_SWITCH_HZ = 0.001, 0.05
#: Log-odds from which a published track is turned.
_SURE = math.log(9.0)
_RIGHT = np.array([1.0, 0.0, 0.0])
_KERNELS = "fgtrack.tracking.facing_kernels"
#: Bits of a reading; 0 takes the detection as it was measured.
HALF_TURN, WITHOUT_YAW, REVERSED = 1, 2, 4
_WORDS: "dict[int, YawWord]" = {
    1: "flipped",
    2: "unused",
}  # by the defect that the kernels number


class Facings(NamedTuple):
    """Log-odds of the fronts of tracks, and shares of right and wrong yaws of one sensor."""

    log_odds: FloatArray
    """Log-odds that the yaw of the state is the yaw of the front, without the evidence of the speed, shape
    (tracks,).
    """
    shares: FloatArray
    """Probabilities that a yaw is right, is half a turn off, and is arbitrary, shape (3,)."""
    cartesian: bool
    """True if the states have velocities instead of yaw and speed."""


class Readings(NamedTuple):
    """Readings of detections of a group as detections of tracks, with their costs and their evidence."""

    group: Group
    members: IntArray
    """Indices in the group, ascending, shape (m,)."""
    columns: IntArray
    """Indices of the tracks, ascending for each member, shape (m,)."""
    codes: IntArray
    """Bits `HALF_TURN`, `WITHOUT_YAW`, `REVERSED`, or -1 outside the gate, shape (m,)."""
    costs: FloatArray
    """Costs of the association, shape (m,)."""
    evidence: FloatArray
    """Log-likelihood ratio of the front, probabilities that a yaw is half a turn off, and anything, shape (m, 3)."""


class YawsRead(NamedTuple):
    """Likeliest reading of each detection, and the defect of its yaw."""

    readings: IntArray
    """Bits, shape (m,). `HALF_TURN`: the yaw is half a turn off. `WITHOUT_YAW`: the yaw is not used. `REVERSED`: the
    yaw of the state is the yaw of the rear.
    """
    words: "list[YawWord | None]"
    """Defect of each yaw; None for a yaw that is used as it was measured, and for a detection without a yaw."""


class _Kind(NamedTuple):
    """Properties of measured components."""

    yaw: int
    """Index of the yaw; -1 without a yaw."""
    signed: BoolArray
    """True for the components in `SIGNED`, shape (k,)."""
    is_read: bool
    """True if a detection may be read in several ways."""


@cache
def _kind(names: tuple[str, ...]) -> _Kind:
    yaw = names.index("yaw_rad") if "yaw_rad" in names else -1
    signed = np.array([name in SIGNED for name in names])
    return _Kind(yaw, signed, yaw >= 0 or bool(signed.any()))


def is_read(group: Group) -> bool:
    """True if a detection of `group` may be read in several ways."""
    return _kind(group.stack.model.components).is_read


def read(
    group: Group,
    members: IntArray,
    columns: IntArray,
    states: StatesAt,
    facings: Facings,
    limits: FloatArray,
    more: FloatArray | None = None,
) -> Readings:
    """Return the readings of pairs of `members` (m,) of `group` and the tracks `columns` (m,), which have these
    `states`.

    `limits` (k + 1,) are the largest NIS by number of components. `more` (m,) is added to the NIS.
    """
    own, kind = group.stack, _kind(group.stack.model.components)
    x = states.means.take(columns, axis=0)
    z = own.z.take(members, axis=0)
    y, H = own.model.linearised(z, x, own.pose)
    P = np.ascontiguousarray(states.covariances)
    R = group.noise(members, x, P, columns)
    learns = "yaw_rad" not in own.assumed  # the same map is no new evidence
    found = kernels(_KERNELS).read(
        y,
        z,
        stacked(H),
        np.ascontiguousarray(states.means),
        P,
        columns,
        R,
        kind.yaw,
        kind.signed,
        facings.cartesian,
        facings.log_odds,
        facings.shares if learns else _RIGHT,
        learns,
        np.zeros(len(columns)) if more is None else more,
        limits,
    )
    return Readings(group, members, columns, *found)


def as_read(
    measurements: Measurement, readings: IntArray
) -> list[tuple[IntArray | slice, Measurement]]:
    """Return the stack `measurements` as its `readings` (m,) interpret the yaws, in one or two parts, each with its
    rows.

    Measurements whose yaw is not used are a part without the yaw.
    """
    if not readings.any():
        return [(slice(None), measurements)]
    names, z, R = (
        measurements.model.components,
        measurements.z.copy(),
        measurements.R.copy(),
    )
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
        (
            without.nonzero()[0],
            [k for k, name in enumerate(names) if name != "yaw_rad"],
        ),
    ):
        if len(rows):
            model = (
                measurements.model
                if len(columns) == len(names)
                else measurements.model.part(columns)
            )
            own = R[rows][:, columns][:, :, columns]
            parts.append(
                (rows, replace(measurements, model=model, z=z[rows][:, columns], R=own))
            )
    return parts


class Facing(Stateful):
    """Belief about the front of each track, and the shares of wrong yaws of each sensor; see the module."""

    STATE: ClassVar[tuple[str, ...]] = (
        "_rows",
        "_last_ids",
        "_last_rows",
        "_free",
        "_log_odds",
        "_stamps_ns",
        "_least_log_odds",
        "_turned",
        "_is_any_turned",
        "_ended",
        "_seen",
        "_shares",
        "counts",
    )

    def __init__(self, cartesian: bool) -> None:
        """`cartesian`: the states have velocities instead of yaw and speed."""
        self._cartesian = cartesian
        self._switch_hz = _CARTESIAN_SWITCH_HZ if cartesian else _SWITCH_HZ
        self._rows: dict[int, int] = {}  # of the arrays, by track
        self._last_ids: tuple[int, ...] = ()
        self._last_rows = np.zeros(0, dtype=np.int64)
        self._free: list[int] = []
        self._log_odds = np.zeros(0)
        self._stamps_ns = np.zeros(0, dtype=np.int64)
        self._least_log_odds: float | None = None  # of `_log_odds`, until they change
        self._turned = np.zeros(0, dtype=bool)
        self._is_any_turned = False
        self._ended = set[
            int
        ]()  # tracks that were published turned, until their last states are published
        self._seen: dict[
            str, FloatArray
        ] = {}  # by sensor: numbers of yaws that were right, flipped, anything
        self._shares: dict[str, FloatArray] = {}  # of the numbers, until they change
        self.counts: dict[str, Counter[str]] = {}
        """Numbers of yaws by sensor: all `yaws` of detections that tracks used, `flipped` yaws and `unused` yaws."""

    def at(self, sensor: str, track_ids: tuple[int, ...]) -> Facings:
        """Return the log-odds of the fronts of tracks, and the shares of wrong yaws of `sensor`."""
        return Facings(
            self._log_odds[self._rows_of(track_ids)],
            self._shares_of(sensor),
            self._cartesian,
        )

    def _rows_of(self, track_ids: tuple[int, ...]) -> IntArray:
        """Return the rows of tracks in the arrays, shape (m,). The last result is kept for a call with the same
        tracks.
        """
        if track_ids != self._last_ids:
            self._last_ids = track_ids
            self._last_rows = np.array(
                [self._rows[track_id] for track_id in track_ids], dtype=np.int64
            )
        return self._last_rows

    def _shares_of(self, sensor: str) -> FloatArray:
        shares = self._shares.get(sensor)
        if shares is None:
            seen = self._seen.get(sensor, np.zeros(3))
            shares = self._shares[sensor] = shares_of(seen)
        return shares

    def born(
        self, track_id: int, sensor: str, start: Start, first: Measurement
    ) -> None:
        """Begin the log-odds of a track with this `start`, from its `first` measurement, by `sensor`."""
        log_odds = 0.0 if start.yaw_rad is None else MOST_EVIDENCE
        if "yaw_rad" in first.model.components and "yaw_rad" not in first.assumed:
            right, flip, _ = self._shares_of(sensor).tolist()
            log_odds = min(max(math.log(right / flip), -MOST_EVIDENCE), MOST_EVIDENCE)
        if not self._free:
            present = len(self._log_odds)
            more = max(present, 8)
            self._log_odds = np.concatenate([self._log_odds, np.zeros(more)])
            self._stamps_ns = np.concatenate(
                [self._stamps_ns, np.zeros(more, dtype=np.int64)]
            )
            self._turned = np.concatenate([self._turned, np.zeros(more, dtype=bool)])
            self._free = list(range(present, present + more))
        row = self._rows[track_id] = self._free.pop()
        self._log_odds[row], self._stamps_ns[row], self._turned[row] = (
            log_odds,
            start.stamp_ns,
            False,
        )
        self._last_ids, self._least_log_odds = (), None

    def read(
        self,
        sensor: str,
        stamp_ns: int,
        candidates: Candidates,
        pairs: Sequence[tuple[int, int]],
        found: Sequence[Readings],
        states: StatesAt,
    ) -> YawsRead | None:
        """Return the likeliest readings of the assigned `pairs`; None if all yaws are used as measured and have no
        defect.

        The log-odds of the tracks and the shares of `sensor` learn from the readings. `found` are the readings of the
        pairs that the association has compared. If they are empty, the `pairs` are read here.
        """
        if not any(map(is_read, candidates.groups)):
            return None
        useful = [
            each
            for each in found
            if _learns(each.group) or each.codes.max(initial=0) > 0
        ]
        if found and not useful:
            return None
        rows, columns = np.array(pairs).T
        keys = rows * len(states.means) + columns
        useful = useful or self._read(sensor, candidates, rows, columns, states)
        readings, words = (
            np.zeros(len(pairs), dtype=np.int64),
            list[YawWord | None]([None] * len(pairs)),
        )
        for each in useful:
            own = each.group.rows.take(each.members) * len(states.means) + each.columns
            at = own.searchsorted(keys)
            here = (own.take(at, mode="clip") == keys).nonzero()[0]
            at = at[here]
            readings[here] = codes = np.maximum(each.codes[at], 0)
            if _learns(each.group) and len(here):
                has_yaw = _kind(each.group.stack.model.components).yaw >= 0
                of = self._rows_of(states.track_ids)[columns[here]]
                for k, word in self._learn(
                    sensor, stamp_ns, of, codes, each.evidence[at], has_yaw, rows[here]
                ):
                    words[here[k]] = word
        return YawsRead(readings, words) if readings.any() or any(words) else None

    def _read(
        self,
        sensor: str,
        candidates: Candidates,
        rows: IntArray,
        columns: IntArray,
        states: StatesAt,
    ) -> list[Readings]:
        """Return the readings of candidates `rows` (m,) as detections of the tracks `columns` (m,), without a gate."""
        facings, result = self.at(sensor, states.track_ids), list[Readings]()
        for group, members, here in candidates.split(rows):
            if is_read(group):
                limits = np.full(len(group.stack.model.components) + 1, np.inf)
                result.append(
                    read(group, members, columns[here], states, facings, limits)
                )
        return result

    def _learn(
        self,
        sensor: str,
        stamp_ns: int,
        rows: IntArray,
        codes: IntArray,
        evidence: FloatArray,
        has_yaw: bool,
        candidates: IntArray,
    ) -> list[tuple[int, YawWord]]:
        """Learn from readings (m,) of the `candidates`, detections of the tracks in `rows`.

        Returns the index and the defect of each yaw that has a defect.
        """
        seen = self._seen.setdefault(sensor, np.zeros(3)) if has_yaw else np.zeros(3)
        arrays = self._log_odds, self._stamps_ns, seen
        self._least_log_odds = None
        defects = kernels(_KERNELS).learn(
            rows, stamp_ns, codes, evidence, has_yaw, self._switch_hz, *arrays
        )
        if not has_yaw:
            return []
        self._shares.pop(sensor, None)
        words = [(k, _WORDS[defects[k]]) for k in defects.nonzero()[0].tolist()]
        if self._is_new(sensor, stamp_ns, candidates, evidence):
            counts = self.counts.setdefault(sensor, Counter())
            counts["yaws"] += len(rows)
            counts.update([word for _, word in words])
        return words

    def _is_new(
        self, sensor: str, stamp_ns: int, candidates: IntArray, evidence: FloatArray
    ) -> bool:
        """True if a yaw of the `candidates` (m,), with this `evidence` (m, 3), was not counted before."""
        return True

    def published(
        self, track_ids: tuple[int, ...], states: Sequence[TrackState]
    ) -> Sequence[TrackState]:
        """Return the present kinematic `states` of tracks, with the yaw of the front.

        The front of each track is decided here, from its log-odds and its speed; `seen` and `smoothed` keep the
        decision.
        """
        if not track_ids:
            return states
        if isinstance(states, States) and not self._is_any_turned:
            if self._least_log_odds is None:
                self._least_log_odds = float(self._log_odds.min())
            if (
                self._least_log_odds >= -_SURE
                and not states.means[:, SPEED].min() < 0.0
            ):
                return states
        rows = self._rows_of(track_ids)
        before = self._turned[rows]
        after = kernels(_KERNELS).turned(
            *_arrays(states), self._log_odds[rows], before, _SURE
        )
        if not (self._is_any_turned or after.any()):
            return states
        self._turned[rows] = after
        self._is_any_turned = bool(after.any())
        return turned(states, after) if self._is_any_turned else states

    def seen(
        self, track_ids: tuple[int, ...], states: Sequence[TrackState]
    ) -> Sequence[TrackState]:
        """Return kinematic `states` of tracks at any stamp, with the yaw of the front that `published` has decided."""
        return (
            turned(states, self._turned[self._rows_of(track_ids)])
            if self._is_any_turned
            else states
        )

    def smoothed(self, reports: Sequence[SmoothedReport]) -> Sequence[SmoothedReport]:
        """Return all smoothed `reports` of a tick, with the yaw of the front that `published` has decided."""
        ended, self._ended = self._ended, set()
        if not (self._is_any_turned or ended):
            return reports
        backwards = ended.union(
            track_id for track_id, row in self._rows.items() if self._turned[row]
        )
        return [
            replace(each, state=_turned_one(each.state))
            if each.track_id in backwards
            else each
            for each in reports
        ]

    def forget(self, track_id: int) -> None:
        """Forget a track that has ended. Its decided front is kept for its last smoothed states."""
        row = self._rows.pop(track_id, None)
        if row is None:
            return  # its start was interrupted
        self._last_ids, self._least_log_odds = (), None
        self._log_odds[row] = 0.0
        self._free.append(row)
        if self._turned[row]:
            self._ended.add(track_id)


def shares_of(seen: FloatArray) -> FloatArray:
    """Return the shares of yaws that are right, flipped and anything, from their numbers `seen`, both shape (3,)."""
    counts = _PRIOR + seen
    return np.asarray(counts / counts.sum())


def _learns(group: Group) -> bool:
    """True if the yaws of `group` are evidence of the front. Yaws taken from the map are no evidence."""
    return "yaw_rad" not in group.stack.assumed


def _arrays(states: Sequence[TrackState]) -> tuple[FloatArray, FloatArray]:
    """Return means (m, n) and covariances (m, n, n) of kinematic states."""
    if isinstance(states, States):
        x, P = states.means, states.covariances
    else:
        x, P = (
            np.array([each.mean for each in states]),
            np.array([each.covariance for each in states]),
        )
    return np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(
        P, dtype=np.float64
    )


def turned(states: Sequence[TrackState], rows: BoolArray) -> States:
    """Return kinematic `states`. The states of `rows` (m,) become (yaw + pi, -speed, -acceleration): the same
    motion.
    """
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
