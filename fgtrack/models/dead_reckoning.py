"""Position of a vehicle from reported positions, whose error wanders, and reported velocities.

GNSS positions of one moment hardly scatter but wander by decimetres within seconds, and step where the satellites
change; a velocity integrates to centimetres meanwhile. Along each axis the state is the position p and the error b of
the reported position z, a first-order Gauss-Markov process as in `correlated_errors`:
z = p + b + N(0, r),
p(t + dt) = p(t) + v dt + N(0, q dt), b(t + dt) = exp(-dt / T) b(t) + N(0, (1 - exp(-2 dt / T)) s^2)
(Farrell, "Aided Navigation", 2008, chapter 4). The Kalman filter of it is causal, and both axes have one covariance.
"""

import math
from typing import NamedTuple

from fgtrack.core.time import seconds

_JITTER_M2 = 0.05**2  # r: rounding, and 5 ms between a position and its stamp at 10 m/s
_STEP = 9.21  # 99 % quantile of chi-square with two degrees of freedom: above it the reported position has stepped
_LARGEST = 3.0  # standard deviations of b, which it exceeds in 1 % of the time: beyond, p is wrong


class ReportedErrors(NamedTuple):
    """Errors of a reported position and velocity."""

    variance_m2: float
    """s^2, of each coordinate."""
    time_s: float
    """T."""
    density_m2ps: float
    """q: variance per second of an integrated velocity."""


class Reckoned(NamedTuple):
    """Estimate at a stamp, from everything reported up to it."""

    stamp_ns: int
    velocity_mps: tuple[float, float]
    """As reported, in the map."""
    position_m: tuple[float, float]
    """p."""
    error_m: tuple[float, float]
    """b."""
    covariance: tuple[float, float, float]
    """Of p, of p with b, and of b, along each axis [m^2]."""


def reckoned(
    last: Reckoned | None,
    stamp_ns: int,
    reported_m: tuple[float, float],
    velocity_mps: tuple[float, float],
    errors: ReportedErrors,
) -> Reckoned:
    """Return the estimate at `stamp_ns` from the `last` one and what is reported; without one, what is reported.
    p is at most three standard deviations of b from the reported position, whatever the velocity was, or was not
    reported for.
    """
    variance_m2, time_s, density_m2ps = errors
    if last is not None:
        dt_s = seconds(stamp_ns - last.stamp_ns)
        (vx, vy), (old_vx, old_vy) = velocity_mps, last.velocity_mps
        x_m = last.position_m[0] + 0.5 * (old_vx + vx) * dt_s
        y_m = last.position_m[1] + 0.5 * (old_vy + vy) * dt_s
        off_x_m, off_y_m = reported_m[0] - x_m, reported_m[1] - y_m
        off_m = math.hypot(off_x_m, off_y_m)
        if math.isfinite(off_m):
            share = (
                min(_LARGEST * math.sqrt(variance_m2) / off_m, 1.0) if off_m else 1.0
            )
            x_m, y_m = x_m + (1.0 - share) * off_x_m, y_m + (1.0 - share) * off_y_m
            decay = math.exp(-dt_s / time_s)
            p, pb, b = last.covariance
            p, pb = p + density_m2ps * dt_s, decay * pb
            b = decay * decay * (b - variance_m2) + variance_m2
            error_x_m, error_y_m = decay * last.error_m[0], decay * last.error_m[1]
            y0, y1 = share * off_x_m - error_x_m, share * off_y_m - error_y_m
            S = p + 2.0 * pb + b + _JITTER_M2
            if y0 * y0 + y1 * y1 > _STEP * S:  # b, not p
                b, S = b + variance_m2, S + variance_m2
            gain_p, gain_b = (p + pb) / S, (pb + b) / S
            return Reckoned(
                stamp_ns,
                velocity_mps,
                (x_m + gain_p * y0, y_m + gain_p * y1),
                (error_x_m + gain_b * y0, error_y_m + gain_b * y1),
                (
                    p - gain_p * gain_p * S,
                    pb - gain_p * gain_b * S,
                    b - gain_b * gain_b * S,
                ),
            )
    start = variance_m2 + _JITTER_M2, -variance_m2, variance_m2
    return Reckoned(stamp_ns, velocity_mps, reported_m, (0.0, 0.0), start)
