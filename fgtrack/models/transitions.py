"""Transitions of the shipped motion models, compiled: mean, Jacobian F and noise covariance Q of states after a time.

The noise is the definition, Q = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', with the diagonal D of spectral
densities at the mean at s, and the Jacobian Phi(t, s) of the flow from there over t - s.

The parameters `noise` are the spectral densities of the entries of the state, shape (n,). Those of `ARC` and `TURN`
are followed by the rate at which the yaw rate relaxes, in 1/s. Those of `ARC` end with the speed below which an object
counts as slow, in m/s, and with the density that is added to that of the yaw of an object at rest, in rad^2/s.
"""

import math

import numpy as np

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

#: Kinds of motion: constant turn rate and velocity (or acceleration), constant velocity, and constant turn rate with
#: the velocity along the axes of the map.
ARC, LINE, TURN = 0, 1, 2
#: A longer arc is made of parts that turn by this angle at most, where the quadrature holds to rounding.
MAX_TURN_RAD = 0.25
#: A part lasts at most this share of the time in which the yaw rate relaxes to 1/e.
MAX_RELAXATION = 0.25
#: In a part the speed changes at most by this share of the speed over which the noise of the yaw changes.
MAX_SPEED_CHANGE = 0.25
#: An arc of more parts has no finite result: a yaw rate that no object has.
MAX_PARTS = 10_000
_NUM_NODES = 5


def _integrals(nodes: FloatArray, weights: FloatArray) -> FloatArray:
    """Matrix that gives integrals from 0 to each node, and to 1, of the polynomial through values at the nodes.

    Shape (nodes + 1, nodes). The nodes lie in [0, 1].
    """
    powers = np.arange(len(nodes))
    values = nodes[:, None] ** powers
    integrals = nodes[:, None] ** (powers + 1) / (powers + 1)
    return np.vstack([np.linalg.solve(values.T, integrals.T).T, weights])


# Gauss-Legendre quadrature on [0, 1]; integrals up to its nodes by collocation (Hairer, Norsett and Wanner, Solving
# Ordinary Differential Equations I, section II.7).
_roots, _root_weights = np.polynomial.legendre.leggauss(_NUM_NODES)
_NODES, _WEIGHTS = 0.5 * (_roots + 1.0), 0.5 * _root_weights
_INTEGRALS = _integrals(_NODES, _WEIGHTS)
# Factors 1/1!, 1/2!, ... of the series of (exp(b r) - 1) / b, and alternating ones of those of sine and cosine.
_GROWTH = 1.0 / np.cumprod(np.arange(1.0, 11.0))
_COS = np.array([(-1.0) ** k / math.factorial(2 * k) for k in range(7)])
_SIN = np.array([(-1.0) ** k / math.factorial(2 * k + 1) for k in range(7)])

_TYPES = (
    f"float64[::1], float64, {'float64[::1], ' * 2}float64[:, ::1], float64[:, ::1]"
)


@inlined
def check_noise(kind: int, noise: FloatArray, n: int) -> None:
    """Raise `IndexError` unless `noise` has the parameters of a motion of this `kind` with n entries of the state."""
    if kind == ARC:
        check(n >= 5 and len(noise) >= n + 3)
    elif kind == TURN:
        check(n == 5 and len(noise) >= n + 1)
    else:
        check(n == 4 and len(noise) >= n)


@inlined
def _relaxed(r: float, b: float) -> float:
    """Value of (exp(b r) - 1) / b for |b r| <= `MAX_RELAXATION`."""
    total = 0.0
    for k in range(len(_GROWTH) - 1, -1, -1):
        total = total * b * r + _GROWTH[k]
    return r * total


@inlined
def _directions(w: float, t: float, b: float, nodes: FloatArray) -> None:
    """Write cosine and sine of the heading relative to that at the end, g, and g times both, at each node r.

    At a time r t before the end the heading is -w t g(r) with the yaw rate w at the end, see `_relaxed`.
    """
    for j in range(_NUM_NODES):
        g = _relaxed(_NODES[j], b)
        angle = -w * t * g
        square = angle * angle
        along, left = 0.0, 0.0
        for k in range(len(_COS) - 1, -1, -1):
            along = along * square + _COS[k]
            left = left * square + _SIN[k]
        left *= angle
        nodes[j, 0], nodes[j, 1], nodes[j, 2] = along, left, g
        nodes[j, 3], nodes[j, 4] = g * along, g * left


@inlined
def _integrated(i: int, nodes: FloatArray) -> tuple[float, float, float, float]:
    """Return the integrals of the direction U and of g U from 0 to node i, or to 1, as real and imaginary parts."""
    unit_x, unit_y, turned_x, turned_y = 0.0, 0.0, 0.0, 0.0
    for j in range(_NUM_NODES):
        share = _INTEGRALS[i, j]
        unit_x += share * nodes[j, 0]
        unit_y += share * nodes[j, 1]
        turned_x += share * nodes[j, 3]
        turned_y += share * nodes[j, 4]
    return unit_x, unit_y, turned_x, turned_y


@shared(f"void({_TYPES})")
def _short_arc(
    x: FloatArray,
    t: float,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q after a turn of at most `MAX_TURN_RAD`.

    Positions are complex numbers along and left of the heading at the end. At a time r t before the end the yaw rate is
    w p(r) and the heading is -w t g(r), with the yaw rate w at the end, p = exp(b r), g = (p - 1) / b and b the time t
    times the rate of relaxation. With integrals over s in [0, r] of the velocity V(s) and of the direction U(s), the
    final position depends on yaw, speed, yaw rate and acceleration at r by i t int V, t int U,
    i t^2 (g(r) int V - int g V) / p(r) and t^2 (r int U - int s U).
    """
    n = len(x)
    accel = x[5] if n > 5 else 0.0
    b = noise[n] * t
    last_g = _relaxed(1.0, b)
    last_p = 1.0 + b * last_g
    w = x[4] / last_p
    v = x[3] + accel * t
    for j in range(n):
        mean[j] = x[j]
        for k in range(n):
            F[j, k] = 1.0 if j == k else 0.0
            Q[j, k] = 0.0
    mean[2], mean[3], mean[4] = x[2] + w * t * last_g, v, w
    nodes, extra = scratch(_NUM_NODES, 5), scratch(_NUM_NODES)
    _directions(w, t, b, nodes)
    for j in range(_NUM_NODES):
        ratio = (v - accel * _NODES[j] * t) / noise[n + 1]
        slowness = 1.0 / (1.0 + ratio * ratio)
        extra[j] = noise[n + 2] * slowness * slowness
    c, s = math.cos(mean[2]), math.sin(mean[2])
    for i in range(_NUM_NODES + 1):
        is_end = i == _NUM_NODES
        r, g, p = (
            (1.0, last_g, last_p)
            if is_end
            else (_NODES[i], nodes[i, 2], 1.0 + b * nodes[i, 2])
        )
        unit_x, unit_y, turned_x, turned_y = _integrated(i, nodes)
        unit_x, unit_y = t * unit_x, t * unit_y
        way_x, way_y, late_x, late_y = v * unit_x, v * unit_y, 0.0, 0.0
        turned_x, turned_y = v * t * turned_x, v * t * turned_y
        if n > 5:  # minus the acceleration times the time
            for j in range(_NUM_NODES):
                share = t * _INTEGRALS[i, j] * _NODES[j]
                late_x += share * nodes[j, 0]
                late_y += share * nodes[j, 1]
                turned_x -= accel * t * share * nodes[j, 3]
                turned_y -= accel * t * share * nodes[j, 4]
            way_x -= accel * t * late_x
            way_y -= accel * t * late_y
        for k in range(2, n):
            # The derivatives of position, yaw or speed, and its rate at the end by entry k at r.
            if k == 2:
                right, up, first, second = -way_y, way_x, 1.0, 0.0
            elif k == 3:
                right, up, first, second = unit_x, unit_y, 1.0, 0.0
            elif k == 4:
                right, up = (
                    -t * (g * way_y - turned_y) / p,
                    t * (g * way_x - turned_x) / p,
                )
                first, second = t * g / p, 1.0 / p
            else:
                right, up, first, second = (
                    t * (r * unit_x - late_x),
                    t * (r * unit_y - late_y),
                    t * r,
                    1.0,
                )
            own = 2 + k % 2
            if is_end:
                F[0, k], F[1, k] = c * right - s * up, s * right + c * up
                F[own, k] = first
                if k > 3:
                    F[k, k] = second
                continue
            q = noise[k] + extra[i] if k == 2 else noise[k]
            q *= t * _WEIGHTS[i]
            Q[0, 0] += q * right * right
            Q[0, 1] += q * right * up
            Q[1, 1] += q * up * up
            Q[0, own] += q * right * first
            Q[1, own] += q * up * first
            Q[own, own] += q * first * first
            if k > 3:
                Q[0, k] += q * right * second
                Q[1, k] += q * up * second
                Q[own, k] += q * first * second
                Q[k, k] += q * second * second
        if is_end:
            mean[0] += c * way_x - s * way_y
            mean[1] += s * way_x + c * way_y
    right, cross, up = Q[0, 0], Q[0, 1], Q[1, 1]
    Q[0, 0] = c * c * right - 2.0 * c * s * cross + s * s * up + noise[0] * t
    Q[1, 1] = s * s * right + 2.0 * c * s * cross + c * c * up + noise[1] * t
    Q[0, 1] = Q[1, 0] = c * s * (right - up) + (c * c - s * s) * cross
    for k in range(2, n):
        right, up = Q[0, k], Q[1, k]
        Q[0, k] = Q[k, 0] = c * right - s * up
        Q[1, k] = Q[k, 1] = s * right + c * up
    for k in range(4, n):
        Q[k, k - 2] = Q[k - 2, k]


@shared(f"void({_TYPES})")
def _short_turn(
    x: FloatArray,
    t: float,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q of the state x, y, vx, vy, yaw rate after a turn of at most `MAX_TURN_RAD`.

    As in `_short_arc`, with complex numbers in the map. A velocity V that is added at r becomes V / U(r) at the end and
    moves the position by t V int U / U(r). A yaw rate that is added at r turns the final velocity V by i t g(r) / p(r)
    V and moves the position by i t^2 V (g(r) int U - int g U) / p(r). Bar-Shalom, Li and Kirubarajan (2001), section
    11.7, have the model with a yaw rate that does not relax.
    """
    n = len(x)
    b = noise[n] * t
    last_g = _relaxed(1.0, b)
    last_p = 1.0 + b * last_g
    w = x[4] / last_p
    angle = w * t * last_g
    c, s = math.cos(angle), math.sin(angle)
    vx, vy = c * x[2] - s * x[3], s * x[2] + c * x[3]
    nodes = scratch(_NUM_NODES, 5)
    _directions(w, t, b, nodes)
    for j in range(n):
        for k in range(n):
            F[j, k] = 1.0 if j == k else 0.0
            Q[j, k] = noise[j] * t if j == k and j < 2 else 0.0
    for i in range(_NUM_NODES + 1):
        is_end = i == _NUM_NODES
        unit_x, unit_y, turned_x, turned_y = _integrated(i, nodes)
        along, left, g = (
            (c, -s, last_g) if is_end else (nodes[i, 0], nodes[i, 1], nodes[i, 2])
        )
        p = 1.0 + b * g
        # By the velocity: the position moves by (way_x + i way_y) V, the final velocity is (along - i left) V.
        way_x, way_y = (
            t * (unit_x * along + unit_y * left),
            t * (unit_y * along - unit_x * left),
        )
        # By the yaw rate.
        late_x, late_y = (
            t * t * (g * unit_x - turned_x) / p,
            t * t * (g * unit_y - turned_y) / p,
        )
        right, up = -(vx * late_y + vy * late_x), vx * late_x - vy * late_y
        turn_s = t * g / p
        if is_end:
            F[0, 2], F[0, 3], F[1, 2], F[1, 3] = way_x, -way_y, way_y, way_x
            F[2, 2], F[2, 3], F[3, 2], F[3, 3] = along, left, -left, along
            F[0, 4], F[1, 4], F[2, 4], F[3, 4], F[4, 4] = (
                right,
                up,
                -vy * turn_s,
                vx * turn_s,
                1.0 / p,
            )
            mean[0] = x[0] + way_x * x[2] - way_y * x[3]
            mean[1] = x[1] + way_y * x[2] + way_x * x[3]
            mean[2], mean[3], mean[4] = vx, vy, w
            continue
        q = noise[2] * t * _WEIGHTS[i]
        length = q * (way_x * way_x + way_y * way_y)
        # Position times conjugate velocity.
        same, other = (
            q * (way_x * along - way_y * left),
            q * (way_y * along + way_x * left),
        )
        Q[0, 0] += length
        Q[1, 1] += length
        Q[0, 2] += same
        Q[1, 3] += same
        Q[1, 2] += other
        Q[0, 3] -= other
        Q[2, 2] += q
        Q[3, 3] += q
        q = noise[4] * t * _WEIGHTS[i]
        effect_x, effect_y, rate = -vy * turn_s, vx * turn_s, 1.0 / p
        Q[0, 0] += q * right * right
        Q[0, 1] += q * right * up
        Q[1, 1] += q * up * up
        Q[0, 2] += q * right * effect_x
        Q[0, 3] += q * right * effect_y
        Q[1, 2] += q * up * effect_x
        Q[1, 3] += q * up * effect_y
        Q[2, 2] += q * effect_x * effect_x
        Q[2, 3] += q * effect_x * effect_y
        Q[3, 3] += q * effect_y * effect_y
        Q[0, 4] += q * right * rate
        Q[1, 4] += q * up * rate
        Q[2, 4] += q * effect_x * rate
        Q[3, 4] += q * effect_y * rate
        Q[4, 4] += q * rate * rate
    for j in range(n):
        for k in range(j):
            Q[j, k] = Q[k, j]


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
        if kind == ARC:
            _short_arc(before if part else x, t, noise, mean, G if part else F, Q)
        else:
            _short_turn(before if part else x, t, noise, mean, G if part else F, Q)
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


@shared(f"void(int64, {_TYPES})")
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
