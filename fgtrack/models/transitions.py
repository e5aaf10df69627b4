"""Transitions of the shipped motion models, compiled: mean, Jacobian F and noise covariance Q of states after a time.

By definition, Q is the integral over s in [0, t] of Phi(t, s) D Phi(t, s)'. D is the diagonal of spectral densities at
the mean at s. Phi(t, s) is the Jacobian of the flow from s to t.

The parameters `noise` begin with the spectral densities of the entries of the state, shape (n,). For `ARC` and `TURN`
the rate at which the yaw rate relaxes follows, in 1/s. For `ARC` two more numbers follow: the speed below which an
object counts as slow, in m/s, and the additional density of the yaw of an object at rest, in rad^2/s.
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


def _integrals(nodes: FloatArray) -> FloatArray:
    """Matrix that gives integrals from -1/2 to each node, and to 1/2, of the polynomial through values at the nodes.

    Shape (nodes + 1, nodes). The nodes lie in [-1/2, 1/2].
    """
    powers = np.arange(len(nodes))
    ends = np.append(nodes, 0.5)[:, None]
    integrals = (ends ** (powers + 1) - (-0.5) ** (powers + 1)) / (powers + 1)
    return np.asarray(np.linalg.solve((nodes[:, None] ** powers).T, integrals.T).T)


# Gauss-Legendre quadrature on [-1/2, 1/2]; integrals up to its nodes by collocation (Hairer, Norsett and Wanner,
# Solving Ordinary Differential Equations I, section II.7). The middle node is 0.
_roots, _root_weights = np.polynomial.legendre.leggauss(_NUM_NODES)
_NODES, _WEIGHTS = 0.5 * _roots, 0.5 * _root_weights
_INTEGRALS = _integrals(_NODES)
# Factors of even powers in the series of (cosh(z) - 1) / z^2, sinh(z) / z, cos(z) and sin(z) / z. The first factor left
# out changes a result by less than 2e-15 where |z| <= 0.152.
_NUM_TERMS = 5
_COSH = np.array([1.0 / math.factorial(2 * k + 2) for k in range(_NUM_TERMS)])
_SINH = np.array([1.0 / math.factorial(2 * k + 1) for k in range(_NUM_TERMS)])
_COS = np.array([(-1.0) ** k / math.factorial(2 * k) for k in range(_NUM_TERMS)])
_SIN = np.array([(-1.0) ** k / math.factorial(2 * k + 1) for k in range(_NUM_TERMS)])
# Rows of values at the nodes: the direction U, g times the velocity (`TURN`: g times U), r U, and g.
_UNIT_X, _UNIT_Y, _TURNED_X, _TURNED_Y, _LATE_X, _LATE_Y, _G, _NUM_ROWS = range(8)
# Rows of effects on the final position, x and y, by an entry of the state; then rows of effects on other entries.
_BY_YAW, _BY_SPEED, _BY_RATE, _BY_ACCEL = 0, 2, 4, 6
_TURN_BY_RATE, _RATE_BY_RATE, _SPEED_BY_ACCEL, _ACCEL_BY_ACCEL = 8, 9, 10, 11
# Row of the factor t^2 / p, and the number of rows.
_SHARE, _NUM_EFFECTS = 12, 13

Bend = tuple[float, float, float, float]
"""Yaw rate w in the middle, b, g(1/2) and g(-1/2), see `_short`."""
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
def _angles(r: float, b: float) -> tuple[float, float]:
    """Return g(r) and g(-r), with g(r) = (exp(b r) - 1) / b, for |b| <= `MAX_RELAXATION` and 0 < r <= 1/2.

    The results are the sum and the difference of a symmetric part, (cosh(b r) - 1) / b, and an antisymmetric part,
    sinh(b r) / b.
    """
    square = (b * r) * (b * r)
    even, odd = 0.0, 0.0
    for k in range(_NUM_TERMS - 1, -1, -1):
        even = even * square + _COSH[k]
        odd = odd * square + _SINH[k]
    even *= b * r * r
    odd *= r
    return even + odd, even - odd


@inlined
def _direction(angle: float) -> tuple[float, float]:
    """Return cosine and sine of an angle of at most 0.152 rad.

    No angle between the middle and an end of a part is larger.
    """
    square = angle * angle
    cosine, sine = 0.0, 0.0
    for k in range(_NUM_TERMS - 1, -1, -1):
        cosine = cosine * square + _COS[k]
        sine = sine * square + _SIN[k]
    return cosine, sine * angle


@inlined
def _write_directions(w: float, t: float, b: float, at: FloatArray) -> None:
    """Write g and the direction U = exp(-i w t g) at each node to rows of `at` (rows, nodes), see `_short`."""
    middle = _NUM_NODES // 2
    at[_G, middle], at[_UNIT_X, middle], at[_UNIT_Y, middle] = 0.0, 1.0, 0.0
    for j in range(middle):
        late = _NUM_NODES - 1 - j
        at[_G, late], at[_G, j] = _angles(_NODES[late], b)
        at[_UNIT_X, j], at[_UNIT_Y, j] = _direction(-w * t * at[_G, j])
        at[_UNIT_X, late], at[_UNIT_Y, late] = _direction(-w * t * at[_G, late])


@inlined
def _integrate(num_rows: int, at: FloatArray, integrals: FloatArray) -> None:
    """Write integrals of the first rows of `at` (rows, nodes), from the end to each node and to the beginning.

    The shape of `integrals` is (rows, nodes + 1).
    """
    for row in range(num_rows):
        for i in range(_NUM_NODES + 1):
            total = 0.0
            for j in range(_NUM_NODES):
                total += _INTEGRALS[i, j] * at[row, j]
            integrals[row, i] = total


@inlined
def _sums(
    weights: FloatArray, effect: FloatArray, row: int
) -> tuple[float, float, float, float, float]:
    """Return the weighted sums over the nodes of x x, x y, y y, x and y.

    x and y are the rows of `effect` from `row` on.
    """
    xx, xy, yy, sum_x, sum_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(_NUM_NODES):
        x, y = effect[row, i], effect[row + 1, i]
        share_x, share_y = weights[i] * x, weights[i] * y
        xx += share_x * x
        xy += share_x * y
        yy += share_y * y
        sum_x += share_x
        sum_y += share_y
    return xx, xy, yy, sum_x, sum_y


@inlined
def _coupled_sums(
    effect: FloatArray, row: int, own: int
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Return the weighted sums over the nodes of all products of x and y, of x and y with a and b, and of a and b.

    The order is x x, x y, y y, x a, y a, x b, y b, a a, a b, b b. x and y are the rows of `effect` from `row` on, a
    and b the rows from `own` on.
    """
    xx, xy, yy, xa, ya, xb, yb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    aa, ab, bb = 0.0, 0.0, 0.0
    for i in range(_NUM_NODES):
        x, y = effect[row, i], effect[row + 1, i]
        a, b = effect[own, i], effect[own + 1, i]
        share_x, share_y = _WEIGHTS[i] * x, _WEIGHTS[i] * y
        share_a, share_b = _WEIGHTS[i] * a, _WEIGHTS[i] * b
        xx += share_x * x
        xy += share_x * y
        yy += share_y * y
        xa += share_a * x
        ya += share_a * y
        xb += share_b * x
        yb += share_b * y
        aa += share_a * a
        ab += share_a * b
        bb += share_b * b
    return xx, xy, yy, xa, ya, xb, yb, aa, ab, bb


@inlined
def _write_rate_effects(
    b: float,
    t: float,
    first_g: float,
    last_g: float,
    at: FloatArray,
    effect: FloatArray,
) -> None:
    """Write the effects of the yaw rate at each node, and at the beginning, on the final yaw and yaw rate."""
    last_p = 1.0 + b * last_g
    for i in range(_NUM_NODES + 1):
        g = at[_G, i] if i < _NUM_NODES else first_g
        share = 1.0 / (1.0 + b * g)
        effect[_SHARE, i] = t * t * share
        effect[_TURN_BY_RATE, i] = t * (g - last_g) * share
        effect[_RATE_BY_RATE, i] = last_p * share


@inlined
def _write_column(
    M: FloatArray, k: int, x: float, y: float, c: float, s: float
) -> None:
    """Write a displacement into the rows of the position in column k of M.

    The displacement is x along and y left of the heading with the cosine c and the sine s.
    """
    M[0, k] = c * x - s * y
    M[1, k] = s * x + c * y


@inlined
def _mirror(n: int, Q: FloatArray) -> None:
    """Copy the upper triangle to the lower triangle."""
    for j in range(n):
        for k in range(j):
            Q[j, k] = Q[k, j]


@inlined
def _write_identity(n: int, F: FloatArray) -> None:
    """Write the identity matrix."""
    for j in range(n):
        for k in range(n):
            F[j, k] = 1.0 if j == k else 0.0


@inlined
def _write_arc_integrals(
    n: int, v: float, accel: float, t: float, at: FloatArray, integrals: FloatArray
) -> None:
    """Write the integrals of U, of g V with the velocity V, and with an acceleration of r U, see `_integrate`."""
    for j in range(_NUM_NODES):
        turned = at[_G, j] * (v - accel * t * _NODES[j])
        at[_TURNED_X, j] = turned * at[_UNIT_X, j]
        at[_TURNED_Y, j] = turned * at[_UNIT_Y, j]
        if n > 5:
            at[_LATE_X, j] = _NODES[j] * at[_UNIT_X, j]
            at[_LATE_Y, j] = _NODES[j] * at[_UNIT_Y, j]
    _integrate(6 if n > 5 else 4, at, integrals)


@inlined
def _write_arc_effects(
    n: int,
    v: float,
    accel: float,
    t: float,
    first_g: float,
    at: FloatArray,
    integrals: FloatArray,
    effect: FloatArray,
) -> None:
    """Write the effects of the state at each node, and at the beginning, on the final position.

    All integrals run from the end to r. The effects are:

    - of the yaw: i t int V;
    - of the speed: t int U;
    - of the yaw rate: i t^2 (g(r) int V - int g V) / p(r);
    - of the acceleration: t^2 (r int U - int s U).
    """
    for i in range(_NUM_NODES + 1):
        is_node = i < _NUM_NODES
        unit_x, unit_y = integrals[_UNIT_X, i], integrals[_UNIT_Y, i]
        way_x, way_y = v * unit_x, v * unit_y
        if n > 5:
            r = _NODES[i] if is_node else 0.5
            late_x, late_y = integrals[_LATE_X, i], integrals[_LATE_Y, i]
            way_x -= accel * t * late_x
            way_y -= accel * t * late_y
            effect[_BY_ACCEL, i] = t * t * (r * unit_x - late_x)
            effect[_BY_ACCEL + 1, i] = t * t * (r * unit_y - late_y)
            effect[_SPEED_BY_ACCEL, i] = t * (r + 0.5)
            effect[_ACCEL_BY_ACCEL, i] = 1.0
        g, share = at[_G, i] if is_node else first_g, effect[_SHARE, i]
        effect[_BY_YAW, i], effect[_BY_YAW + 1, i] = -t * way_y, t * way_x
        effect[_BY_SPEED, i], effect[_BY_SPEED + 1, i] = t * unit_x, t * unit_y
        effect[_BY_RATE, i] = share * (integrals[_TURNED_Y, i] - g * way_y)
        effect[_BY_RATE + 1, i] = share * (g * way_x - integrals[_TURNED_X, i])


@inlined
def _yaw_density(v: float, n: int, noise: FloatArray) -> float:
    """Spectral density of the yaw at the speed v; it is larger for slow objects."""
    ratio = v / noise[n + 1]
    slowness = 1.0 / (1.0 + ratio * ratio)
    density: float = noise[2] + noise[n + 2] * slowness * slowness
    return density


@inlined
def _yaw_sums(
    n: int,
    v: float,
    accel: float,
    t: float,
    noise: FloatArray,
    speed: tuple[float, float, float, float, float],
    effect: FloatArray,
) -> tuple[float, float, float, float, float, float]:
    """Return the integral of the spectral density of the yaw, and `_sums` of the yaw's effects times this density.

    At a constant speed the effects of the yaw are i v times the effects of the speed, whose sums are `speed`.
    """
    if n == 5:
        q = _yaw_density(v, n, noise) * t
        xx, xy, yy, x, y = speed
        return q, q * v * v * yy, -q * v * v * xy, q * v * v * xx, -q * v * y, q * v * x
    weights, total = scratch(_NUM_NODES), 0.0
    for i in range(_NUM_NODES):
        weights[i] = _yaw_density(v - accel * t * _NODES[i], n, noise) * t * _WEIGHTS[i]
        total += weights[i]
    xx, xy, yy, x, y = _sums(weights, effect, _BY_YAW)
    return total, xx, xy, yy, x, y


@inlined
def _write_arc_noise(
    n: int,
    t: float,
    noise: FloatArray,
    c: float,
    s: float,
    speed: tuple[float, float, float, float, float],
    yaw: tuple[float, float, float, float, float, float],
    effect: FloatArray,
    Q: FloatArray,
) -> None:
    """Write the upper triangle of Q: spectral densities times the sums over the nodes of products of effects."""
    rate = _coupled_sums(effect, _BY_RATE, _TURN_BY_RATE)
    q, r = noise[3] * t, noise[4] * t
    xx = yaw[1] + q * speed[0] + r * rate[0]
    xy = yaw[2] + q * speed[1] + r * rate[1]
    yy = yaw[3] + q * speed[2] + r * rate[2]
    speed_x, speed_y = q * speed[3], q * speed[4]
    Q[2, 2], Q[2, 3], Q[3, 3] = yaw[0] + r * rate[7], 0.0, q
    Q[2, 4], Q[3, 4], Q[4, 4] = r * rate[8], 0.0, r * rate[9]
    _write_column(Q, 2, yaw[4] + r * rate[3], yaw[5] + r * rate[4], c, s)
    _write_column(Q, 4, r * rate[5], r * rate[6], c, s)
    if n > 5:
        a = noise[5] * t
        late = _coupled_sums(effect, _BY_ACCEL, _SPEED_BY_ACCEL)
        xx, xy, yy = xx + a * late[0], xy + a * late[1], yy + a * late[2]
        speed_x, speed_y = speed_x + a * late[3], speed_y + a * late[4]
        Q[3, 3] += a * late[7]
        Q[2, 5], Q[3, 5], Q[4, 5], Q[5, 5] = 0.0, a * late[8], 0.0, a
        _write_column(Q, 5, a * late[5], a * late[6], c, s)
    _write_column(Q, 3, speed_x, speed_y, c, s)
    Q[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy + noise[0] * t
    Q[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy + noise[1] * t
    Q[0, 1] = c * s * (xx - yy) + (c * c - s * s) * xy


@inlined
def _write_arc(
    n: int,
    x: FloatArray,
    t: float,
    noise: FloatArray,
    bend: Bend,
    at: FloatArray,
    integrals: FloatArray,
    effect: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q of the state x, y, yaw, speed, yaw rate and, for n = 6, acceleration, see `_short`.

    Positions are complex numbers along and left of the heading in the middle of the arc.
    """
    w, _, first_g, last_g = bend
    accel = x[5] if n > 5 else 0.0
    v = x[3] + 0.5 * accel * t
    yaw = x[2] + w * t * first_g
    c, s = math.cos(yaw), math.sin(yaw)
    _write_arc_integrals(n, v, accel, t, at, integrals)
    _write_arc_effects(n, v, accel, t, first_g, at, integrals, effect)
    speed_sums = _sums(_WEIGHTS, effect, _BY_SPEED)
    yaw_sums = _yaw_sums(n, v, accel, t, noise, speed_sums, effect)
    _write_arc_noise(n, t, noise, c, s, speed_sums, yaw_sums, effect, Q)
    first = _NUM_NODES
    for k in range(2, n):
        row = 2 * (k - 2)
        _write_column(F, k, effect[row, first], effect[row + 1, first], c, s)
    F[2, 4], F[4, 4] = effect[_TURN_BY_RATE, first], effect[_RATE_BY_RATE, first]
    way_x, way_y = effect[_BY_YAW + 1, first], -effect[_BY_YAW, first]
    mean[0] = x[0] + c * way_x - s * way_y
    mean[1] = x[1] + s * way_x + c * way_y
    mean[2] = yaw - w * t * last_g
    mean[3] = x[3] + accel * t
    mean[4] = F[4, 4] * x[4]
    if n > 5:
        F[3, 5], mean[5] = t, accel


@inlined
def _write_turn_effects(
    vx: float,
    vy: float,
    t: float,
    first_g: float,
    at: FloatArray,
    integrals: FloatArray,
    effect: FloatArray,
) -> None:
    """Write t int U, and the effect of the yaw rate on the final position, for each node and for the beginning."""
    for i in range(_NUM_NODES + 1):
        g, share = at[_G, i] if i < _NUM_NODES else first_g, effect[_SHARE, i]
        unit_x, unit_y = integrals[_UNIT_X, i], integrals[_UNIT_Y, i]
        late_x = share * (g * unit_x - integrals[_TURNED_X, i])
        late_y = share * (g * unit_y - integrals[_TURNED_Y, i])
        effect[_BY_SPEED, i], effect[_BY_SPEED + 1, i] = t * unit_x, t * unit_y
        effect[_BY_RATE, i] = -(vx * late_y + vy * late_x)
        effect[_BY_RATE + 1, i] = vx * late_x - vy * late_y


@inlined
def _write_turn_noise(
    t: float,
    noise: FloatArray,
    last_x: float,
    last_y: float,
    vx: float,
    vy: float,
    effect: FloatArray,
    Q: FloatArray,
) -> None:
    """Write the upper triangle of Q: spectral densities times the sums over the nodes of products of effects.

    At the end U is last_x + i last_y, and the velocity is (vx, vy).
    """
    speed, rate = (
        _sums(_WEIGHTS, effect, _BY_SPEED),
        _coupled_sums(effect, _BY_RATE, _TURN_BY_RATE),
    )
    q, r = noise[2] * t, noise[4] * t
    length = q * (speed[0] + speed[2])
    same = q * (speed[3] * last_x + speed[4] * last_y)
    other = q * (speed[4] * last_x - speed[3] * last_y)
    Q[0, 0] = noise[0] * t + length + r * rate[0]
    Q[0, 1] = r * rate[1]
    Q[1, 1] = noise[1] * t + length + r * rate[2]
    Q[0, 2], Q[0, 3] = same - r * rate[3] * vy, r * rate[3] * vx - other
    Q[1, 2], Q[1, 3] = other - r * rate[4] * vy, r * rate[4] * vx + same
    Q[0, 4], Q[1, 4] = r * rate[5], r * rate[6]
    Q[2, 2], Q[3, 3] = q + r * rate[7] * vy * vy, q + r * rate[7] * vx * vx
    Q[2, 3] = -r * rate[7] * vx * vy
    Q[2, 4], Q[3, 4] = -r * rate[8] * vy, r * rate[8] * vx
    Q[4, 4] = r * rate[9]


@inlined
def _write_turn(
    x: FloatArray,
    t: float,
    noise: FloatArray,
    bend: Bend,
    at: FloatArray,
    integrals: FloatArray,
    effect: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q of the state x, y, vx, vy, yaw rate, see `_short`.

    Positions and velocities are complex numbers in the map. The velocity is V U(r) with the velocity V in the middle.
    A velocity d added at r becomes d U(-1/2) / U(r) at the end. It moves the position by d t int U / U(r). A yaw rate
    added at r turns the final velocity by t (g(r) - g(-1/2)) / p(r). It moves the position by
    i t^2 V (g(r) int U - int g U) / p(r). Bar-Shalom, Li and Kirubarajan (2001), section 11.7, have the model with a
    yaw rate that does not relax.
    """
    w, _, first_g, last_g = bend
    first_x, first_y = _direction(-w * t * first_g)
    last_x, last_y = _direction(-w * t * last_g)
    middle_vx = first_x * x[2] + first_y * x[3]
    middle_vy = first_x * x[3] - first_y * x[2]
    vx = last_x * middle_vx - last_y * middle_vy
    vy = last_x * middle_vy + last_y * middle_vx
    for j in range(_NUM_NODES):
        at[_TURNED_X, j] = at[_G, j] * at[_UNIT_X, j]
        at[_TURNED_Y, j] = at[_G, j] * at[_UNIT_Y, j]
    _integrate(4, at, integrals)
    _write_turn_effects(middle_vx, middle_vy, t, first_g, at, integrals, effect)
    _write_turn_noise(t, noise, last_x, last_y, vx, vy, effect, Q)
    first = _NUM_NODES
    unit_x, unit_y = effect[_BY_SPEED, first], effect[_BY_SPEED + 1, first]
    way_x = unit_x * first_x + unit_y * first_y
    way_y = unit_y * first_x - unit_x * first_y
    c, s = last_x * first_x + last_y * first_y, last_y * first_x - last_x * first_y
    F[0, 2], F[0, 3], F[1, 2], F[1, 3] = way_x, -way_y, way_y, way_x
    F[2, 2], F[2, 3], F[3, 2], F[3, 3] = c, -s, s, c
    F[0, 4], F[1, 4] = effect[_BY_RATE, first], effect[_BY_RATE + 1, first]
    turn = effect[_TURN_BY_RATE, first]
    F[2, 4], F[3, 4], F[4, 4] = -vy * turn, vx * turn, effect[_RATE_BY_RATE, first]
    mean[0] = x[0] + way_x * x[2] - way_y * x[3]
    mean[1] = x[1] + way_y * x[2] + way_x * x[3]
    mean[2], mean[3], mean[4] = vx, vy, F[4, 4] * x[4]


@shared(f"void(int64, {_TYPES})")
def _short(
    kind: int,
    x: FloatArray,
    t: float,
    noise: FloatArray,
    mean: FloatArray,
    F: FloatArray,
    Q: FloatArray,
) -> None:
    """Write mean, F and Q of an arc or a turn of at most `MAX_TURN_RAD`.

    At a time r t before the middle the yaw rate is w p(r) and the heading is -w t g(r). Here w is the yaw rate in the
    middle, p = exp(b r) and g = (p - 1) / b, with b = t times the rate of relaxation. So r is 1/2 at the beginning and
    -1/2 at the end. F has the effects of the state at the beginning on the state at the end. Q is the integral over r
    of products of effects.
    """
    n = len(x)
    b = noise[n] * t
    first_g, last_g = _angles(0.5, b)
    w = x[4] / (1.0 + b * first_g)
    at, integrals = scratch(_NUM_ROWS, _NUM_NODES), scratch(_NUM_ROWS, _NUM_NODES + 1)
    effect = scratch(_NUM_EFFECTS, _NUM_NODES + 1)
    _write_directions(w, t, b, at)
    _write_rate_effects(b, t, first_g, last_g, at, effect)
    _write_identity(n, F)
    bend = w, b, first_g, last_g
    if kind == TURN:
        _write_turn(x, t, noise, bend, at, integrals, effect, mean, F, Q)
    elif n == 5:  # compiled for 5 and for 6 entries, which is faster
        _write_arc(5, x, t, noise, bend, at, integrals, effect, mean, F, Q)
    else:
        _write_arc(6, x, t, noise, bend, at, integrals, effect, mean, F, Q)
    _mirror(n, Q)


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
        _short(kind, before if part else x, t, noise, mean, G if part else F, Q)
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
