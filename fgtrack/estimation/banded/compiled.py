"""Elimination and back-substitution compiled by numba: what `elimination` and `substitution` do in NumPy.

Track by track, node by node, by the same formulas; measurements are fused one row after another.
`pip install fgtrack[fast]` installs numba, without which this module cannot be imported. It is compiled when it is
imported for the first time, in 10 to 20 s, and kept for later processes where numba keeps it (`NUMBA_CACHE_DIR`).
"""

import numpy as np
from numba import njit

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.estimation.banded.elimination import LEAST_SHARE
from fgtrack.estimation.banded.nodes import Nodes

_ORDER = "int64[::1], int64[::1], int64[:, ::1]"  # first, count, numbers
_TABLES = "float64[:, :, ::1]"


class Substitution:
    """Smoothed means and covariances, as `Blocks` finds them, node by node."""

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self._known: IntArray = np.zeros(0, dtype=np.int64)
        """From this place on covariances are known."""
        self.any_far: BoolArray = np.zeros(0, dtype=bool)
        """See `Blocks.any_far`."""

    def begin(self, track: int) -> None:
        """See `Blocks.begin`."""
        more = len(self._nodes.first) - len(self._known)
        if more:
            self._known = np.concatenate([self._known, np.zeros(more, dtype=np.int64)])
            self.any_far = np.concatenate([self.any_far, np.zeros(more, dtype=bool)])
        self._known[track], self.any_far[track] = 0, False

    def cut(self, tracks: IntArray, places: IntArray) -> None:
        """See `Blocks.cut`; here nothing is kept that must be cut."""

    def moved(self, tracks: IntArray, numbers: IntArray) -> None:
        """See `Blocks.moved`."""
        self._known[tracks] += numbers

    def solve_means(self, tracks: IntArray, thresholds: FloatArray, anchored: IntArray) -> None:
        """See `Blocks.solve_means`."""
        nodes = self._nodes
        order = nodes.first, nodes.count, nodes.numbers
        found = nodes.step, nodes.far, self.any_far
        _solve_means(tracks, *order, thresholds, anchored, nodes.filtered, nodes.back, *found)
        self._known[tracks] = nodes.count[tracks]

    def find_far(self, tracks: IntArray, anchored: IntArray) -> tuple[IntArray, IntArray]:
        """See `Blocks.find_far`."""
        nodes = self._nodes
        rows, places = np.empty((2, int((nodes.count - nodes.first)[tracks].sum())), dtype=np.int64)
        num = _find_far(
            tracks, nodes.first, nodes.count, nodes.numbers, anchored, nodes.far, self.any_far, rows, places
        )
        return rows[:num], places[:num]

    def smoothed(self, tracks: IntArray, places: IntArray) -> tuple[FloatArray, FloatArray]:
        """See `Blocks.smoothed`."""
        nodes = self._nodes
        order = nodes.first, nodes.count, nodes.numbers
        steps, covariances = np.empty((len(tracks), nodes.dim)), np.empty((len(tracks), nodes.dim, nodes.dim))
        given = nodes.filtered, nodes.back, nodes.C
        _smoothed(tracks, places, self._known, *order, *given, nodes.step, nodes.P, steps, covariances)
        return steps, covariances

    def steps(self, tracks: IntArray, places: IntArray) -> FloatArray:
        """See `Blocks.steps`."""
        return self._nodes.step[self._nodes.at(tracks, places)]


def eliminate(nodes: Nodes, tracks: IntArray, places: IntArray) -> None:
    """See `elimination.eliminate`."""
    order = nodes.first, nodes.count, nodes.numbers
    given = nodes.segment, nodes.rows
    found = nodes.predicted, nodes.filtered, nodes.back, nodes.C
    if not _eliminate(tracks, places, *order, nodes.origin, *given, nodes.num_rows, *found):
        raise np.linalg.LinAlgError("a state is not finite")


@njit(error_model="numpy")
def _congruence(A: FloatArray, B: FloatArray, product: FloatArray, found: FloatArray) -> None:
    """Add A B A' to the lower triangle of `found`."""
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            value = 0.0
            for k in range(n):
                value += A[i, k] * B[k, j]
            product[i, j] = value
        for j in range(i + 1):
            value = found[i, j]
            for k in range(n):
                value += product[i, k] * A[j, k]
            found[i, j] = value


@njit(error_model="numpy")
def _mirror(lower: FloatArray) -> None:
    """Write the lower triangle above the diagonal."""
    for i in range(lower.shape[0]):
        for j in range(i):
            lower[j, i] = lower[i, j]


@njit(error_model="numpy")
def _solve(matrix: FloatArray, rhs: FloatArray) -> bool:
    """Gaussian elimination with pivots, as LAPACK's gesv; the solution replaces `rhs`. Whether it exists."""
    n = matrix.shape[0]
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if not abs(matrix[pivot, k]) > 0.0:
            return False
        if pivot != k:
            for j in range(n):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
                rhs[k, j], rhs[pivot, j] = rhs[pivot, j], rhs[k, j]
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k + 1, n):
                matrix[i, j] -= factor * matrix[k, j]
            for j in range(n):
                rhs[i, j] -= factor * rhs[k, j]
    for k in range(n - 1, -1, -1):
        for j in range(n):
            value = rhs[k, j]
            for i in range(k + 1, n):
                value -= matrix[k, i] * rhs[i, j]
            rhs[k, j] = value / matrix[k, k]
    return True


@njit(error_model="numpy")
def _predict(left: FloatArray, segment: FloatArray, origin: FloatArray, moved: FloatArray, ahead: FloatArray) -> None:
    """[F P F' + Q | F x + f - x0] to `ahead`, and F P to `moved`."""
    n = len(origin)
    for i in range(n):
        mean = segment[i, 2 * n] - origin[i]
        for j in range(n):
            mean += segment[i, j] * left[j, n]
        ahead[i, n] = mean
        for j in range(i + 1):
            ahead[i, j] = 0.5 * (segment[i, n + j] + segment[j, n + i])
    _congruence(segment[:, :n], left, moved, ahead[:, :n])
    _mirror(ahead[:, :n])


@njit(error_model="numpy")
def _condition(
    left: FloatArray,
    segment: FloatArray,
    ahead: FloatArray,
    gain: FloatArray,
    E: FloatArray,
    product: FloatArray,
    back: FloatArray,
    C: FloatArray,
) -> bool:
    """A = P F' (F P F' + Q)^-1, b, and C = E P E' + A Q A' with E = I - A F; `gain` holds F P. Whether A exists."""
    n = gain.shape[0]
    E[:] = ahead[:, :n]
    if not _solve(E, gain):
        return False
    for i in range(n):
        mean = left[i, n]
        for j in range(n):
            back[i, j] = gain[j, i]
            mean -= gain[j, i] * ahead[j, n]
            value = 1.0 if i == j else 0.0
            for k in range(n):
                value -= gain[k, i] * segment[k, j]
            E[i, j] = value
        back[i, n] = mean
    C[:] = 0.0
    _congruence(E, left, product, C)
    _congruence(back[:, :n], segment[:, n : 2 * n], product, C)
    _mirror(C)
    return True


@njit(error_model="numpy")
def _correct(
    state: FloatArray, row: FloatArray, gain: FloatArray, E: FloatArray, P: FloatArray, product: FloatArray
) -> None:
    """Fuse y = G x + N(0, 1), `row` being [G | y], into `state` [P | x]; precise ones in Joseph's form."""
    n = len(gain)
    S, y = 1.0, row[n]
    for i in range(n):
        gain[i] = 0.0
        for j in range(n):
            gain[i] += state[i, j] * row[j]
        S += row[i] * gain[i]
        y -= row[i] * state[i, n]
    precise = S > 1.0 / LEAST_SHARE
    if precise:
        P[:] = state[:, :n]
    for i in range(n):
        gain[i] /= S
        state[i, n] += gain[i] * y
        for j in range(i + 1):
            state[i, j] -= gain[i] * S * gain[j]
    if precise:
        for i in range(n):
            for j in range(n):
                E[i, j] = (1.0 if i == j else 0.0) - gain[i] * row[j]
                state[i, j] = gain[i] * gain[j]
        _congruence(E, P, product, state[:, :n])
    _mirror(state[:, :n])


@njit(
    f"b1(int64[:], int64[:], {_ORDER}, float64[:, ::1], {_TABLES}, {_TABLES}, int64[::1], {', '.join([_TABLES] * 4)})",
    cache=True,
    error_model="numpy",
)
def _eliminate(
    tracks: IntArray,
    places: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    origin: FloatArray,
    segment: FloatArray,
    rows: FloatArray,
    num_rows: IntArray,
    predicted: FloatArray,
    filtered: FloatArray,
    back: FloatArray,
    C: FloatArray,
) -> bool:
    """See `elimination.eliminate`; whether all is finite."""
    n = origin.shape[1]
    A, E, P, product, gain = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty(n)
    for t in range(len(tracks)):
        track = tracks[t]
        for place in range(places[t], count[track]):
            at = numbers[track, place]
            if place > first[track]:  # else the prior of the oldest node in the window, which follows from nothing
                before = numbers[track, place - 1]
                _predict(filtered[before], segment[before], origin[at], A, predicted[at])
                if not _condition(
                    filtered[before], segment[before], predicted[at], A, E, product, back[before], C[before]
                ):
                    return False
            state = filtered[at]
            state[:] = predicted[at]
            for k in range(num_rows[at]):
                _correct(state, rows[at, k], gain, E, P, product)
            if not np.isfinite(state).all():
                return False
    return True


@njit(
    f"void(int64[:], {_ORDER}, float64[:, ::1], int64[::1], {_TABLES}, {_TABLES}, float64[:, ::1], b1[::1], b1[::1])",
    cache=True,
    error_model="numpy",
)
def _solve_means(
    tracks: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    thresholds: FloatArray,
    anchored: IntArray,
    filtered: FloatArray,
    back: FloatArray,
    step: FloatArray,
    far: BoolArray,
    any_far: BoolArray,
) -> None:
    """Write `step`, `far` and `any_far`; see `Blocks.solve_means`."""
    n = step.shape[1]
    for track in tracks:
        any_far[track] = False
        later = -1
        for place in range(count[track] - 1, first[track] - 1, -1):
            at = numbers[track, place]
            too_long = False
            for i in range(n):
                value = filtered[at, i, n] if later < 0 else back[at, i, n]
                if later >= 0:
                    for j in range(n):
                        value += back[at, i, j] * step[later, j]
                step[at, i] = value
                too_long |= abs(value) > thresholds[track, i]
            far[at] = too_long and place >= first[track] + anchored[track]
            any_far[track] |= far[at]
            later = at


@njit(f"int64(int64[:], {_ORDER}, int64[::1], b1[::1], b1[::1], int64[::1], int64[::1])", cache=True)
def _find_far(
    tracks: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    anchored: IntArray,
    far: BoolArray,
    any_far: BoolArray,
    rows: IntArray,
    places: IntArray,
) -> int:
    """Write `rows` and `places`; how many."""
    num = 0
    for t in range(len(tracks)):
        track = tracks[t]
        if any_far[track]:
            for place in range(first[track] + anchored[track], count[track]):
                if far[numbers[track, place]]:
                    rows[num], places[num] = t, place
                    num += 1
    return num


@njit(
    f"void(int64[:], int64[:], int64[::1], {_ORDER}, {_TABLES}, {_TABLES}, {_TABLES}, float64[:, ::1], {_TABLES},"
    f" float64[:, ::1], {_TABLES})",
    cache=True,
    error_model="numpy",
)
def _smoothed(
    tracks: IntArray,
    places: IntArray,
    known: IntArray,
    first: IntArray,
    count: IntArray,
    numbers: IntArray,
    filtered: FloatArray,
    back: FloatArray,
    C: FloatArray,
    step: FloatArray,
    P: FloatArray,
    steps: FloatArray,
    covariances: FloatArray,
) -> None:
    """Write `steps` and `covariances`, see `Blocks.smoothed`; what is computed on the way stays in `step` and `P`."""
    n = step.shape[1]
    product = np.empty((n, n))
    for t in range(len(tracks)):
        track = tracks[t]
        for place in range(known[track] - 1, places[t] - 1, -1):
            at = numbers[track, place]
            if place == count[track] - 1:
                P[at] = filtered[at, :, :n]
                continue
            later = numbers[track, place + 1]
            P[at] = C[at]
            _congruence(back[at, :, :n], P[later], product, P[at])
            _mirror(P[at])
            if place < first[track]:  # behind the window
                for i in range(n):
                    value = back[at, i, n]
                    for j in range(n):
                        value += back[at, i, j] * step[later, j]
                    step[at, i] = value
        known[track] = min(known[track], places[t])
        at = numbers[track, places[t]]
        steps[t], covariances[t] = step[at], P[at]
