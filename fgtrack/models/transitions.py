"""Transitions of the shipped motion models, compiled: mean, Jacobian F and noise covariance Q of states after a time.

The noise is the definition, Q = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', with the diagonal D of spectral
densities and the Jacobian Phi(t, s) of the flow from the mean at s over t - s. Points of the plane are complex numbers
x + i y.
"""

import math

import numpy as np
import numpy.typing as npt

from fgtrack.core.compiled import inlined, njit
from fgtrack.core.types import FloatArray

ComplexArray = npt.NDArray[np.complex128]

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
_SIGNATURE = "(float64[:, ::1], float64[::1], float64[::1])"


@inlined
def _mean_moment(j: int, w: float) -> complex:
    """Integral over s in [0, 1] of s^j exp(i w s)."""
    even = odd = 0.0
    square = w * w
    for k in range(6, -1, -1):
        even, odd = even * square + _SERIES[j, 0, k], odd * square + _SERIES[j, 1, k]
    return complex(even, w * odd)


@inlined
def _position_gradient(R: float, yaw_rate: float, speed: float, accel: float, gradient: ComplexArray) -> None:
    """Write the derivatives of the position by yaw, speed, yaw rate and acceleration a time R before.

    In the frame of the heading at the end: along + i left; `speed` is that at the end. With the moments K_j of the
    heading, from the end back, these are i (v K_0 - a K_1), K_0, i (v (R K_0 - K_1) - a (R K_1 - K_2)), R K_0 - K_1.
    """
    w = -yaw_rate * R
    K0, K1, K2 = R * _mean_moment(0, w), R * R * _mean_moment(1, w), R * R * R * _mean_moment(2, w)
    by_yaw, by_yaw_rate = speed * K0 - accel * K1, speed * (R * K0 - K1) - accel * (R * K1 - K2)
    gradient[0] = complex(-by_yaw.imag, by_yaw.real)
    gradient[1] = K0
    gradient[2] = complex(-by_yaw_rate.imag, by_yaw_rate.real)
    gradient[3] = R * K0 - K1


@inlined
def _short_arc(x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
    """Write mean, F and Q after a turn of at most `MAX_TURN_RAD`."""
    n = x.shape[0]
    accel = x[5] if n > 5 else 0.0
    q_rate, q_accel = density[4], density[5] if n > 5 else 0.0
    heading, speed = x[2] + x[4] * t, x[3] + accel * t
    end = complex(math.cos(heading), math.sin(heading))
    gradient = np.empty(4, np.complex128)
    cross = np.zeros(4, np.complex128)  # integral of g D Phi' for each entry from the yaw on
    square, squared = 0.0, 0j  # integrals of |g|^2 D and of g^2 D
    for node in range(len(_NODES)):
        R, weight = t * _NODES[node], t * _WEIGHTS[node]
        _position_gradient(R, x[4], speed, accel, gradient)
        for j in range(n - 2):
            g, q = gradient[j], density[j + 2] * weight
            square += q * (g.real * g.real + g.imag * g.imag)
            squared += q * (g * g)
            cross[j] += q * g
        cross[0] += q_rate * weight * R * gradient[2]
        cross[1] += q_accel * weight * R * gradient[3]
    squared *= end * end
    _position_gradient(t, x[4], speed, accel, gradient)
    moved = -1j * end * gradient[0]
    mean[:], F[:], Q[:] = x, 0.0, 0.0
    mean[0], mean[1], mean[2], mean[3] = x[0] + moved.real, x[1] + moved.imag, heading, speed
    Q[0, 0] = density[0] * t + 0.5 * (square + squared.real)
    Q[1, 1] = density[1] * t + 0.5 * (square - squared.real)
    Q[0, 1] = Q[1, 0] = 0.5 * squared.imag
    F[0, 0] = F[1, 1] = 1.0
    for j in range(n - 2):
        k, g, c = j + 2, end * gradient[j], end * cross[j]
        F[0, k], F[1, k], F[k, k] = g.real, g.imag, 1.0
        Q[0, k], Q[1, k], Q[k, k] = c.real, c.imag, density[k] * t
        Q[k, 0], Q[k, 1] = c.real, c.imag
    F[2, 4] = t
    Q[2, 2] += q_rate * t * t * t / 3.0
    Q[2, 4] = Q[4, 2] = 0.5 * q_rate * t * t
    if n > 5:
        F[3, 5] = t
        Q[3, 3] += q_accel * t * t * t / 3.0
        Q[3, 5] = Q[5, 3] = 0.5 * q_accel * t * t


@inlined
def _arc(x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
    """Write mean, F and Q of constant turn rate and acceleration, part by part."""
    turn = abs(x[4] * t)
    if not turn > MAX_TURN_RAD:
        _short_arc(x, t, density, mean, F, Q)
        return
    if not turn < MAX_TURN_RAD * MAX_PARTS:
        mean[:], F[:], Q[:] = np.nan, np.nan, np.nan
        return
    parts = math.ceil(turn / MAX_TURN_RAD)
    after, G, more = mean.copy(), F.copy(), Q.copy()
    _short_arc(x, t / parts, density, mean, F, Q)
    for _ in range(1, parts):
        _short_arc(mean, t / parts, density, after, G, more)
        both = G @ Q @ G.T + more
        mean[:], F[:], Q[:] = after, G @ F, 0.5 * (both + both.T)


@njit(_SIGNATURE)
def arcs(x: FloatArray, dt_s: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (m, n), F and Q (m, n, n) of states of x, y, yaw, speed, yaw rate and, where n is 6, acceleration."""
    m, n = x.shape
    mean, F, Q = np.empty((m, n)), np.empty((m, n, n)), np.empty((m, n, n))
    for k in range(m):
        _arc(x[k], dt_s[k], density, mean[k], F[k], Q[k])
    return mean, F, Q


@njit(_SIGNATURE)
def lines(x: FloatArray, dt_s: FloatArray, density: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean (m, 4), F and Q (m, 4, 4) of states of x, y and velocity: q [[t^3/3, t^2/2], [t^2/2, t]] on each axis."""
    m = len(x)
    mean, F, Q = x.copy(), np.zeros((m, 4, 4)), np.zeros((m, 4, 4))
    for k in range(m):
        t = dt_s[k]
        for i in range(2):
            v, q = i + 2, density[i + 2]
            mean[k, i] += x[k, v] * t
            F[k, i, i] = F[k, v, v] = 1.0
            F[k, i, v] = t
            Q[k, i, i], Q[k, v, v] = q * t**3 / 3.0, q * t
            Q[k, i, v] = Q[k, v, i] = q * t**2 / 2.0
    return mean, F, Q
