"""Transitions of the shipped motion models, compiled: mean, Jacobian F and noise covariance Q of states after a time.

By definition, Q is the integral over s in [0, t] of Phi(t, s) D Phi(t, s)'. D is the diagonal of spectral densities at
the mean at s. Phi(t, s) is the Jacobian of the flow from s to t.

The parameters `noise` begin with the spectral densities of the entries of the state, shape (n,). For `ARC` and `TURN`
the rate at which the yaw rate relaxes follows, in 1/s. For `ARC` two more numbers follow: the speed below which an
object counts as slow, in m/s, and the additional density of the yaw of an object at rest, in rad^2/s.
"""

import math

from fgtrack.core.compiled import (
    add_product_transposed,
    check,
    copy,
    inlined,
    merged,
    njit,
    product,
    scratch,
    shared,
)
from fgtrack.core.types import FloatArray
from fgtrack.models.short_bends import ARC, LINE, TURN, TYPES, short_bend

#: A longer arc is made of parts that turn by this angle at most, where the quadrature holds to rounding.
MAX_TURN_RAD = 0.25
#: A part lasts at most this share of the time in which the yaw rate relaxes to 1/e.
MAX_RELAXATION = 0.25
#: In a part the speed changes at most by this share of the speed over which the noise of the yaw changes.
MAX_SPEED_CHANGE = 0.25
#: An arc of more parts has no finite result: a yaw rate that no object has.
MAX_PARTS = 10_000


@inlined
def check_noise(kind: int, noise: FloatArray, n: int) -> None:
    """Raise `IndexError` unless `noise` has the parameters of a motion of this `kind` with n entries of the state."""
    if kind == ARC:
        check(n >= 5 and len(noise) >= n + 3)
    elif kind == TURN:
        check(n == 5 and len(noise) >= n + 1)
    else:
        check(n == 4 and len(noise) >= n)


@merged
def _arc(
    kind: int,
    x: FloatArray,
    t: float,
    parts: int,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q after `parts` short arcs or turns of t each."""
    n = len(x)
    before, G, old, GM = scratch(n), scratch(n, n), scratch(n, n), scratch(n, n)
    for part in range(parts):
        for j in range(n if part else 0):
            before[j] = mean[j]
        if part:
            copy(Q, old)
        short_bend(kind, before if part else x, t, noise, mean, G if part else F, Q)
        if part:
            product(G, old, GM)
            add_product_transposed(GM, G, Q)
            product(G, F, GM)
            copy(GM, F)


@merged
def _line(
    x: FloatArray,
    t: float,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q of constant velocity, state x, y, vx, vy: q [[t^3/3, t^2/2], [t^2/2, t]] on each axis."""
    for i in range(4):
        mean[i] = x[i]
        for k in range(4):
            F[i, k] = 1.0 if i == k else 0.0
            Q[i, k] = noise[i] * t if i == k else 0.0
    for i in range(2):
        v, q = i + 2, noise[i + 2]
        mean[i] += x[v] * t
        F[i, v] = t
        Q[i, i] += q * (t * t * t) / 3.0
        Q[i, v] = Q[v, i] = q * (t * t) / 2.0


@merged
def _num_parts(x: FloatArray, t: float, noise: FloatArray) -> float:
    """Number of short arcs that the transition over t is made of, as a float that may be infinite."""
    n = len(x)
    parts = max(abs(x[4] * t) / MAX_TURN_RAD, abs(noise[n] * t) / MAX_RELAXATION, 1.0)
    if n > 5 and noise[n + 2] > 0.0:
        speed, last = x[3], x[3] + x[5] * t
        slowest = 0.0 if speed * last < 0.0 else min(abs(speed), abs(last))
        parts = max(
            parts,
            abs(x[5] * t) / (MAX_SPEED_CHANGE * math.hypot(slowest, noise[n + 1])),
        )
    return math.ceil(parts) if parts < MAX_PARTS else math.inf


@inlined
def _counted_s(n: int, t: float, noise: FloatArray) -> float:
    """Return the duration t, limited to half of `MAX_PARTS` parts of a yaw rate that relaxes.

    The yaw rate has relaxed to zero long before, and the object may be anywhere. So years give a finite state.
    """
    longest = 0.5 * MAX_PARTS * MAX_RELAXATION
    if abs(noise[n] * t) <= longest:
        return t
    return math.copysign(longest / noise[n], t)


@shared(f"void(int64, {TYPES})")
def transition(
    kind: int,
    x: FloatArray,
    t: float,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean (n,), F and Q (n, n) of the state x (n,) after t."""
    if kind == LINE:
        _line(x, t, noise, mean, F, Q)
        return
    t = _counted_s(len(x), t, noise)
    parts = _num_parts(x, t, noise)
    if parts <= MAX_PARTS:
        _arc(kind, x, t / parts, int(parts), noise, mean, F, Q)
    else:
        for i in range(len(x)):
            mean[i] = math.nan
            for k in range(len(x)):
                F[i, k] = Q[i, k] = math.nan


@njit(
    "void(int64, float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1])"
)
def transitions(
    kind: int,
    x: FloatArray,
    dt_s: FloatArray,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean (m, n), F and Q (m, n, n) of states (m, n) after `dt_s` (m,)."""
    m, n = x.shape
    check_noise(kind, noise, n)
    check(
        len(dt_s) >= m
        and mean.shape == x.shape
        and F.shape == (m, n, n)
        and Q.shape == (m, n, n)
    )
    for k in range(len(x)):
        transition(kind, x[k], dt_s[k], noise, mean[k], F[k], Q[k])
