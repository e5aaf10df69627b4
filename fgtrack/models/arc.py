"""The arc of a constant turn rate: heading moments, the way along it, and the noise accumulated on it.

A point of the plane is the complex number x + i y. The heading moments are m_k = integral over s in [0, t] of
s^k exp(i (yaw + yaw_rate s)); displacement and derivatives are sums of them, for one state and for arrays alike. The
moments are evaluated in two ways: of arrays of states, and of one state that turns little, which needs no array;
`arc_series` expands the latter for many states.
"""

import cmath
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from scipy import special

from fgtrack.core.types import YAW, YAW_RATE, FloatArray

ComplexArray = npt.NDArray[np.complex128]
Complex = TypeVar("Complex", complex, ComplexArray)

#: The series of one state hold to rounding up to this turn.
MAX_SMALL_TURN_RAD = 0.5

# Gauss-Legendre rule on [0, 1].
_LEGENDRE_NODES, _LEGENDRE_WEIGHTS = np.polynomial.legendre.leggauss(12)
NODES: FloatArray = 0.5 * (1.0 + _LEGENDRE_NODES)
WEIGHTS: FloatArray = 0.5 * _LEGENDRE_WEIGHTS
_ORDERS = np.arange(3)
_MOMENT_WEIGHTS: FloatArray = WEIGHTS[:, None] * NODES[:, None] ** _ORDERS
_MAX_QUADRATURE_TURN_RAD = 4.0


def heading_moments(x: FloatArray, t: FloatArray) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """m_0, m_1 and m_2, each of shape (...), of the states `x`, shape (..., n), over the durations `t`.

    The real part belongs to x, the imaginary part to y. A turn w of up to 4 rad is integrated by quadrature:
    exact to rounding, and smooth through yaw rate 0, where the closed form would divide. Beyond, by parts:
    on [0, 1] the moments are E_0 = (exp(i w) - 1) / (i w) and E_k = (exp(i w) - k E_(k-1)) / (i w).
    """
    turn = np.asarray(x[..., YAW_RATE] * t)
    moments = np.exp(1j * turn[..., None] * NODES) @ _MOMENT_WEIGHTS
    large = np.abs(turn) > _MAX_QUADRATURE_TURN_RAD
    if large.any():
        iw = 1j * turn[large]
        end = np.exp(iw)
        e0 = (end - 1.0) / iw
        e1 = (end - e0) / iw
        moments[large] = np.stack([e0, e1, (end - 2.0 * e1) / iw], axis=-1)
    moments = np.exp(1j * x[..., YAW])[..., None] * moments * t[..., None] ** (_ORDERS + 1)
    return moments[..., 0], moments[..., 1], moments[..., 2]


class SmallTurn(NamedTuple):
    """Heading moments of one state that turns little; numbers, or what calculates like them."""

    turn: Any
    end: Any
    """exp(i yaw) after the turn."""
    moments: tuple[Any, Any, Any, Any, Any]
    """m_0 to m_4."""


def small_turn(yaw: float, yaw_rate: float, t: float) -> SmallTurn | None:
    """Moments of one state, exact to rounding; None beyond `MAX_SMALL_TURN_RAD` and where the yaw is not finite.

    E_4 is the series of (i w)^n / (n! (n + 5)); from there by parts downwards, E_(k-1) = (exp(i w) - i w E_k) / k,
    which damps errors.
    """
    turn = yaw_rate * t
    if not (-MAX_SMALL_TURN_RAD <= turn <= MAX_SMALL_TURN_RAD and -math.inf < yaw < math.inf):
        return None
    square = turn * turn
    e4 = complex(_horner(_E4_EVEN, square), turn * _horner(_E4_ODD, square))
    iw, bend, start = complex(0.0, turn), cmath.rect(1.0, turn), cmath.rect(1.0, yaw)
    e3 = (bend - iw * e4) / 4.0
    e2 = (bend - iw * e3) / 3.0
    e1 = (bend - iw * e2) / 2.0
    e0 = bend - iw * e1
    t0 = t * start
    t1 = t * t0
    t2 = t * t1
    t3 = t * t2
    return SmallTurn(turn, start * bend, (t0 * e0, t1 * e1, t2 * e2, t3 * e3, t * t3 * e4))


def way(moments: Sequence[Complex], order: int, speed: Any, accel: Any = None) -> Complex:
    """Integral over s in [0, t] of s^order (speed + accel s) exp(i (yaw + yaw_rate s)); order 0 is the displacement.

    Any: numbers with the moments of one state, arrays with those of many. Without `accel` the speed is constant.
    """
    constant: Complex = moments[order] * speed
    if accel is None:
        return constant
    growing: Complex = moments[order + 1] * accel
    return constant + growing


def way_gradient(moments: Sequence[Complex], speed: Any, accel: Any = None) -> tuple[Complex, ...]:
    """Derivatives of the displacement by yaw, speed, yaw rate and, where there is one, acceleration."""
    by_yaw, by_yaw_rate = 1j * way(moments, 0, speed, accel), 1j * way(moments, 1, speed, accel)
    if accel is None:
        return by_yaw, moments[0], by_yaw_rate
    return by_yaw, moments[0], by_yaw_rate, moments[1]


class _Product(NamedTuple):
    """Integrals over R in [0, 1] of products of two kernels c + i s and C + i S: polynomials in w^2.

    The sign of `mixed` is that of going back from the end: the heading turns the other way.
    """

    even: tuple[float, ...]
    """Of c C."""
    mixed: tuple[float, ...]
    """Of -(c S + s C) / (2 w)."""
    odd: tuple[float, ...]
    """Of s S / w^2."""


def small_turn_noise(
    arc: SmallTurn, t: float, densities: Sequence[float], speed: float, accel: float | None = None
) -> FloatArray:
    """Covariance Q of the noise accumulated on the arc, in x, y, yaw, speed, yaw rate and, if any, acceleration.

    Q = integral over s in [0, t] of Phi(t, s) D Phi(t, s)', exact to rounding, shape (5, 5) or (6, 6). The diagonal D
    has the `densities` of position (each axis), yaw, speed, yaw rate and acceleration. What the position p shares with
    another entry is a sum of heading moments; its own block, of products of two of them (see `_PRODUCTS`).
    """
    y = arc.turn * arc.turn
    kinds = _CONSTANT_SPEED if accel is None else _PRODUCTS
    products = [(_horner(even, y), _horner(mixed, y), _horner(odd, y)) for even, mixed, odd in kinds]
    entries = noise_entries(arc, t, densities, products, speed, accel)
    n = 5 if accel is None else 6
    return np.array(entries).reshape(n, n)


def noise_entries(
    arc: SmallTurn, t: Any, densities: Sequence[float], products: Sequence[tuple[Any, Any, Any]], speed: Any, accel: Any
) -> tuple[Any, ...]:
    """All entries of Q, row by row, from the values of the `products`: numbers, or whatever calculates like them."""
    turn, end, moments = arc
    q_position, q_yaw, q_speed, q_rate, q_accel = densities
    t2 = t * t
    t3 = t2 * t
    yaw3, rate5 = q_yaw * t3, q_rate * t2 * t3
    way1, way2, way3 = way(moments, 1, speed, accel), way(moments, 2, speed, accel), way(moments, 3, speed, accel)
    p_yaw = 1j * (q_yaw * way1 + q_rate * (0.5 * t * way2 - way3 / 6.0))
    p_rate = 0.5j * q_rate * way2
    p_speed = q_speed * moments[1]
    speed_speed = q_speed * t
    along: tuple[Any, ...] = (q_speed * t3, 0.0)
    across: tuple[Any, ...] = (yaw3 * (speed * speed), rate5 * (speed * speed))
    if accel is not None:
        last, back = speed + accel * t, -accel * t  # at the end, and from there back to the start
        of_yaw = (yaw3 * last * last, 2.0 * yaw3 * last * back, yaw3 * back * back)
        of_rate = (rate5 * last * last, 2.0 * rate5 * last * back, rate5 * back * back)
        across = of_yaw + of_rate
        along = (q_speed * t3, 0.0, 0.0, q_accel * t2 * t3, 0.0, 0.0)
        speed_speed += q_accel * t3 / 3.0
        p_speed += q_accel * (0.5 * t * moments[2] - moments[3] / 6.0)
    xx, xy, yy = _position_block(products, along, across, turn, end)
    yaw_yaw, yaw_rate, rate_rate = q_yaw * t + q_rate * t3 / 3.0, 0.5 * q_rate * t2, q_rate * t
    white = q_position * t
    x_row = xx + white, xy, p_yaw.real, p_speed.real, p_rate.real
    y_row = xy, yy + white, p_yaw.imag, p_speed.imag, p_rate.imag
    yaw_row = p_yaw.real, p_yaw.imag, yaw_yaw, 0.0, yaw_rate
    speed_row = p_speed.real, p_speed.imag, 0.0, speed_speed, 0.0
    rate_row = p_rate.real, p_rate.imag, yaw_rate, 0.0, rate_rate
    if accel is None:
        return (*x_row, *y_row, *yaw_row, *speed_row, *rate_row)
    p_accel, speed_accel = 0.5 * q_accel * moments[2], 0.5 * q_accel * t2
    body = *x_row, p_accel.real, *y_row, p_accel.imag, *yaw_row, 0.0, *speed_row, speed_accel, *rate_row, 0.0
    return (*body, p_accel.real, p_accel.imag, 0.0, speed_accel, 0.0, q_accel * t)


def _position_block(
    products: Sequence[tuple[Any, Any, Any]], along: Sequence[Any], across: Sequence[Any], turn: Any, end: Any
) -> tuple[Any, Any, Any]:
    """Covariance of x and x, x and y, y and y: the `products`, weighted by what drives them.

    In the frame of the last heading, what moves the position `along` the heading (speed, acceleration) enters as it is,
    what moves it `across` (yaw, yaw rate) a quarter turn to the left.
    """
    y = turn * turn
    aa = ac = cc = 0.0
    for a, c, (e, mixed, odd) in zip(along, across, products, strict=True):
        o = y * odd
        aa += a * e + c * o
        ac += (a - c) * mixed
        cc += a * o + c * e
    ac *= turn
    u, v = end.real, end.imag
    uu, uv, vv = u * u, u * v, v * v
    return uu * aa - 2.0 * uv * ac + vv * cc, uv * (aa - cc) + (uu - vv) * ac, vv * aa + 2.0 * uv * ac + uu * cc


def product_series(growing: bool) -> Sequence[tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]]:
    """Coefficients of the products of kernels in w^2, as `noise_entries` wants their values; `growing` with those of an
    acceleration.
    """
    return _PRODUCTS if growing else _CONSTANT_SPEED


def _horner(c: tuple[float, ...], y: float) -> float:
    c0, c1, c2, c3, c4, c5, c6, c7, c8 = c
    return c0 + y * (c1 + y * (c2 + y * (c3 + y * (c4 + y * (c5 + y * (c6 + y * (c7 + y * c8)))))))


def _kernel(order: int, ramp: int) -> tuple[FloatArray, FloatArray]:
    """Series in w of the integral over r in [0, R] of (R - r)^ramp r^order exp(i w r), ramp 0 or 1.

    Coefficients of w^(2 k) R^(2 k + order + ramp + 1) of the real part, and of w^(2 k + 1) R^(2 k + order + ramp + 2)
    of the imaginary part.
    """
    j = np.arange(2 * _NUM_POWERS)
    powers = j + order + 1.0
    series = (-1.0) ** (j // 2) / (special.factorial(j) * powers * (powers + 1.0 if ramp else 1.0))
    return series[0::2], series[1::2]


def _product(first: int, second: int, ramp: int) -> _Product:
    (c, s), (C, S) = _kernel(first, ramp), _kernel(second, ramp)
    even, mixed, odd = (np.convolve(*pair)[:_NUM_POWERS] for pair in ((c, C), (c, S), (s, S)))
    mixed = -0.5 * (mixed + np.convolve(s, C)[:_NUM_POWERS])
    powers = 2.0 * np.arange(_NUM_POWERS) + first + second + 2.0 * ramp + 3.0
    return _Product(*(tuple((part / (powers + k)).tolist()) for k, part in enumerate((even, mixed, odd))))


_NUM_POWERS = 9  # of w^2; the next term is below 1e-17 of the first up to MAX_SMALL_TURN_RAD
_E4_EVEN, _E4_ODD = (tuple(half.tolist()) for half in _kernel(4, 0))

# A kernel is the way that remains at the time R before the end, per unit of error there: without ramp of an error in
# yaw or speed, with ramp of one in their rates. Order 1 is the part that an acceleration adds.
_PRODUCTS = [_product(first, second, ramp) for ramp in (0, 1) for first, second in ((0, 0), (0, 1), (1, 1))]
_CONSTANT_SPEED = [_PRODUCTS[0], _PRODUCTS[3]]
