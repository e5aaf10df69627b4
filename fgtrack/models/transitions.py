"""Transitions of the shipped motion models, compiled: mean, Jacobian F and noise covariance Q of states after a time.

The noise is the definition, Q = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', with the diagonal D of spectral
densities and the Jacobian Phi(t, s) of the flow from the mean at s over t - s.
"""

import math

import numpy as np

from fgtrack.core.compiled import add_product_transposed, inlined, merged, njit, product
from fgtrack.core.types import FloatArray

#: Kinds of motion: constant turn rate and velocity (or acceleration), constant velocity.
ARC, LINE = 0, 1
#: A longer arc is made of parts that turn by so much at most, up to which series and quadrature hold to rounding.
MAX_TURN_RAD = 0.5
#: An arc of more parts has no finite result: a yaw rate that no object has.
MAX_PARTS = 10_000
_LEGENDRE_NODES, _LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(7)
_NODES, _WEIGHTS = 0.5 * (1.0 + _LEGENDRE_NODES), 0.5 * _LEGENDRE_WEIGHTS
# (iw)^k / (k! (k + j + 1)) add up to the integral over [0, 1] of s^j exp(iws): the factors of w^k by j, k % 2, k // 2.
_SERIES = np.array(
    [
        [[(-1.0) ** (k // 2) / (math.factorial(k) * (k + j + 1)) for k in range(odd, 14, 2)] for odd in (0, 1)]
        for j in range(3)
    ]
)


@merged
def _position_gradient(R: float, yaw_rate: float, speed: float, accel: float, gradient: FloatArray) -> None:
    """Write the derivatives (4, 2) of the position by yaw, speed, yaw rate and acceleration a time R before.
    In the frame of the heading at the end: along and left; `speed` is that at the end. With the moments K_j of the
    heading, integrals of s^j exp(i w s) from the end back, these are as complex numbers i (v K_0 - a K_1), K_0,
    i (v (R K_0 - K_1) - a (R K_1 - K_2)), R K_0 - K_1.
    """
    w, scale = -yaw_rate * R, R
    for j in range(3):
        even = odd = 0.0
        for k in range(6, -1, -1):
            even, odd = even * w * w + _SERIES[j, 0, k], odd * w * w + _SERIES[j, 1, k]
        gradient[j, 0], gradient[j, 1] = scale * even, scale * odd * w
        scale *= R
    for i in range(2):
        K0, K1, K2 = gradient[0, i], gradient[1, i], gradient[2, i]
        gradient[0, i], gradient[1, i] = speed * K0 - accel * K1, K0
        gradient[2, i], gradient[3, i] = speed * (R * K0 - K1) - accel * (R * K1 - K2), R * K0 - K1
    for j in range(0, 4, 2):
        gradient[j, 0], gradient[j, 1] = -gradient[j, 1], gradient[j, 0]


@merged
def _short_arc(x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
    """Write mean, F and Q after a turn of at most `MAX_TURN_RAD`."""
    n = len(x)
    accel, q_accel = (x[5], density[5]) if n > 5 else (0.0, 0.0)
    heading, speed = x[2] + x[4] * t, x[3] + accel * t
    c, s = math.cos(heading), math.sin(heading)
    gradient, cross = np.empty((4, 2)), np.zeros((4, 2))  # cross: integral of g D Phi' for each entry from the yaw on
    square = real = imag = 0.0  # integrals of |g|^2 D and of g^2 D
    for node in range(8):
        R, weight = (t * _NODES[node], t * _WEIGHTS[node]) if node < 7 else (t, 0.0)  # the last one is the start
        _position_gradient(R, x[4], speed, accel, gradient)
        for j in range(n - 2):
            along, left, q = gradient[j, 0], gradient[j, 1], density[j + 2] * weight
            square += q * (along * along + left * left)
            real += q * (along * along - left * left)
            imag += 2.0 * q * along * left
            for i in range(2):
                cross[j, i] += q * gradient[j, i]
        for i in range(2):
            cross[0, i] += density[4] * weight * R * gradient[2, i]
            cross[1, i] += q_accel * weight * R * gradient[3, i]
    real, imag = real * (c * c - s * s) - imag * 2.0 * c * s, imag * (c * c - s * s) + real * 2.0 * c * s
    for i in range(n):
        mean[i] = x[i]
        for k in range(n):
            F[i, k] = 1.0 if i == k else 0.0
            Q[i, k] = density[i] * t if i == k else 0.0
    along, left = gradient[0, 1], -gradient[0, 0]
    mean[0], mean[1], mean[2], mean[3] = x[0] + c * along - s * left, x[1] + s * along + c * left, heading, speed
    Q[0, 0] += 0.5 * (square + real)
    Q[1, 1] += 0.5 * (square - real)
    Q[0, 1] = Q[1, 0] = 0.5 * imag
    for j in range(n - 2):
        k = j + 2
        F[0, k] = c * gradient[j, 0] - s * gradient[j, 1]
        F[1, k] = s * gradient[j, 0] + c * gradient[j, 1]
        Q[0, k] = Q[k, 0] = c * cross[j, 0] - s * cross[j, 1]
        Q[1, k] = Q[k, 1] = s * cross[j, 0] + c * cross[j, 1]
    for k in range(2, n - 2):  # the yaw by its rate, the speed by the acceleration
        q = density[k + 2]
        F[k, k + 2] = t
        Q[k, k] += q * t * t * t / 3.0
        Q[k, k + 2] = Q[k + 2, k] = 0.5 * q * t * t


@merged
def _line(x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
    """Write mean, F and Q of constant velocity, state x, y, vx, vy: q [[t^3/3, t^2/2], [t^2/2, t]] on each axis."""
    for i in range(4):
        mean[i] = x[i]
        for k in range(4):
            F[i, k] = 1.0 if i == k else 0.0
            Q[i, k] = density[i] * t if i == k else 0.0
    for i in range(2):
        v, q = i + 2, density[i + 2]
        mean[i] += x[v] * t
        F[i, v] = t
        Q[i, i] += q * t**3 / 3.0
        Q[i, v] = Q[v, i] = q * t**2 / 2.0


@inlined
def transition(
    kind: int, x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray
) -> None:
    """Write mean (n,), F and Q (n, n) of the state x (n,) after t, a long arc part by part."""
    parts, turn = 1, abs(x[4] * t) if kind == ARC else 0.0
    if not turn <= MAX_TURN_RAD:
        if not turn < MAX_TURN_RAD * MAX_PARTS:
            for i in range(len(x)):
                mean[i] = math.nan
                for k in range(len(x)):
                    F[i, k] = Q[i, k] = math.nan
            return
        parts = math.ceil(turn / MAX_TURN_RAD)
        t /= parts
    if kind != ARC:
        _line(x, t, density, mean, F, Q)
        return
    n = len(x)
    before, G, old, GM = np.empty(n), np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    for part in range(parts):
        for i in range(n):
            before[i] = mean[i] if part else x[i]
            for k in range(n):
                old[i, k] = Q[i, k]
        _short_arc(before, t, density, mean, G, Q)
        if part:
            product(G, old, GM)
            add_product_transposed(GM, G, Q)
            product(G, F, GM)
        for i in range(n):
            for k in range(n):
                F[i, k] = GM[i, k] if part else G[i, k]


@njit("(int64, float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1])")
def transitions(
    kind: int, x: FloatArray, dt_s: FloatArray, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray
) -> None:
    """Write mean (m, n), F and Q (m, n, n) of states (m, n) after `dt_s` (m,)."""
    for k in range(len(x)):
        transition(kind, x[k], dt_s[k], density, mean[k], F[k], Q[k])
