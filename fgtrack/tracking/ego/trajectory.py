"""Pose of the ego vehicle at the stamp of a detection."""

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from itertools import pairwise
from operator import attrgetter
from typing import ClassVar, NamedTuple

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.linalg import ASYMMETRY, congruence, is_covariance, symmetrise
from fgtrack.core.state import Stateful
from fgtrack.core.time import NS_PER_S, nanoseconds, seconds
from fgtrack.core.types import YAW, EgoState, FloatArray
from fgtrack.estimation.filters.ekf import updated_one
from fgtrack.models.dead_reckoning import (
    PositionEstimate,
    ReportedErrors,
    estimate_position,
)
from fgtrack.tracking.ego.growth import EgoGrowth, Learned

#: A detection whose stamp is further than this from any ego state cannot be placed, in a gap neither.
MAX_EXTRAPOLATION_S = 1.0
LARGEST_STEP_BACK_S = 1.0
"""A state that is older than the newest one by more than this has a wrong stamp."""
_LARGEST_STEP_BACK_NS = nanoseconds(LARGEST_STEP_BACK_S)
MAX_EXTRAPOLATION_NS = nanoseconds(MAX_EXTRAPOLATION_S)
_MAX_FUTURE_NS = (
    NS_PER_S  # a state stamped further ahead of its receipt has a wrong stamp
)
CONTRADICTS = "contradicts its neighbours"
_LONGEST_S, _SLACK_M, _SHARE, _SIGMAS = 1.0, 2.0, 0.5, 3.0  # see `EgoTrajectory`
_STRAIGHT_RAD = 1e-6  # half of a turn below which chord and arc are the same
_FIELDS = [field.name for field in fields(EgoState)]
_VALUES = attrgetter(*_FIELDS)
_YAW, _YAW_RATE = _FIELDS.index("yaw_rad"), _FIELDS.index("yaw_rate_radps")
_REMEMBERED_S = 1.0  # memory of a track; an error of the velocity is independent from one to the next
_LEAST_STD = 0.01  # m, m/s: no position or speed is reported more exactly
_FAR_APART_NS = nanoseconds(
    0.15
)  # two states; at 70 m/s and 0.3 rad/s their chord is 6 cm off the arc
_ROUNDING = np.diag(
    np.square([_LEAST_STD, _LEAST_STD, 1e-3, _LEAST_STD, 1e-3])
)  # of x, y, yaw, speed, yaw rate
_ALL = np.eye(5)  # both extrapolated states give every component


class EgoPose(NamedTuple):
    """Pose of the ego reference point in the map, and how it moves."""

    x_m: float
    y_m: float
    yaw_rad: float
    speed_mps: float
    yaw_rate_radps: float = 0.0
    covariance: FloatArray | None = None
    """Covariance of the five fields above, shape (5, 5), read-only; None if it is unknown or not requested."""
    extrapolated_s: float = 0.0
    """Time from the nearest state to a pose that is extrapolated; below 0 before the first state, 0 between states."""


def is_finite(ego: EgoState) -> bool:
    """True if the numbers of `ego` are finite, and their magnitudes sum up to at most `LARGEST`."""
    return bool(sum(map(abs, _VALUES(ego)[2:8])) <= LARGEST)


def extrapolated(
    ego: EgoState,
    stamp_ns: int,
    covariance: FloatArray | None = None,
    straight: bool = False,
) -> EgoPose:
    """Return the pose of `ego` moved to `stamp_ns` on the circle that it drives. The yaw is not wrapped.

    `covariance`, shape (5, 5), is the covariance of `ego`; deviations from the circle are not added. With `straight`
    the position moves along the heading, as in the published tracker; at 60 m/s and 0.4 rad/s this is 12 m off after
    1 s.
    """
    dt_s = (stamp_ns - ego.stamp_ns) / NS_PER_S
    half_rad = 0.0 if straight else 0.5 * ego.yaw_rate_radps * dt_s
    bent = abs(half_rad) > _STRAIGHT_RAD
    chord_s = dt_s * math.sin(half_rad) / half_rad if bent else dt_s
    travelled_m, c, s = (
        ego.speed_mps * chord_s,
        math.cos(ego.yaw_rad + half_rad),
        math.sin(ego.yaw_rad + half_rad),
    )
    if covariance is not None and dt_s:
        F = np.eye(5)
        F[:2, 2:4] = [[-travelled_m * s, c * chord_s], [travelled_m * c, s * chord_s]]
        F[2, 4] = dt_s
        if not straight:
            shortened_s = (
                dt_s * (math.cos(half_rad) * dt_s - chord_s) / (2.0 * half_rad)
                if bent
                else 0.0
            )
            F[:2, 4] = 0.5 * dt_s * F[:2, 2] + ego.speed_mps * shortened_s * np.array(
                [c, s]
            )
        covariance = congruence(F, covariance)
    return EgoPose(
        ego.x_m + travelled_m * c,
        ego.y_m + travelled_m * s,
        ego.yaw_rad + ego.yaw_rate_radps * dt_s,
        ego.speed_mps,
        ego.yaw_rate_radps,
        covariance,
    )


class EgoStd(NamedTuple):
    """Standard deviations that replace missing standard deviations of an ego state; 0 for an exact value."""

    position_m: float = 0.0
    yaw_rad: float = 0.0
    speed_mps: float = 0.0
    yaw_rate_radps: float = 0.0


@lru_cache(maxsize=1024)  # one localisation often reports the same for all its states
def _completed(given: tuple[float, ...] | None, std: EgoStd) -> FloatArray | None:
    """Return the covariance `given`, shape (5, 5), read-only, in which `std` replaces variances of 0.

    A covariance that is None counts as 0. Returns None if the result is 0.
    """
    P = np.zeros((5, 5)) if given is None else symmetrise(np.array(given).reshape(5, 5))
    P += np.diag(np.where(np.diag(P) > 0.0, 0.0, np.square((std.position_m, *std))))
    P.flags.writeable = False
    return P if P.any() else None


@lru_cache(maxsize=1024)
def is_ego_covariance(given: tuple[float, ...]) -> bool:
    """True if these are the 25 entries of a symmetric positive semidefinite matrix."""
    return len(given) == 25 and is_covariance(np.array(given).reshape(5, 5), -ASYMMETRY)


def _consistent(before: EgoState, after: EgoState) -> bool:
    dt_s = (after.stamp_ns - before.stamp_ns) / NS_PER_S
    if abs(dt_s) > _LONGEST_S:
        return True
    travelled_m = 0.5 * (before.speed_mps + after.speed_mps) * dt_s
    off_m = math.hypot(
        after.x_m - before.x_m - travelled_m * math.cos(before.yaw_rad),
        after.y_m - before.y_m - travelled_m * math.sin(before.yaw_rad),
    )
    if off_m <= _SLACK_M:  # as nearly always
        return True
    given = [ego.covariance for ego in (before, after) if ego.covariance is not None]
    variance_m2 = sum(
        max(0.0, each[0] + each[6]) for each in given
    )  # of x and y; NaN counts as 0
    return off_m <= _SLACK_M + _SHARE * abs(travelled_m) + _SIGMAS * math.sqrt(
        variance_m2
    )


class EgoTrajectory(Stateful):
    """Low-passed ego states, each filtered once, and interpolated between their stamps.

    The weights of the low-pass are those of new values. It pulls towards the previous state *extrapolated to the new
    stamp*, so a steady turn is not delayed. With `std`, poses have the covariance of their states, and `std` where
    these give none; the low-pass leaves it as it is.

    A state that contradicts the one before it is held back until the next one decides which of the two is wrong. Two
    states at most 1 s apart contradict each other where the way between them differs from that at their speeds by more
    than the sum of half of it, 2 m, and three standard deviations of their positions. A single state that contradicts
    both neighbours is left out; where the states go on from it, the ego has jumped, and is followed. States that never
    fit, of an ego with an unknown speed, are all taken.

    If a state comes late, the newer states are filtered once more: the low-pass and the growth follow the stamps.

    With `position_time_s`, the correlation time of the error of reported positions, these are fused with speed and yaw,
    see `dead_reckoning`. An error that all poses of a track have in common is no motion of it, so the position of a
    pose has the variance of a dead reckoning of 1 s, as long as a track remembers, instead of its own.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        "_growth",
        "_reckoned",
        "_newest_ns",
        "_last",
        "_held",
        "_fits",
        "_states",
        "_stamps",
        "_reported",
        "_learned",
        "_in_pit",
        "_changed_ns",
        "current",
        "jumps",
        "in_pit",
    )

    _straight = False

    def __init__(
        self,
        yaw_weight: float,
        yaw_rate_weight: float,
        std: EgoStd | None = None,
        memory_s: float = 5.0,
        position_time_s: float | None = None,
        growth: EgoGrowth | None = None,
    ) -> None:
        self._growth = growth
        self._yaw_weight, self._yaw_rate_weight, self._std = (
            yaw_weight,
            yaw_rate_weight,
            std,
        )
        self._position_time_s = position_time_s
        self._reckoned: list[PositionEstimate] = []  # of states that are fused
        self._memory_ns = nanoseconds(memory_s)
        self._newest_ns: int | None = None
        self._last: EgoState | None = None
        self._held: EgoState | None = None
        self._fits = False  # the last two states are consistent
        self._states: list[EgoState] = []
        self._stamps: list[int] = []
        # States as they were reported, and what the growth had learned at each.
        self._reported: list[EgoState] = []
        self._learned: list[Learned | None] = []
        # Stamps and values of the states that report whether the ego is in the pit lane.
        self._in_pit: list[tuple[int, bool]] = []
        self._changed_ns: int | None = None
        self.current: EgoState | None = None
        """Newest state."""
        self.jumps = 0
        """Number of times that the states went on from another position."""
        self.in_pit = False
        """True if the ego was last reported in the pit lane."""

    def receive(self, ego: EgoState) -> str | None:
        """Receive a state of the ego. Return the reason if it is refused, or if the state held back before is refused.

        None if no state is refused.
        """
        if ego.in_pit is not None:
            bisect.insort(self._in_pit, (ego.stamp_ns, ego.in_pit))
            self.in_pit = self._in_pit[-1][1]
        if not is_finite(ego):
            return "not finite"
        if (
            self._std is not None
            and ego.covariance is not None
            and not is_ego_covariance(ego.covariance)
        ):
            return "not a covariance"
        if ego.stamp_ns - ego.receipt_ns > _MAX_FUTURE_NS:
            return "stamp ahead of its receipt"
        newest_ns = ego.stamp_ns if self._newest_ns is None else self._newest_ns
        if newest_ns - ego.stamp_ns > _LARGEST_STEP_BACK_NS:
            return "stamp jumps back"
        self._newest_ns = max(newest_ns, ego.stamp_ns)
        return self._store(ego)

    def located(self, ego: EgoState) -> EgoState:
        """Return `ego` at the position that is used at its stamp."""
        if self._position_time_s is None or not is_finite(ego):
            return ego
        pose = self.pose_at(ego.stamp_ns, ego.stamp_ns)
        return ego if pose is None else replace(ego, x_m=pose.x_m, y_m=pose.y_m)

    def start_tick(self) -> None:
        """Begin a tick; this trajectory does not depend on ticks."""

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest state from which poses are taken; None before the first state."""
        return self._stamps[-1] if self._stamps else None

    def changed_after_ns(self) -> int | None:
        """Return the stamp after which poses may have changed since the last call; None if no pose has changed."""
        changed_ns, self._changed_ns = self._changed_ns, None
        return changed_ns

    def accel_at(self, stamp_ns: int) -> float:
        """Return the acceleration that the nearest state reports, in m/s^2; 0 without a state."""
        return self._nearest(stamp_ns).accel_mps2 if self._stamps else 0.0

    def in_pit_at(self, stamp_ns: int) -> bool:
        """True if the ego was in the pit lane, by the states up to a stamp."""
        row = bisect.bisect_right(self._in_pit, (stamp_ns, True))
        return self._in_pit[row - 1][1] if row else False

    def placed(
        self,
        stamp_ns: int,
        present_ns: int,
        range_m: Callable[[], float | None],
        others_ns: Sequence[int] | None = None,
    ) -> EgoPose | None:
        """Return `pose_at` for a list whose detections are moved into the map by this pose.

        `range_m` returns the usual distance of the objects of the list. The error of an extrapolated pose lasts for
        several lists: its growth counts as `EgoGrowth` describes. `others_ns` are the stamps of the lists that share
        this error; None for all lists that were placed before.
        """
        pose = self.pose_at(stamp_ns, present_ns)
        if pose is None or self._growth is None or not pose.extrapolated_s:
            return pose
        ego = self._nearest(stamp_ns)
        shared = self._growth.shared(
            ego,
            pose.extrapolated_s,
            stamp_ns,
            range_m(),
            self._learned_at(stamp_ns),
            others_ns,
        )
        return self._grown(ego, stamp_ns, shared)

    def growth_at(self, stamp_ns: int) -> FloatArray | None:
        """Covariance that an extrapolation from the nearest state to `stamp_ns` adds, shape (5, 5).

        None if the trajectory has no states, or does not learn the growth.
        """
        if self._growth is None or not self._stamps:
            return None
        nearest = self._nearest(stamp_ns)
        return self._growth.covariance(
            nearest,
            seconds(stamp_ns - nearest.stamp_ns),
            self._learned_at(stamp_ns),
        )

    def pose_at(self, stamp_ns: int, present_ns: int) -> EgoPose | None:
        """Return the pose at `stamp_ns`, or None if it is unknown. `present_ns` is the tracking time.

        Beyond its ends, and into a gap, the trajectory is extrapolated for a limited time. A gap is longer than two
        extrapolations, from both sides, can bridge.
        """
        if not self._stamps:
            return None
        around = self._around(stamp_ns)
        if (
            len(around) == 2
            and around[1].stamp_ns - around[0].stamp_ns <= 2 * MAX_EXTRAPOLATION_NS
        ):
            return self._interpolated(around[0], around[1], stamp_ns)
        nearest = self._nearest(stamp_ns)
        if abs(stamp_ns - nearest.stamp_ns) > MAX_EXTRAPOLATION_NS:
            return None
        return self._extrapolated(nearest, stamp_ns)

    def _around(self, stamp_ns: int) -> Sequence[EgoState]:
        """Return the states before and at or after `stamp_ns`; a single state beyond the ends."""
        row = bisect.bisect_left(self._stamps, stamp_ns)
        return self._states[max(row - 1, 0) : row + 1]

    def _nearest(self, stamp_ns: int) -> EgoState:
        return min(self._around(stamp_ns), key=lambda ego: abs(stamp_ns - ego.stamp_ns))

    def _learned_at(self, stamp_ns: int) -> Learned | None:
        """Return what the growth had learned at the first state at or after a stamp; at the newest one without it."""
        row = bisect.bisect_left(self._stamps, stamp_ns)
        return self._learned[min(row, len(self._learned) - 1)]

    def _store(self, ego: EgoState) -> str | None:
        """Insert a state, or hold it back. Return the reason if it, or the state held back before, is refused; else
        None.
        """
        if self._fits_its_neighbours(ego):
            return self._insert(ego)
        last, held, self._held = self._last, self._held, None
        if last is None or _consistent(last, ego):
            self._fits, self._last = last is not None, ego
            return self._insert(ego) or (None if held is None else CONTRADICTS)
        if held is None and self._fits:
            self._held = ego
            return None
        self._last = ego
        if held is None:
            return self._insert(ego)
        self._fits = _consistent(held, ego)
        self.jumps += self._fits
        if self._growth is not None:
            self._growth.jumped(held.stamp_ns)
        reason = self._insert(held)
        return self._insert(ego) or reason

    def _fits_its_neighbours(self, ego: EgoState) -> bool:
        """True for a late state between two states that it does not contradict."""
        row = bisect.bisect_left(self._stamps, ego.stamp_ns)
        return 0 < row < len(self._stamps) and all(
            _consistent(*pair)
            for pair in pairwise((self._states[row - 1], ego, self._states[row]))
        )

    def _insert(self, ego: EgoState) -> str | None:
        """Insert a state by its stamp, and filter all newer ones again. Return the reason if it is refused, or None."""
        stamps_ns = self._stamps
        row = bisect.bisect_left(stamps_ns, ego.stamp_ns)
        newer = self._reported[row:]
        if newer:
            if newer[0].stamp_ns == ego.stamp_ns:
                return "repeated stamp"
            del self._reported[row:], self._states[row:], stamps_ns[row:]
            del self._learned[row:], self._reckoned[row:]
            self.current = self._states[-1] if row else None
            if self._growth is not None:
                self._growth.learned = (self._learned[-1] if row else None) or Learned()
        before_ns = stamps_ns[-1] if row else -(2**63)
        if self._changed_ns is None or before_ns < self._changed_ns:
            self._changed_ns = before_ns
        for each in (ego, *newer):
            self._append(each)
        self._forget()
        return None

    def _append(self, ego: EgoState) -> None:
        """Append the newest state, low-passed."""
        self._reported.append(ego)
        if self.current is not None:
            turned_rad = self.current.yaw_rate_radps * (
                (ego.stamp_ns - self.current.stamp_ns) / NS_PER_S
            )
            ego = self._low_passed(
                ego, self.current.yaw_rad + turned_rad, self.current.yaw_rate_radps
            )
        if self._position_time_s is not None:
            ego = self._reckon(ego, self._position_time_s)
        self.current = ego
        self._stamps.append(ego.stamp_ns)
        self._states.append(ego)
        if self._growth is not None:
            self._growth.learn(self._states, self._stamps, self._moved)
        self._learned.append(None if self._growth is None else self._growth.learned)

    def _forget(self) -> None:
        """Forget the oldest states, in portions: cutting a list copies it."""
        stamps_ns = self._stamps
        oldest_ns = stamps_ns[-1] - self._memory_ns
        if len(stamps_ns) > 64 and stamps_ns[64] < oldest_ns:
            gone = bisect.bisect_left(stamps_ns, oldest_ns) - 1
            del stamps_ns[:gone], self._states[:gone], self._reported[:gone]
            del self._learned[:gone], self._reckoned[:gone]
            first = bisect.bisect_right(self._in_pit, (stamps_ns[0], True))
            del self._in_pit[: max(first - 1, 0)]

    def _reckon(self, ego: EgoState, time_s: float) -> EgoState:
        """Return the newest state at its position by dead reckoning."""
        P = _completed(ego.covariance, self._std or EgoStd())
        P = np.zeros((5, 5)) if P is None else P.copy()
        variance_m2 = max(0.5 * float(P[0, 0] + P[1, 1]), _LEAST_STD**2)
        speed_variance = max(float(P[3, 3] + ego.speed_mps**2 * P[2, 2]), _LEAST_STD**2)
        velocity_mps = (
            ego.speed_mps * math.cos(ego.yaw_rad),
            ego.speed_mps * math.sin(ego.yaw_rad),
        )
        errors = ReportedErrors(variance_m2, time_s, speed_variance * _REMEMBERED_S)
        last = self._reckoned[-1] if self._reckoned else None
        own = estimate_position(
            last, ego.stamp_ns, (ego.x_m, ego.y_m), velocity_mps, errors
        )
        self._reckoned.append(own)
        P[:2] = P[:, :2] = 0.0
        P[0, 0] = P[1, 1] = errors.density_m2ps * _REMEMBERED_S
        x_m, y_m = own.position_m
        return replace(ego, x_m=x_m, y_m=y_m, covariance=tuple(P.ravel().tolist()))

    def _extrapolated(self, ego: EgoState, stamp_ns: int) -> EgoPose:
        elapsed_s = seconds(stamp_ns - ego.stamp_ns)
        growth = (
            self._growth.covariance(ego, elapsed_s, self._learned_at(stamp_ns))
            if self._growth is not None and elapsed_s
            else None
        )
        return self._grown(ego, stamp_ns, growth)

    def _grown(
        self, ego: EgoState, stamp_ns: int, growth: FloatArray | None
    ) -> EgoPose:
        """Return the pose of `ego` at another stamp, whose covariance grows by `growth`, shape (5, 5)."""
        covariance = (
            None if self._std is None else _completed(ego.covariance, self._std)
        )
        pose = extrapolated(ego, stamp_ns, covariance, self._straight)
        if growth is None:
            return pose
        total = growth if pose.covariance is None else pose.covariance + growth
        total.flags.writeable = False
        return pose._replace(
            covariance=total, extrapolated_s=seconds(stamp_ns - ego.stamp_ns)
        )

    def _moved(self, ego: EgoState, stamp_ns: int) -> tuple[float, float, float]:
        """Return x, y and yaw of `ego` at another stamp."""
        x_m, y_m, yaw_rad, *_ = extrapolated(ego, stamp_ns, straight=self._straight)
        return x_m, y_m, yaw_rad

    def _low_passed(
        self, ego: EgoState, yaw_rad: float, yaw_rate_radps: float
    ) -> EgoState:
        """Return `ego` with its yaw and yaw rate drawn towards `yaw_rad` and `yaw_rate_radps`."""
        values = list(
            _VALUES(ego)
        )  # in a third of the time of `dataclasses.replace`, at every message
        values[_YAW] = wrap_angle(
            yaw_rad + self._yaw_weight * wrap_angle(ego.yaw_rad - yaw_rad)
        )
        own, last = self._yaw_rate_weight, 1.0 - self._yaw_rate_weight
        values[_YAW_RATE] = last * yaw_rate_radps + own * ego.yaw_rate_radps
        return EgoState(*values)

    def _interpolated(
        self, before: EgoState, after: EgoState, stamp_ns: int
    ) -> EgoPose:
        """Return the pose between two states, with the mean of their covariances (None counts as zero).

        The yaw turns the short way. The error of (1 - share) a + share b has at most this covariance. It has just this
        covariance if both errors are equal, as the errors of a localisation at nearby times nearly are. `_bridged`
        serves states that are far apart.
        """
        share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
        covariance = newer = None
        if self._std is not None:
            covariance, newer = (
                _completed(before.covariance, self._std),
                _completed(after.covariance, self._std),
            )
        if covariance is not newer:
            older, newer = (
                np.zeros((5, 5)) if item is None else item
                for item in (covariance, newer)
            )
            covariance = (1.0 - share) * older + share * newer
        if (
            self._growth is not None
            and after.stamp_ns - before.stamp_ns > _FAR_APART_NS
            and 0.0 < share < 1.0
        ):
            return self._bridged(self._growth, before, after, stamp_ns, covariance)
        return EgoPose(
            before.x_m + share * (after.x_m - before.x_m),
            before.y_m + share * (after.y_m - before.y_m),
            before.yaw_rad + share * wrap_angle(after.yaw_rad - before.yaw_rad),
            before.speed_mps + share * (after.speed_mps - before.speed_mps),
            before.yaw_rate_radps
            + share * (after.yaw_rate_radps - before.yaw_rate_radps),
            covariance,
        )

    def _bridged(
        self,
        growth: EgoGrowth,
        before: EgoState,
        after: EgoState,
        stamp_ns: int,
        covariance: FloatArray | None,
    ) -> EgoPose:
        """Return the pose between two states that are far apart: extrapolations from both, weighted by their
        certainties.

        The accelerations before and after the stamp are independent, so both extrapolations are fused as independent
        estimates. The `covariance` of the states is added to the covariance of the result.
        """
        first, second = (
            np.array(extrapolated(ego, stamp_ns)[:5]) for ego in (before, after)
        )
        P, R = (
            growth.covariance(
                ego, seconds(stamp_ns - ego.stamp_ns), self._learned_at(stamp_ns)
            )
            + _ROUNDING
            for ego in (before, after)
        )
        difference = second - first
        difference[YAW] = wrap_angle(difference[YAW])
        mean, own = updated_one(first, P, difference, _ALL, R)[:2]
        x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = mean.tolist()
        total = own if covariance is None else own + covariance
        total.flags.writeable = False
        return EgoPose(x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps, total)
