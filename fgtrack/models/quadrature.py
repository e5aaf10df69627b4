"""Quadrature along a short bend (an arc or a turn) whose yaw rate relaxes, compiled.

At a time r t before the middle, the yaw rate is w p(r) and the heading is -w t g(r), see `short_bends`.
"""

import math

import numpy as np

from fgtrack.core.compiled import inlined
from fgtrack.core.types import FloatArray

NUM_NODES = 5


def _integrals(nodes: FloatArray) -> FloatArray:
    """Return the matrix (nodes + 1, nodes) that integrates the polynomial through values at the nodes.

    The integrals run from -1/2 to each node, and to 1/2. The nodes lie in [-1/2, 1/2].
    """
    powers = np.arange(len(nodes))
    ends = np.append(nodes, 0.5)[:, None]
    integrals = (ends ** (powers + 1) - (-0.5) ** (powers + 1)) / (powers + 1)
    return np.asarray(np.linalg.solve((nodes[:, None] ** powers).T, integrals.T).T)


# Gauss-Legendre quadrature on [-1/2, 1/2]; integrals up to its nodes by collocation (Hairer, Norsett and Wanner,
# Solving Ordinary Differential Equations I, section II.7). The middle node is 0.
_roots, _root_weights = np.polynomial.legendre.leggauss(NUM_NODES)
NODES, WEIGHTS = 0.5 * _roots, 0.5 * _root_weights
_INTEGRALS = _integrals(NODES)
# Factors of even powers in the series of (cosh(z) - 1) / z^2, sinh(z) / z, cos(z) and sin(z) / z. The first factor left
# out changes a result by less than 2e-15 where |z| <= 0.152.
_NUM_TERMS = 5
_COSH = np.array([1.0 / math.factorial(2 * k + 2) for k in range(_NUM_TERMS)])
_SINH = np.array([1.0 / math.factorial(2 * k + 1) for k in range(_NUM_TERMS)])
_COS = np.array([(-1.0) ** k / math.factorial(2 * k) for k in range(_NUM_TERMS)])
_SIN = np.array([(-1.0) ** k / math.factorial(2 * k + 1) for k in range(_NUM_TERMS)])
# Rows of values at the nodes: the direction U, g times the velocity (`TURN`: g times U), r U, and g.
UNIT_X, UNIT_Y, TURNED_X, TURNED_Y, LATE_X, LATE_Y, G, NUM_ROWS = range(8)
# Rows of effects on the final position, x and y, by an entry of the state; then rows of effects on other entries.
BY_YAW, BY_SPEED, BY_RATE, BY_ACCEL = 0, 2, 4, 6
TURN_BY_RATE, RATE_BY_RATE, SPEED_BY_ACCEL, ACCEL_BY_ACCEL = 8, 9, 10, 11
# Row of the factor t^2 / p, and the number of rows.
SHARE, NUM_EFFECTS = 12, 13


@inlined
def angles(r: float, b: float) -> tuple[float, float]:
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
def direction(angle: float) -> tuple[float, float]:
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
def write_directions(w: float, t: float, b: float, at: FloatArray) -> None:
    """Write g and the direction U = exp(-i w t g) at each node to rows of `at` (rows, nodes), see `short_bends`."""
    middle = NUM_NODES // 2
    at[G, middle], at[UNIT_X, middle], at[UNIT_Y, middle] = 0.0, 1.0, 0.0
    for j in range(middle):
        late = NUM_NODES - 1 - j
        at[G, late], at[G, j] = angles(NODES[late], b)
        at[UNIT_X, j], at[UNIT_Y, j] = direction(-w * t * at[G, j])
        at[UNIT_X, late], at[UNIT_Y, late] = direction(-w * t * at[G, late])


@inlined
def integrate(num_rows: int, at: FloatArray, integrals: FloatArray) -> None:
    """Write integrals of the first rows of `at` (rows, nodes), from the end to each node and to the beginning.

    The shape of `integrals` is (rows, nodes + 1).
    """
    for row in range(num_rows):
        for i in range(NUM_NODES + 1):
            total = 0.0
            for j in range(NUM_NODES):
                total += _INTEGRALS[i, j] * at[row, j]
            integrals[row, i] = total


@inlined
def sums(
    weights: FloatArray, effect: FloatArray, row: int
) -> tuple[float, float, float, float, float]:
    """Return the weighted sums over the nodes of x x, x y, y y, x and y.

    x and y are the rows of `effect` from `row` on.
    """
    xx, xy, yy, sum_x, sum_y = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(NUM_NODES):
        x, y = effect[row, i], effect[row + 1, i]
        share_x, share_y = weights[i] * x, weights[i] * y
        xx += share_x * x
        xy += share_x * y
        yy += share_y * y
        sum_x += share_x
        sum_y += share_y
    return xx, xy, yy, sum_x, sum_y


@inlined
def coupled_sums(
    effect: FloatArray, row: int, own: int
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Return the weighted sums over the nodes of all products of x and y, of x and y with a and b, and of a and b.

    The order is x x, x y, y y, x a, y a, x b, y b, a a, a b, b b. x and y are the rows of `effect` from `row` on, a
    and b the rows from `own` on.
    """
    xx, xy, yy, xa, ya, xb, yb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    aa, ab, bb = 0.0, 0.0, 0.0
    for i in range(NUM_NODES):
        x, y = effect[row, i], effect[row + 1, i]
        a, b = effect[own, i], effect[own + 1, i]
        share_x, share_y = WEIGHTS[i] * x, WEIGHTS[i] * y
        share_a, share_b = WEIGHTS[i] * a, WEIGHTS[i] * b
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
def write_rate_effects(
    b: float,
    t: float,
    first_g: float,
    last_g: float,
    at: FloatArray,
    effect: FloatArray,
) -> None:
    """Write the effects of the yaw rate at each node, and at the beginning, on the final yaw and yaw rate."""
    last_p = 1.0 + b * last_g
    for i in range(NUM_NODES + 1):
        g = at[G, i] if i < NUM_NODES else first_g
        share = 1.0 / (1.0 + b * g)
        effect[SHARE, i] = t * t * share
        effect[TURN_BY_RATE, i] = t * (g - last_g) * share
        effect[RATE_BY_RATE, i] = last_p * share


@inlined
def write_column(M: FloatArray, k: int, x: float, y: float, c: float, s: float) -> None:
    """Write a displacement into the rows of the position in column k of M.

    The displacement is x along and y left of the heading with the cosine c and the sine s.
    """
    M[0, k] = c * x - s * y
    M[1, k] = s * x + c * y


@inlined
def mirror(n: int, Q: FloatArray) -> None:
    """Copy the upper triangle to the lower triangle."""
    for j in range(n):
        for k in range(j):
            Q[j, k] = Q[k, j]


@inlined
def write_identity(n: int, F: FloatArray) -> None:
    """Write the identity matrix."""
    for j in range(n):
        for k in range(n):
            F[j, k] = 1.0 if j == k else 0.0
