"""Transitions of the shipped motion models, compiled: mean, Jacobian F and noise covariance Q of states after a time.

The noise is the definition, Q = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', with the diagonal D of spectral
densities and the Jacobian Phi(t, s) of the flow from the mean at s over t - s.
"""

import math

import numpy as np

from fgtrack.core.compiled import add_product_transposed, check, copy, inlined, merged, njit, product, scratch, shared
from fgtrack.core.types import FloatArray

#: Kinds of motion: constant turn rate and velocity (or acceleration), constant velocity.
ARC, LINE = 0, 1
#: A longer arc is made of parts that turn by so much at most, up to which the series hold to rounding.
MAX_TURN_RAD = 0.5
#: An arc of more parts has no finite result: a yaw rate that no object has.
MAX_PARTS = 10_000
_TERMS = 10
# With the moments K_j of the heading, integrals of s^j exp(iws) over s in [0, r], the functions K_0, r K_0 - K_1, K_1,
# r K_1 - K_2, 1 and r are sums over k of c_k (iw)^k r^(k + e), with the factors c and the exponent e of each.
_K = np.arange(2 * _TERMS)
_MOMENTS = 1.0 / np.array([_K + 1, (_K + 1) * (_K + 2), _K + 2, (_K + 2) * (_K + 3)]) / np.cumprod(np.maximum(_K, 1.0))
_FACTORS, _EXPONENTS = np.vstack([_MOMENTS, _K == 0, _K == 0]), (1, 2, 2, 3, 0, 1)


def _columns(factors: FloatArray) -> FloatArray:
    """Factors of w^2k in the real part of a sum of c_k (iw)^k, and in the imaginary part over w, shape (terms, 2)."""
    return np.asarray((factors * np.array([1.0, 1.0, -1.0, -1.0])[_K % 4]).reshape(_TERMS, 2))


def _integral(a: int, b: int, conjugate: float = 1.0) -> FloatArray:
    """`_columns` of the integral over r in [0, 1] of a product; with -1 for b conjugated, of the real part."""
    factors = np.convolve(_FACTORS[a], _FACTORS[b] * conjugate**_K)[_K] / (_K + _EXPONENTS[a] + _EXPONENTS[b] + 1)
    return _columns(factors)[:, : 2 if conjugate > 0.0 else 1]


def _linear(a: int) -> list[FloatArray]:
    """Values at 1 and integrals of functions a and a + 1, and the integral of r times the latter: ten columns."""
    return [_columns(_FACTORS[a]), _columns(_FACTORS[a + 1]), _integral(a, 4), _integral(a + 1, 4), _integral(a + 1, 5)]


def _quadratic(a: int, b: int) -> list[FloatArray]:
    """Integrals of the products a b and (a + 1) (b + 1), and of those with conjugates: six columns."""
    return [_integral(a, b), _integral(a + 1, b + 1), _integral(a, b, -1.0), _integral(a + 1, b + 1, -1.0)]


# At constant speed the first 16 suffice.
_SERIES = np.hstack([*_linear(0), *_quadratic(0, 0), *_linear(2), *_quadratic(0, 2), *_quadratic(2, 2)])


@inlined
def _turned(right: float, up: float, moments: FloatArray, p: int) -> tuple[float, float]:
    """Product of complex numbers."""
    real, imag = moments[p, 0], moments[p, 1]
    return right * real - up * imag, right * imag + up * real


_TYPES = f"float64[::1], float64, {'float64[::1], ' * 2}float64[:, ::1], float64[:, ::1]"


@shared(f"void({_TYPES})")
def _short_arc(x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray) -> None:
    """Write mean, F and Q after a turn of at most `MAX_TURN_RAD`.
    As complex numbers, along and left of the heading at the end, where the speed is v, the position depends on yaw,
    speed, yaw rate and acceleration a time R before by i (v K_0 - a K_1), K_0, i (v (R K_0 - K_1) - a (R K_1 - K_2)),
    R K_0 - K_1. `unit` has the series of these moments, from the end back; `scaled` those for the yaw and its rate.
    """
    n = len(x)
    accel, q_accel = (x[5], density[5] * t) if n > 5 else (0.0, 0.0)
    q_yaw, q_speed, q_rate = density[2] * t, density[3] * t, density[4] * t
    w, v, a = -x[4] * t, x[3] + accel * t, accel * t
    unit, scaled, moments, used = scratch(38), scratch(16), scratch(2, 8, 2), 16 if n == 5 else 38
    for p in range(38):
        unit[p] = 0.0
    for k in range(_TERMS - 1, -1, -1):
        for p in range(used):
            unit[p] = unit[p] * (w * w) + _SERIES[k, p]
    for p in range(16):
        scaled[p] = v * unit[p] - a * unit[p + 16]
        if p >= 10:
            scaled[p] = v * v * unit[p] - 2.0 * v * a * unit[p + 16] + a * a * unit[p + 22]
    for p in range(7):
        moments[0, p, 0], moments[0, p, 1] = scaled[2 * p], scaled[2 * p + 1] * w
        moments[1, p, 0], moments[1, p, 1] = unit[2 * p], unit[2 * p + 1] * w
    for j in range(n):
        mean[j] = x[j]
        for k in range(n):
            F[j, k] = 1.0 if j == k else 0.0
            Q[j, k] = density[j] * t if j == k else 0.0
    mean[2], mean[3] = x[2] + x[4] * t, v
    c, s = math.cos(mean[2]), math.sin(mean[2])
    right, up = _turned(c * t, s * t, moments[0], 0)
    size = q_yaw * scaled[14] + q_speed * unit[14] + t * t * (q_rate * scaled[15] + q_accel * unit[15])
    for j in range(2):
        moments[1, 7, j] = q_speed * moments[1, 5, j] - q_yaw * moments[0, 5, j]
        moments[1, 7, j] += t * t * (q_accel * moments[1, 6, j] - q_rate * moments[0, 6, j])
    mean[0], mean[1] = x[0] + right, x[1] + up
    right, up = _turned(c * c - s * s, c * s + s * c, moments[1], 7)
    Q[0, 0] += 0.5 * t * t * (size + right)
    Q[1, 1] += 0.5 * t * t * (size - right)
    Q[0, 1] = Q[1, 0] = 0.5 * t * t * up
    for k in range(2, n):  # yaw and speed, and then their rates, of which the second is the acceleration
        of, q, rate = moments[k % 2], density[k] * t, 1 if k > 3 else 0
        right, up = (-s * t, c * t) if k % 2 == 0 else (c * t, s * t)
        if rate:
            right, up = right * t, up * t
        F[0, k], F[1, k] = _turned(right, up, of, rate)
        Q[0, k], Q[1, k] = _turned(right * q, up * q, of, 2 + rate)
        if not rate and k + 2 < n:
            q = density[k + 2] * t
            right, up = _turned(right * q * t * t, up * q * t * t, of, 4)
            Q[0, k], Q[1, k] = Q[0, k] + right, Q[1, k] + up
        Q[k, 0], Q[k, 1] = Q[0, k], Q[1, k]
        if k > 3:  # the yaw by its rate, the speed by the acceleration
            F[k - 2, k] = t
            Q[k - 2, k - 2] += density[k] * t * t * t / 3.0
            Q[k - 2, k] = Q[k, k - 2] = 0.5 * density[k] * t * t


@merged
def _arc(
    x: FloatArray, t: float, parts: int, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray
) -> None:
    """Write mean, F and Q after so many short arcs of t each."""
    n = len(x)
    before, G, old, GM = scratch(n), scratch(n, n), scratch(n, n), scratch(n, n)
    for part in range(parts):
        for j in range(n if part else 0):
            before[j] = mean[j]
        if part:
            copy(Q, old)
        _short_arc(before if part else x, t, density, mean, G if part else F, Q)
        if part:
            product(G, old, GM)
            add_product_transposed(GM, G, Q)
            product(G, F, GM)
            copy(GM, F)


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
        Q[i, i] += q * (t * t * t) / 3.0
        Q[i, v] = Q[v, i] = q * (t * t) / 2.0


@shared(f"void(int64, {_TYPES})")
def transition(
    kind: int, x: FloatArray, t: float, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray
) -> None:
    """Write mean (n,), F and Q (n, n) of the state x (n,) after t."""
    turn = abs(x[4] * t) if kind == ARC else 0.0
    if kind != ARC:
        _line(x, t, density, mean, F, Q)
    elif turn < MAX_TURN_RAD * MAX_PARTS:
        parts = max(math.ceil(turn / MAX_TURN_RAD), 1)
        _arc(x, t / parts, parts, density, mean, F, Q)
    else:
        for i in range(len(x)):
            mean[i] = math.nan
            for k in range(len(x)):
                F[i, k] = Q[i, k] = math.nan


@njit(
    "void(int64, float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1])"
)
def transitions(
    kind: int, x: FloatArray, dt_s: FloatArray, density: FloatArray, mean: FloatArray, F: FloatArray, Q: FloatArray
) -> None:
    """Write mean (m, n), F and Q (m, n, n) of states (m, n) after `dt_s` (m,)."""
    n = x.shape[1]
    check(min(len(dt_s), len(mean), len(F), len(Q)) >= len(x) and len(density) >= n and mean.shape[1] == n)
    check(F.shape[1] == n and F.shape[2] == n and Q.shape[1] == n and Q.shape[2] == n)
    for k in range(len(x)):
        transition(kind, x[k], dt_s[k], density, mean[k], F[k], Q[k])
