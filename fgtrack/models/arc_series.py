"""The equations of `arc` for many states at once: expanded into polynomials, and these evaluated by matrix products.

The equations are called with `Polynomial`s of duration, speed, acceleration and turn instead of numbers, in the frame
of the last heading. What comes out is linear in few distinct terms, so that many states cost hardly more than one.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from math import factorial
from typing import Any, NamedTuple

import numpy as np

from fgtrack.core.types import ACCEL, SPEED, YAW, YAW_RATE, FloatArray, IntArray
from fgtrack.models.arc import SmallTurn, noise_entries, product_series, way, way_gradient

_NUM_POWERS = 18  # of the turn; the next one is below rounding up to `MAX_SMALL_TURN_RAD`
_Powers = tuple[int, int, int, int]


class Polynomial:
    """Sum of coefficients times powers of duration, speed, acceleration and turn, which are real."""

    def __init__(self, terms: Mapping[_Powers, complex]) -> None:
        self.terms = {powers: c for powers, c in terms.items() if c != 0.0 and powers[3] < _NUM_POWERS}

    @property
    def real(self) -> "Polynomial":
        """Its real part."""
        return Polynomial({powers: complex(c).real for powers, c in self.terms.items()})

    @property
    def imag(self) -> "Polynomial":
        """Its imaginary part."""
        return Polynomial({powers: complex(c).imag for powers, c in self.terms.items()})

    def __add__(self, other: "Polynomial | complex") -> "Polynomial":
        terms = dict(self.terms)
        for powers, c in _polynomial(other).terms.items():
            terms[powers] = terms.get(powers, 0.0) + c
        return Polynomial(terms)

    def __mul__(self, other: "Polynomial | complex") -> "Polynomial":
        terms: dict[_Powers, complex] = {}
        for p, a in self.terms.items():
            for q, b in _polynomial(other).terms.items():
                powers = (p[0] + q[0], p[1] + q[1], p[2] + q[2], p[3] + q[3])
                terms[powers] = terms.get(powers, 0.0) + a * b
        return Polynomial(terms)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> "Polynomial":
        return self * -1.0

    def __sub__(self, other: "Polynomial | complex") -> "Polynomial":
        return self + _polynomial(other) * -1.0

    def __rsub__(self, other: "Polynomial | complex") -> "Polynomial":
        return _polynomial(other) - self

    def __truediv__(self, other: float) -> "Polynomial":
        return self * (1.0 / other)


def _polynomial(value: Polynomial | complex) -> Polynomial:
    return value if isinstance(value, Polynomial) else Polynomial({(0, 0, 0, 0): value})


_T, _SPEED = Polynomial({(1, 0, 0, 0): 1.0}), Polynomial({(0, 1, 0, 0): 1.0})
_ACCEL, _TURN = Polynomial({(0, 0, 1, 0): 1.0}), Polynomial({(0, 0, 0, 1): 1.0})


def _in_turn(coefficients: Iterable[complex], step: int = 1) -> Polynomial:
    """Polynomial in every power of the turn, or every `step`-th."""
    return Polynomial({(0, 0, 0, step * k): c for k, c in enumerate(coefficients)})


class ArcSeries(NamedTuple):
    """What becomes of states of n entries that turn little.

    Every entry is one of `sums` of terms: `polynomials` in the turn, times powers of the others.
    """

    n: int
    polynomials: FloatArray
    """Shape (terms, `_NUM_POWERS`)."""
    of_t: IntArray
    of_speed: IntArray
    of_accel: IntArray
    """Their powers, shape (terms,)."""
    sums: FloatArray
    """Shape (n (2 n + 1), terms)."""

    def __call__(self, x: FloatArray, t: FloatArray, turn: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Means (m, n), F and Q (m, n, n) of the states `x`, (m, n), after the durations `t` and turns `turn`, (m,)."""
        n, m = self.n, len(x)
        values = self.polynomials @ _powers(turn, _NUM_POWERS)
        values *= _powers(t, int(self.of_t[-1]) + 1)[self.of_t]
        values *= _powers(x[:, SPEED], 3)[self.of_speed]
        if n > ACCEL:
            values *= _powers(x[:, ACCEL], 3)[self.of_accel]
        found = np.ascontiguousarray((self.sums @ values).T).reshape(m, n, 2 * n + 1)
        heading = x[:, YAW] + turn
        turned = np.empty((m, 2, 2))
        turned[:, 0, 0] = turned[:, 1, 1] = np.cos(heading)
        turned[:, 1, 0] = sin = np.sin(heading)
        turned[:, 0, 1] = -sin
        found[:, :2] = turned @ found[:, :2]
        found[:, :, n : n + 2] = found[:, :, n : n + 2] @ turned.mT
        found[:, 0, 0] = found[:, 1, 1] = 1.0
        return x + found[..., -1], found[..., :n], found[..., n : 2 * n]


def _powers(values: FloatArray, number: int) -> FloatArray:
    """The powers 0 to `number` - 1 of `values` (m,), shape (`number`, m)."""
    powers = np.empty((number, len(values)))
    powers[0], powers[1:] = 1.0, values
    return np.asarray(np.multiply.accumulate(powers, axis=0, out=powers))


@lru_cache(maxsize=64)
def arc_series(densities: tuple[float, ...], n: int) -> ArcSeries:
    """The series of states of 5 or 6 entries with noise of these densities, see `arc.small_turn_noise`."""
    entries = _entries(densities, n)
    terms: dict[tuple[int, int, int, tuple[float, ...]], dict[int, float]] = {}
    for place, entry in entries.items():
        by_powers: dict[tuple[int, int, int], FloatArray] = {}
        for (i, j, k, power), c in entry.terms.items():
            by_powers.setdefault((i, j, k), np.zeros(_NUM_POWERS))[power] = complex(c).real
        for powers, coefficients in by_powers.items():
            lead = float(coefficients[np.flatnonzero(coefficients)[0]])
            alike = tuple(float(f"{c:.13e}") for c in (coefficients / lead).tolist())
            terms.setdefault((*powers, alike), {})[place] = lead
    ordered = sorted(terms)
    sums = np.zeros((n * (2 * n + 1), len(ordered)))
    for column, key in enumerate(ordered):
        for place, lead in terms[key].items():
            sums[place, column] = lead
    of_t, of_speed, of_accel = (np.array([key[kind] for key in ordered]) for kind in range(3))
    return ArcSeries(n, np.array([key[3] for key in ordered]), of_t, of_speed, of_accel, sums)


def _entries(densities: Sequence[float], n: int) -> dict[int, Polynomial]:
    """Entries of [F | Q | way], row by row, by their places, in the frame of the last heading; but for the
    derivatives of the position by itself.
    """
    accel: Any = _ACCEL if n > ACCEL else None
    drive = (_SPEED,) if accel is None else (_SPEED, accel)
    arc = SmallTurn(_TURN, complex(1.0), (_moment(0), _moment(1), _moment(2), _moment(3), _moment(4)))
    kinds = product_series(accel is not None)
    products = [(_in_turn(even, 2), _in_turn(mixed, 2), _in_turn(odd, 2)) for even, mixed, odd in kinds]
    table: list[list[Any]] = [[0.0] * (2 * n + 1) for _ in range(n)]
    for k in range(YAW, n):
        table[k][k] = 1.0
    for column, derivative in enumerate(way_gradient(arc.moments, *drive), start=YAW):
        table[0][column], table[1][column] = derivative.real, derivative.imag
    table[YAW][YAW_RATE], table[YAW][-1] = _T, _TURN
    if accel is not None:
        table[SPEED][ACCEL], table[SPEED][-1] = _T, accel * _T
    moved = way(arc.moments, 0, *drive)
    table[0][-1], table[1][-1] = moved.real, moved.imag
    noise = noise_entries(arc, _T, densities, products, _SPEED, accel)
    for row in range(n):
        table[row][n : 2 * n] = noise[row * n : (row + 1) * n]
    flat = [_polynomial(entry) for row in table for entry in row]
    return {place: entry for place, entry in enumerate(flat) if entry.terms}


def _moment(order: int) -> Polynomial:
    """m_order over exp(i (yaw + w)): t^(order + 1) times the integral over r in [0, 1] of r^order exp(i w (r - 1))."""
    integral = _in_turn(1j**j / (factorial(j) * (j + order + 1)) for j in range(_NUM_POWERS))
    back = _in_turn((-1j) ** j / factorial(j) for j in range(_NUM_POWERS))
    return integral * back * Polynomial({(order + 1, 0, 0, 0): 1.0})
