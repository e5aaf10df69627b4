"""Vehicle position from reported velocities and from reported positions with a drifting error.

GNSS positions scatter little from one moment to the next. But they drift by decimetres
within seconds, and step when the set of satellites changes. A velocity integrates to
centimetres in the same time.

Along each axis the state is the position p and the error b of the reported position z.
The error is a first-order Gauss-Markov process as in `correlated_errors` (Farrell,
"Aided Navigation", 2008, chapter 4):

    z = p + b + N(0, r)
    p(t + dt) = p(t) + v dt + N(0, q dt)
    b(t + dt) = exp(-dt / T) b(t) + N(0, (1 - exp(-2 dt / T)) s^2)

The Kalman filter for this model is causal. Both axes share one covariance.
"""

import math
from typing import NamedTuple

from fgtrack.core.time import seconds

# r: rounding, and 5 ms between a position and its stamp at 10 m/s.
_JITTER_M2 = 0.05**2
# 99 % quantile of chi-square with two degrees of freedom. Above it the reported position has stepped.
_STEP_NIS = 9.21
# Largest distance of p from the reported position, in standard deviations of b. Beyond it p is wrong.
_MAX_DEVIATIONS = 3.0


class ReportedErrors(NamedTuple):
    """Error parameters of the reported positions and velocities."""

    variance_m2: float
    """Stationary variance s^2 of the position error, of each coordinate."""
    time_s: float
    """Correlation time T of the position error."""
    density_m2ps: float
    """Spectral density q: growth per second of the variance of an integrated velocity."""


class PositionEstimate(NamedTuple):
    """Estimated position at a stamp, from all reports up to this stamp."""

    stamp_ns: int
    velocity_mps: tuple[float, float]
    """Reported velocity, in the map frame."""
    position_m: tuple[float, float]
    """Estimated position p, in the map frame."""
    error_m: tuple[float, float]
    """Estimated error b of the reported position."""
    covariance: tuple[float, float, float]
    """Variance of p, covariance of p with b, and variance of b, along each axis [m^2]."""


def estimate_position(
    last: PositionEstimate | None,
    stamp_ns: int,
    reported_m: tuple[float, float],
    velocity_mps: tuple[float, float],
    errors: ReportedErrors,
) -> PositionEstimate:
    """Return the position estimate at `stamp_ns`: the `last` estimate, moved by the velocity and corrected by the
    report.

    `reported_m` and `velocity_mps` are in the map frame. Without a `last` estimate, or if a position is not finite, the
    reported position is returned. The predicted position is first limited to a distance of three stationary standard
    deviations from the reported position. This limit holds for wrong velocities and for gaps between reports.
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
                min(_MAX_DEVIATIONS * math.sqrt(variance_m2) / off_m, 1.0)
                if off_m
                else 1.0
            )
            x_m += (1.0 - share) * off_x_m
            y_m += (1.0 - share) * off_y_m
            decay = math.exp(-dt_s / time_s)
            p, pb, b = last.covariance
            p += density_m2ps * dt_s
            pb *= decay
            b = decay * decay * (b - variance_m2) + variance_m2
            error_x_m, error_y_m = decay * last.error_m[0], decay * last.error_m[1]
            y0, y1 = share * off_x_m - error_x_m, share * off_y_m - error_y_m
            S = p + 2.0 * pb + b + _JITTER_M2
            if y0 * y0 + y1 * y1 > _STEP_NIS * S:  # the error b stepped, not p
                b += variance_m2
                S += variance_m2
            gain_p, gain_b = (p + pb) / S, (pb + b) / S
            return PositionEstimate(
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
    return PositionEstimate(stamp_ns, velocity_mps, reported_m, (0.0, 0.0), start)
