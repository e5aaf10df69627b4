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

import numpy as np

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import EgoState, FloatArray
from fgtrack.models.motion import CTRV

DURATIONS_S = (0.1, 0.2, 0.4, 0.8)
"""Durations over which extrapolation is judged; other durations lie between them."""
_LONGEST_S = (
    2.0  # a state that is extrapolated further shows nothing of a duration of about 1 s
)
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


class EgoGrowth:
    """Learns how an extrapolated pose of the ego grows uncertain, and for how long its error lasts."""

    def __init__(
        self, accel_std_mps2: float, yaw_accel_std_radps2: float, density_m2ps3: float
    ) -> None:
        """Assume these standard deviations of acceleration and yaw acceleration until the ego has shown its own.

        `density_m2ps3` is that of the velocity of the objects.
        """
        self._density = density_m2ps3
        self._assumed = np.square([accel_std_mps2, yaw_accel_std_radps2])
        shape = len(DURATIONS_S), 2
        self._weights_s, self._squares = np.zeros(shape), np.zeros(shape)
        self._soon_s, self._soon = np.zeros(shape), np.zeros(shape)
        self._pairs, self._products, self._spacings_s = (
            np.zeros(shape),
            np.zeros(shape),
            np.zeros(shape),
        )
        self._recent = deque[
            tuple[int, FloatArray]
        ]()  # stamp and accelerations, of the newest `_SPACING_NS`
        self._learned_ns: int | None = None
        self._jumped_ns = 0
        self._placed = deque[int]()  # stamps of lists with extrapolated poses

    def jumped(self, stamp_ns: int) -> None:
        """Learn nothing from states before `stamp_ns`, where the ego has jumped to another position."""
        self._jumped_ns = stamp_ns

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
        step_s = (
            _STEP_S
            if self._learned_ns is None
            else seconds(stamp_ns - self._learned_ns)
        )
        if step_s < _STEP_S:
            return
        self._learned_ns = stamp_ns
        found = np.full(self._squares.shape, np.nan)
        for k, duration_s in enumerate(DURATIONS_S):
            row = bisect.bisect_right(stamps_ns, stamp_ns - nanoseconds(duration_s)) - 1
            if row < 0 or stamps_ns[row] < self._jumped_ns:
                continue
            elapsed_s = seconds(stamp_ns - stamps_ns[row])
            is_last = duration_s == DURATIONS_S[-1]
            if elapsed_s > (_LONGEST_S if is_last else 1.5 * duration_s):
                continue
            moved_m = math.hypot(
                newest.x_m - states[row].x_m, newest.y_m - states[row].y_m
            )
            speed_mps = max(
                moved_m / elapsed_s, abs(states[row].speed_mps), abs(newest.speed_mps)
            )
            if speed_mps < _LEAST_SPEED_MPS:
                continue
            x_m, y_m, yaw_rad = positions_at(states[row], stamp_ns)
            c, s = math.cos(newest.yaw_rad), math.sin(newest.yaw_rad)
            along_m = c * (newest.x_m - x_m) + s * (newest.y_m - y_m)
            turned_rad = wrap_angle(newest.yaw_rad - yaw_rad)
            found[k] = 2.0 * along_m / elapsed_s**2, 2.0 * turned_rad / elapsed_s**2
        self._add(stamp_ns, min(step_s, 1.0), found)

    def _add(self, stamp_ns: int, weight_s: float, found: FloatArray) -> None:
        """Add accelerations, shape (durations, 2), with the weight `weight_s`. NaN marks a duration without states."""
        known = np.isfinite(found)
        keep = math.exp(-weight_s / _FORGET_S)
        for sums in (
            self._weights_s,
            self._squares,
            self._pairs,
            self._products,
            self._spacings_s,
        ):
            sums *= keep
        for sums in (self._soon_s, self._soon):
            sums *= math.exp(-weight_s / _FORGET_SOON_S)
        for weights_s, sums in (
            (self._weights_s, self._squares),
            (self._soon_s, self._soon),
        ):
            weights_s[known] += weight_s
            sums[known] += weight_s * found[known] ** 2
        while len(self._recent) > 1 and stamp_ns - self._recent[1][0] >= _SPACING_NS:
            self._recent.popleft()
        if self._recent and stamp_ns - self._recent[0][0] >= _SPACING_NS:
            before_ns, before = self._recent[0]
            both = known & np.isfinite(before)
            squares = weight_s * 0.5 * (found[both] ** 2 + before[both] ** 2)
            self._pairs[both] += squares
            self._products[both] += weight_s * found[both] * before[both]
            self._spacings_s[both] += squares * seconds(stamp_ns - before_ns)
        self._recent.append((stamp_ns, found))

    def _of(self, duration_s: float) -> tuple[FloatArray, FloatArray]:
        """Return mean square and correlation time of acceleration and yaw acceleration over a duration, shape (2,)."""
        seen = self._weights_s[:, 0] > 0.0
        if not seen.any():
            return self._assumed, np.full(2, _LONG_S)
        prior_s = _PRIOR_S * np.exp(-self._weights_s[seen] / _PRIOR_LASTS_S)
        ever = (prior_s * self._assumed + self._squares[seen]) / (
            prior_s + self._weights_s[seen]
        )
        soon = (prior_s * self._assumed + self._soon[seen]) / (
            prior_s + self._soon_s[seen]
        )
        squares = np.maximum(ever, soon)
        pairs = self._pairs[seen]
        with np.errstate(divide="ignore", invalid="ignore"):
            correlations = np.where(pairs > 0.0, self._products[seen] / pairs, 1.0)
            spacings_s = np.where(pairs > 0.0, self._spacings_s[seen] / pairs, 1.0)
            decays = -np.log(np.clip(correlations, 1e-12, 1.0))
            times_s = np.minimum(
                np.where(decays > 0.0, spacings_s / decays, np.inf), _LONG_S
            )
        at, known = math.log(max(duration_s, 1e-3)), np.log(DURATIONS_S)[seen]
        mean = np.array([np.interp(at, known, squares[:, k]) for k in range(2)])
        return mean, np.array([np.interp(at, known, times_s[:, k]) for k in range(2)])

    def covariance(self, ego: EgoState, duration_s: float) -> FloatArray:
        """Covariance of x, y, yaw, speed and yaw rate of `ego` after `duration_s`, shape (5, 5)."""
        by_accel, by_yaw_accel = self._parts(ego, duration_s)
        return by_accel + by_yaw_accel

    def shared(
        self,
        ego: EgoState,
        duration_s: float,
        stamp_ns: int,
        range_m: float | None = None,
    ) -> FloatArray:
        """Return `covariance` as it counts for a list at `stamp_ns`, and note that the list shares the error.

        `range_m` is the usual distance of its objects, None where it is unknown.
        """
        range_m = _RANGE_M if range_m is None else range_m
        parts, (_, times_s) = self._parts(ego, duration_s), self._of(abs(duration_s))
        apart_s = np.array([abs(seconds(stamp_ns - each)) for each in self._placed])
        total = np.zeros((5, 5))
        for part, time_s in zip(parts, times_s.tolist(), strict=True):
            variance_m2 = 0.5 * float(part[0, 0] + part[1, 1]) + range_m**2 * float(
                part[2, 2]
            )
            memory_s = (_SHARE**4 * 2.0 * variance_m2 / self._density) ** (1.0 / 3.0)
            rate_hz = 1.0 / max(memory_s, _LEAST_S) + 1.0 / max(time_s, _LEAST_S)
            total += (1.0 + 2.0 * float(np.exp(-apart_s * rate_hz).sum())) * part
        self._placed.append(stamp_ns)
        while stamp_ns - self._placed[0] > _KEPT_NS:
            self._placed.popleft()
        return total

    def _parts(self, ego: EgoState, duration_s: float) -> tuple[FloatArray, FloatArray]:
        """Return the parts of `covariance` that come from the acceleration and from the yaw acceleration."""
        squares, _ = self._of(abs(duration_s))
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
