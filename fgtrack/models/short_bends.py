"""Compiled transitions over short bends: arcs of `CTRV` and `CTRA`, and turns of `CT`. See `transitions`."""

import math

from fgtrack.core.compiled import inlined, scratch, shared
from fgtrack.core.types import FloatArray
from fgtrack.models.quadrature import (
    ACCEL_BY_ACCEL,
    BY_ACCEL,
    BY_RATE,
    BY_SPEED,
    BY_YAW,
    LATE_X,
    LATE_Y,
    NODES,
    NUM_EFFECTS,
    NUM_NODES,
    NUM_ROWS,
    RATE_BY_RATE,
    SHARE,
    SPEED_BY_ACCEL,
    TURN_BY_RATE,
    TURNED_X,
    TURNED_Y,
    UNIT_X,
    UNIT_Y,
    WEIGHTS,
    G,
    angles,
    coupled_sums,
    direction,
    integrate,
    mirror,
    sums,
    write_column,
    write_directions,
    write_identity,
    write_rate_effects,
)

#: Kinds of motion: constant turn rate and velocity (or acceleration), constant velocity, and constant turn rate with
#: the velocity along the axes of the map.
ARC, LINE, TURN = 0, 1, 2
Bend = tuple[float, float, float, float]
"""Yaw rate w in the middle, b, g(1/2) and g(-1/2), see `short_bend`."""
TYPES = f"float64[::1], float64, {'float64[::1], ' * 2}float64[:, ::1], float64[:, ::1]"


@inlined
def _write_arc_integrals(
    n: int, v: float, accel: float, t: float, at: FloatArray, integrals: FloatArray
) -> None:
    """Write the integrals of U and of g V, with the velocity V, and for n = 6 of r U, see `integrate`."""
    for j in range(NUM_NODES):
        turned = at[G, j] * (v - accel * t * NODES[j])
        at[TURNED_X, j] = turned * at[UNIT_X, j]
        at[TURNED_Y, j] = turned * at[UNIT_Y, j]
        if n > 5:
            at[LATE_X, j] = NODES[j] * at[UNIT_X, j]
            at[LATE_Y, j] = NODES[j] * at[UNIT_Y, j]
    integrate(6 if n > 5 else 4, at, integrals)


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
    for i in range(NUM_NODES + 1):
        is_node = i < NUM_NODES
        unit_x, unit_y = integrals[UNIT_X, i], integrals[UNIT_Y, i]
        way_x, way_y = v * unit_x, v * unit_y
        if n > 5:
            r = NODES[i] if is_node else 0.5
            late_x, late_y = integrals[LATE_X, i], integrals[LATE_Y, i]
            way_x -= accel * t * late_x
            way_y -= accel * t * late_y
            effect[BY_ACCEL, i] = t * t * (r * unit_x - late_x)
            effect[BY_ACCEL + 1, i] = t * t * (r * unit_y - late_y)
            effect[SPEED_BY_ACCEL, i] = t * (r + 0.5)
            effect[ACCEL_BY_ACCEL, i] = 1.0
        g, share = at[G, i] if is_node else first_g, effect[SHARE, i]
        effect[BY_YAW, i], effect[BY_YAW + 1, i] = -t * way_y, t * way_x
        effect[BY_SPEED, i], effect[BY_SPEED + 1, i] = t * unit_x, t * unit_y
        effect[BY_RATE, i] = share * (integrals[TURNED_Y, i] - g * way_y)
        effect[BY_RATE + 1, i] = share * (g * way_x - integrals[TURNED_X, i])


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
    """Return the integral of the spectral density of the yaw, and `sums` of the yaw's effects times this density.

    At a constant speed the effects of the yaw are i v times the effects of the speed, whose sums are `speed`.
    """
    if n == 5:
        q = _yaw_density(v, n, noise) * t
        xx, xy, yy, x, y = speed
        return q, q * v * v * yy, -q * v * v * xy, q * v * v * xx, -q * v * y, q * v * x
    weights, total = scratch(NUM_NODES), 0.0
    for i in range(NUM_NODES):
        weights[i] = _yaw_density(v - accel * t * NODES[i], n, noise) * t * WEIGHTS[i]
        total += weights[i]
    xx, xy, yy, x, y = sums(weights, effect, BY_YAW)
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
    rate = coupled_sums(effect, BY_RATE, TURN_BY_RATE)
    q, r = noise[3] * t, noise[4] * t
    xx = yaw[1] + q * speed[0] + r * rate[0]
    xy = yaw[2] + q * speed[1] + r * rate[1]
    yy = yaw[3] + q * speed[2] + r * rate[2]
    speed_x, speed_y = q * speed[3], q * speed[4]
    Q[2, 2], Q[2, 3], Q[3, 3] = yaw[0] + r * rate[7], 0.0, q
    Q[2, 4], Q[3, 4], Q[4, 4] = r * rate[8], 0.0, r * rate[9]
    write_column(Q, 2, yaw[4] + r * rate[3], yaw[5] + r * rate[4], c, s)
    write_column(Q, 4, r * rate[5], r * rate[6], c, s)
    if n > 5:
        a = noise[5] * t
        late = coupled_sums(effect, BY_ACCEL, SPEED_BY_ACCEL)
        xx, xy, yy = xx + a * late[0], xy + a * late[1], yy + a * late[2]
        speed_x, speed_y = speed_x + a * late[3], speed_y + a * late[4]
        Q[3, 3] += a * late[7]
        Q[2, 5], Q[3, 5], Q[4, 5], Q[5, 5] = 0.0, a * late[8], 0.0, a
        write_column(Q, 5, a * late[5], a * late[6], c, s)
    write_column(Q, 3, speed_x, speed_y, c, s)
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
    """Write mean, F and Q of the state x, y, yaw, speed, yaw rate and, for n = 6, acceleration, see `short_bend`.

    Positions are complex numbers along and left of the heading in the middle of the arc.
    """
    w, _, first_g, last_g = bend
    accel = x[5] if n > 5 else 0.0
    v = x[3] + 0.5 * accel * t
    yaw = x[2] + w * t * first_g
    c, s = math.cos(yaw), math.sin(yaw)
    _write_arc_integrals(n, v, accel, t, at, integrals)
    _write_arc_effects(n, v, accel, t, first_g, at, integrals, effect)
    speed_sums = sums(WEIGHTS, effect, BY_SPEED)
    yaw_sums = _yaw_sums(n, v, accel, t, noise, speed_sums, effect)
    _write_arc_noise(n, t, noise, c, s, speed_sums, yaw_sums, effect, Q)
    first = NUM_NODES
    for k in range(2, n):
        row = 2 * (k - 2)
        write_column(F, k, effect[row, first], effect[row + 1, first], c, s)
    F[2, 4], F[4, 4] = effect[TURN_BY_RATE, first], effect[RATE_BY_RATE, first]
    way_x, way_y = effect[BY_YAW + 1, first], -effect[BY_YAW, first]
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
    for i in range(NUM_NODES + 1):
        g, share = at[G, i] if i < NUM_NODES else first_g, effect[SHARE, i]
        unit_x, unit_y = integrals[UNIT_X, i], integrals[UNIT_Y, i]
        late_x = share * (g * unit_x - integrals[TURNED_X, i])
        late_y = share * (g * unit_y - integrals[TURNED_Y, i])
        effect[BY_SPEED, i], effect[BY_SPEED + 1, i] = t * unit_x, t * unit_y
        effect[BY_RATE, i] = -(vx * late_y + vy * late_x)
        effect[BY_RATE + 1, i] = vx * late_x - vy * late_y


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
        sums(WEIGHTS, effect, BY_SPEED),
        coupled_sums(effect, BY_RATE, TURN_BY_RATE),
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
    """Write mean, F and Q of the state x, y, vx, vy, yaw rate, see `short_bend`.

    Positions and velocities are complex numbers in the map. The velocity is V U(r) with the velocity V in the middle.
    A velocity d added at r becomes d U(-1/2) / U(r) at the end. It moves the position by d t int U / U(r). A yaw rate
    added at r turns the final velocity by t (g(r) - g(-1/2)) / p(r). It moves the position by
    i t^2 V (g(r) int U - int g U) / p(r). Bar-Shalom, Li and Kirubarajan (2001), section 11.7, have the model with a
    yaw rate that does not relax.
    """
    w, _, first_g, last_g = bend
    first_x, first_y = direction(-w * t * first_g)
    last_x, last_y = direction(-w * t * last_g)
    middle_vx = first_x * x[2] + first_y * x[3]
    middle_vy = first_x * x[3] - first_y * x[2]
    vx = last_x * middle_vx - last_y * middle_vy
    vy = last_x * middle_vy + last_y * middle_vx
    for j in range(NUM_NODES):
        at[TURNED_X, j] = at[G, j] * at[UNIT_X, j]
        at[TURNED_Y, j] = at[G, j] * at[UNIT_Y, j]
    integrate(4, at, integrals)
    _write_turn_effects(middle_vx, middle_vy, t, first_g, at, integrals, effect)
    _write_turn_noise(t, noise, last_x, last_y, vx, vy, effect, Q)
    first = NUM_NODES
    unit_x, unit_y = effect[BY_SPEED, first], effect[BY_SPEED + 1, first]
    way_x = unit_x * first_x + unit_y * first_y
    way_y = unit_y * first_x - unit_x * first_y
    c, s = last_x * first_x + last_y * first_y, last_y * first_x - last_x * first_y
    F[0, 2], F[0, 3], F[1, 2], F[1, 3] = way_x, -way_y, way_y, way_x
    F[2, 2], F[2, 3], F[3, 2], F[3, 3] = c, -s, s, c
    F[0, 4], F[1, 4] = effect[BY_RATE, first], effect[BY_RATE + 1, first]
    turn = effect[TURN_BY_RATE, first]
    F[2, 4], F[3, 4], F[4, 4] = -vy * turn, vx * turn, effect[RATE_BY_RATE, first]
    mean[0] = x[0] + way_x * x[2] - way_y * x[3]
    mean[1] = x[1] + way_y * x[2] + way_x * x[3]
    mean[2], mean[3], mean[4] = vx, vy, F[4, 4] * x[4]


@shared(f"void(int64, {TYPES})")
def short_bend(
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
    first_g, last_g = angles(0.5, b)
    w = x[4] / (1.0 + b * first_g)
    at, integrals = scratch(NUM_ROWS, NUM_NODES), scratch(NUM_ROWS, NUM_NODES + 1)
    effect = scratch(NUM_EFFECTS, NUM_NODES + 1)
    write_directions(w, t, b, at)
    write_rate_effects(b, t, first_g, last_g, at, effect)
    write_identity(n, F)
    bend = w, b, first_g, last_g
    if kind == TURN:
        _write_turn(x, t, noise, bend, at, integrals, effect, mean, F, Q)
    elif n == 5:  # compiled for 5 and for 6 entries, which is faster
        _write_arc(5, x, t, noise, bend, at, integrals, effect, mean, F, Q)
    else:
        _write_arc(6, x, t, noise, bend, at, integrals, effect, mean, F, Q)
    mirror(n, Q)
