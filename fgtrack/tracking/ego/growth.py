"""Uncertainty of an extrapolated ego pose: how the ego may accelerate and turn meanwhile.

The ego is driven by white noise in its acceleration and in its yaw acceleration, as the objects are (`models.motion`).
Extrapolated over t, its yaw then has the variance q t^3 / 3, and its way along the heading as well. The densities q are
learned: each state shows how wrong an older state is that is extrapolated to the same stamp. An acceleration a that
lasts makes an error of a t^2 / 2, so the density grows with t. That is why the mean square of a is learned for several
durations: with q = 3/4 a^2 t the variance is that of the errors seen. A race car and a ship differ by a factor of 10^4
in it. The larger counts of the mean of two minutes and of the mean of the newest 3 s, which a bend after a straight
raises at once.

The same error stays for several lists, because the ego goes on to accelerate. Two lists with extrapolated poses at
stamps d apart have errors with the correlation exp(-d / T). A track averages over lists with weights exp(-age / M). The
variance of that average is as large as with white errors that are larger by 1 + 2 * sum of exp(-d (1 / T + 1 / M)) over
the lists before. So many times the plain variance is what a list counts with. The first list counts with the plain one,
and all lists together contain no more information than their common error allows. T is learned as the densities are.

M follows from the Kalman filter of an object whose velocity is driven by white noise of density q, measured with white
errors of spectral density S. Its bandwidth is w = (q / S)^(1/4), and M = k / w. Errors of variance V that last have
S = 2 M V, hence M^3 = k^4 * 2 V / q. Three quarters of the variance 2^(1/2) w S come from the errors, as in an average
with k = 0.47. A track that also estimates a turn rate remembers longer: with k = 0.8 the NEES of late egos is 2.
"""

import bisect
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.state import Stateful
from fgtrack.core.time import NS_PER_S, nanoseconds, seconds
from fgtrack.core.types import EgoState, FloatArray
from fgtrack.models.motion import CTRV

DURATIONS_S = (0.1, 0.2, 0.4, 0.8)
"""Durations over which extrapolation is judged; other durations lie between them."""
#: A state that is extrapolated further shows nothing of a duration of about 1 s.
_LONGEST_S = 2.0
_LONGEST_EACH_S = (*(1.5 * each_s for each_s in DURATIONS_S[:-1]), _LONGEST_S)
_DURATIONS_NS = tuple(
    (nanoseconds(each_s), nanoseconds(longest_s))
    for each_s, longest_s in zip(DURATIONS_S, _LONGEST_EACH_S, strict=True)
)
_NONE_FOUND = (math.nan,) * (2 * len(DURATIONS_S))
_STEP_S = 0.05  # between two states that are learned from
_SPACING_NS = nanoseconds(0.25)  # between two errors whose correlation is learned
_FORGET_S = 120.0  # a road with bends and straights, a lap
_FORGET_SOON_S = 3.0  # a bend
_PRIOR_S = 0.5  # what the configuration assumes counts as much as states of this time
_PRIOR_LASTS_S = 5.0  # and less and less once the ego has driven for that long
_LEAST_SPEED_MPS = 0.1  # an ego at rest does not show how it accelerates
_SHARE = 0.8  # k of the module
_RANGE_M = (
    50.0  # usual distance of an object, at which an error of the yaw displaces it
)
_LEAST_S = 1e-3  # no memory and no correlation are shorter
_KEPT_NS = nanoseconds(10.0)  # lists before that share no error that a track remembers
_LONG_S = 1e3  # T of an error that stays


def _zeros(count: int) -> list[list[float]]:
    return [[0.0] * len(_NONE_FOUND) for _ in range(count)]


@dataclass(frozen=True)
class Learned:
    """Sums that were learned up to a state of the ego. They are never changed.

    Each row of sums has one entry for the acceleration and one for the yaw acceleration over each duration.
    """

    lasting: Sequence[Sequence[float]] = field(default_factory=partial(_zeros, 5))
    """Sums of weights, squares, squares of pairs, products and spacings."""
    fading: Sequence[Sequence[float]] = field(default_factory=partial(_zeros, 2))
    """Sums of weights and squares."""
    recent: Sequence[tuple[int, Sequence[float]]] = ()
    """Stamps and accelerations of the newest `_SPACING_NS`."""
    stamp_ns: int | None = None
    """Stamp of the newest state that was learned from."""


class EgoGrowth(Stateful):
    """Learns how an extrapolated pose of the ego grows uncertain, and for how long its error lasts."""

    STATE: ClassVar[tuple[str, ...]] = ("learned", "_jumps_ns", "_placed")

    def __init__(
        self, accel_std_mps2: float, yaw_accel_std_radps2: float, density_m2ps3: float
    ) -> None:
        """Assume these standard deviations of acceleration and yaw acceleration until the ego has shown its own.

        `density_m2ps3` is the noise density of the velocities of the objects.
        """
        self._density = density_m2ps3
        self._assumed = np.square([accel_std_mps2, yaw_accel_std_radps2])
        self.learned = Learned()
        """What was learned up to the newest state."""
        self._jumps_ns: list[int] = [0]
        self._placed = deque[int]()  # stamps of lists with extrapolated poses

    def jumped(self, stamp_ns: int) -> None:
        """Learn nothing from states before `stamp_ns`, where the ego has jumped to another position."""
        bisect.insort(self._jumps_ns, stamp_ns)

    def learn(
        self,
        states: Sequence[EgoState],
        stamps_ns: Sequence[int],
        positions_at: Callable[[EgoState, int], tuple[float, float, float]],
    ) -> None:
        """Learn from the newest of `states`, which are in the order of `stamps_ns`.

        `positions_at` returns x, y and yaw of a state that is extrapolated to a stamp.
        """
        newest, stamp_ns = states[-1], stamps_ns[-1]
        learned_ns, step_s = self.learned.stamp_ns, _STEP_S
        if learned_ns is not None:
            step_s = (stamp_ns - learned_ns) / NS_PER_S
        if step_s < _STEP_S:
            return
        jump = bisect.bisect_right(self._jumps_ns, stamp_ns)
        jumped_ns = self._jumps_ns[max(jump - 1, 0)]
        found = list(_NONE_FOUND)
        c, s = math.cos(newest.yaw_rad), math.sin(newest.yaw_rad)
        for k, (duration_ns, longest_ns) in enumerate(_DURATIONS_NS):
            row = bisect.bisect_right(stamps_ns, stamp_ns - duration_ns) - 1
            if row < 0 or stamps_ns[row] < jumped_ns:
                continue
            elapsed_ns = stamp_ns - stamps_ns[row]
            if elapsed_ns > longest_ns:
                continue
            elapsed_s, older = elapsed_ns / NS_PER_S, states[row]
            if abs(newest.speed_mps) < _LEAST_SPEED_MPS:
                moved_m = math.hypot(newest.x_m - older.x_m, newest.y_m - older.y_m)
                if max(moved_m / elapsed_s, abs(older.speed_mps)) < _LEAST_SPEED_MPS:
                    continue
            x_m, y_m, yaw_rad = positions_at(older, stamp_ns)
            along_m = c * (newest.x_m - x_m) + s * (newest.y_m - y_m)
            turned_rad = wrap_angle(newest.yaw_rad - yaw_rad)
            squared_s2 = elapsed_s**2
            found[2 * k] = 2.0 * along_m / squared_s2
            found[2 * k + 1] = 2.0 * turned_rad / squared_s2
        self._add(stamp_ns, min(step_s, 1.0), found)

    def _add(self, stamp_ns: int, weight_s: float, found: Sequence[float]) -> None:
        """Add accelerations, one for each row of the sums, with the weight `weight_s`.

        NaN marks a duration without states. Numbers are added one by one: there are eight of them, and each operation
        on arrays takes longer than all of these.
        """
        lasting = _faded(self.learned.lasting, weight_s, _FORGET_S)
        fading = _faded(self.learned.fading, weight_s, _FORGET_SOON_S)
        weights_s, squares, pairs, products, spacings_s = lasting
        soon_weights_s, soon_squares = fading
        recent = list(self.learned.recent)
        while len(recent) > 1 and stamp_ns - recent[1][0] >= _SPACING_NS:
            recent.pop(0)
        before: Sequence[float] = _NONE_FOUND
        spacing_s = 0.0
        if recent and stamp_ns - recent[0][0] >= _SPACING_NS:
            before_ns, before = recent[0]
            spacing_s = (stamp_ns - before_ns) / NS_PER_S
        for row, (new, old) in enumerate(zip(found, before, strict=True)):
            if not math.isfinite(new):
                continue
            square = new * new
            weights_s[row] += weight_s
            soon_weights_s[row] += weight_s
            squares[row] += weight_s * square
            soon_squares[row] += weight_s * square
            if math.isfinite(old):
                pair = weight_s * 0.5 * (square + old * old)
                pairs[row] += pair
                products[row] += weight_s * new * old
                spacings_s[row] += pair * spacing_s
        recent.append((stamp_ns, found))
        self.learned = Learned(lasting, fading, recent, stamp_ns)

    def _of(
        self, duration_s: float, learned: Learned | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean square and correlation time of acceleration and yaw acceleration over a duration, shape (2,)."""
        known_by = self.learned if learned is None else learned
        lasting = np.array(known_by.lasting).reshape(5, -1, 2)
        seen = lasting[0, :, 0] > 0.0
        if not seen.any():
            return self._assumed, np.full(2, _LONG_S)
        weights_s, sums, pairs, products, spacings_s = lasting[:, seen]
        soon_weights_s, soon_sums = np.array(known_by.fading).reshape(2, -1, 2)[:, seen]
        prior_s = _PRIOR_S * np.exp(-weights_s / _PRIOR_LASTS_S)
        ever = (prior_s * self._assumed + sums) / (prior_s + weights_s)
        soon = (prior_s * self._assumed + soon_sums) / (prior_s + soon_weights_s)
        squares = np.maximum(ever, soon)
        with np.errstate(divide="ignore", invalid="ignore"):
            correlations = np.where(pairs > 0.0, products / pairs, 1.0)
            spacings_s = np.where(pairs > 0.0, spacings_s / pairs, 1.0)
            decays = -np.log(np.clip(correlations, 1e-12, 1.0))
            times_s = np.minimum(
                np.where(decays > 0.0, spacings_s / decays, np.inf), _LONG_S
            )
        at, known = math.log(max(duration_s, 1e-3)), np.log(DURATIONS_S)[seen]
        mean = np.array([np.interp(at, known, squares[:, k]) for k in range(2)])
        return mean, np.array([np.interp(at, known, times_s[:, k]) for k in range(2)])

    def covariance(
        self, ego: EgoState, duration_s: float, learned: Learned | None = None
    ) -> FloatArray:
        """Growth of the covariance of x, y, yaw, speed and yaw rate of `ego` over `duration_s`, shape (5, 5).

        The growth comes from unknown accelerations, as far as they were `learned`; None is all that was learned. The
        covariance of `ego` itself is not included.
        """
        by_accel, by_yaw_accel = self._parts(ego, duration_s, learned)
        return by_accel + by_yaw_accel

    def shared(
        self,
        ego: EgoState,
        duration_s: float,
        stamp_ns: int,
        range_m: float | None = None,
        learned: Learned | None = None,
        others_ns: Sequence[int] | None = None,
    ) -> FloatArray:
        """Return the `covariance` that counts for a list at `stamp_ns`.

        `range_m` is the usual distance of the objects of the list; None if it is unknown. `others_ns` are the stamps
        of the lists that share the error. With None they are those of the calls before, and this list is noted.
        """
        range_m = _RANGE_M if range_m is None else range_m
        parts = self._parts(ego, duration_s, learned)
        _, times_s = self._of(abs(duration_s), learned)
        shared_ns = self._placed if others_ns is None else others_ns
        apart_s = np.array([abs(seconds(stamp_ns - each)) for each in shared_ns])
        total = np.zeros((5, 5))
        for part, time_s in zip(parts, times_s.tolist(), strict=True):
            variance_m2 = 0.5 * float(part[0, 0] + part[1, 1]) + range_m**2 * float(
                part[2, 2]
            )
            memory_s = (_SHARE**4 * 2.0 * variance_m2 / self._density) ** (1.0 / 3.0)
            rate_hz = 1.0 / max(memory_s, _LEAST_S) + 1.0 / max(time_s, _LEAST_S)
            total += (1.0 + 2.0 * float(np.exp(-apart_s * rate_hz).sum())) * part
        if others_ns is not None:
            return total
        self._placed.append(stamp_ns)
        while stamp_ns - self._placed[0] > _KEPT_NS:
            self._placed.popleft()
        return total

    def _parts(
        self, ego: EgoState, duration_s: float, learned: Learned | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the parts of `covariance` that come from the acceleration and from the yaw acceleration."""
        squares, _ = self._of(abs(duration_s), learned)
        along, turn = (0.75 * squares * abs(duration_s)).tolist()
        back = math.copysign(1.0, duration_s)
        signs = np.array(
            [1.0, 1.0, 1.0, back, back]
        )  # backwards in time, speed and yaw rate are reversed
        x = signs * [ego.x_m, ego.y_m, ego.yaw_rad, ego.speed_mps, ego.yaw_rate_radps]
        free: dict[str, float] = {
            "yaw_rate_std_radps": math.inf,
            "resting_yaw_rad2ps": 0.0,
        }  # a mere integral
        motions = CTRV(0.0, 0.0, along, 0.0, **free), CTRV(0.0, 0.0, 0.0, turn, **free)
        by_accel, by_yaw_accel = (
            np.asarray(
                signs[:, None] * motion.process_noise(x, abs(duration_s)) * signs
            )
            for motion in motions
        )
        return by_accel, by_yaw_accel


def _faded(
    sums: Sequence[Sequence[float]], weight_s: float, memory_s: float
) -> list[list[float]]:
    """Return sums as they are after the time `weight_s`."""
    keep = math.exp(-weight_s / memory_s)
    return [[keep * each for each in row] for row in sums]
