"""Compilation of loops by numba, kept on disk where a folder can be written, and loops over small dense matrices.

Calls of NumPy, BLAS and assignments of slices in compiled code take seconds to compile: loops do not.
"""

import logging
import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from fgtrack.core.types import FloatArray

_LOG = logging.getLogger(__name__)
_said = set[str]()


def _say(text: str) -> None:
    if text not in _said:
        _said.add(text)
        _LOG.warning(text)


# Any: numba has no types.
def njit(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function once: it is stored in a cache folder, if one can be written.
    One line of the log says that loops are compiled, another one that they cannot be stored.
    """

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            result = numba.njit(signature, cache=True, error_model="numpy")(function)
        except RuntimeError:
            _say("compiled loops cannot be stored, so every start compiles them: let NUMBA_CACHE_DIR name a folder")
            return numba.njit(signature, error_model="numpy")(function)
        if result.stats.cache_misses:
            _say("compiling numerical loops, once: some 40 s of processor time for all")
        return result

    return compiled


#: Decorator of functions that only compiled ones call.
inlined = numba.njit(error_model="numpy")
#: Decorator of those with one caller, which are compiled as a part of it: alone they would be compiled twice.
merged = numba.njit(error_model="numpy", inline="always")


@inlined
def copy(source: FloatArray, out: FloatArray) -> None:
    """Fill the matrix `out` from the first rows and columns of `source`."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = source[i, j]


@inlined
def product(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Write A B; columns beyond those that meet are ignored."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            value = 0.0
            for k in range(min(A.shape[1], B.shape[0])):
                value += A[i, k] * B[k, j]
            out[i, j] = value


@inlined
def add_product_transposed(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Add A B', which is symmetric, to `out`: its lower triangle, and the mirror of that."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            value = out[i, j]
            for k in range(A.shape[1]):
                value += A[i, k] * B[j, k]
            out[i, j] = out[j, i] = value


@inlined
def add_congruence(A: FloatArray, P: FloatArray, AP: FloatArray, out: FloatArray) -> None:
    """Add A P A' to `out`, and write A P."""
    product(A, P, AP)
    add_product_transposed(AP, A, out)


@inlined
def add_weighted(K: FloatArray, R: FloatArray, KR: FloatArray, out: FloatArray) -> None:
    """Add K' R K of K (k, n) and the first k rows and columns of R, which is symmetric, to `out`; K' R is written."""
    k, n = K.shape
    for a in range(n):
        for c in range(k):
            value = 0.0
            for d in range(k):
                value += K[d, a] * R[d, c]
            KR[a, c] = value
        for b in range(a + 1):
            value = out[a, b]
            for c in range(k):
                value += KR[a, c] * K[c, b]
            out[a, b] = out[b, a] = value


@inlined
def cholesky(S: FloatArray, n: int, L: FloatArray) -> bool:
    """Write the lower Cholesky factor of the first n rows and columns to L, which may be S; False if there is none."""
    for i in range(n):
        for j in range(i + 1):
            value = S[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            if j < i:
                L[i, j] = value / L[j, j]
            elif value > 0.0:
                L[i, i] = np.sqrt(value)
            else:
                return False
    return True


@inlined
def solve(S: FloatArray, columns: FloatArray) -> bool:
    """Overwrite columns (n, m) by S^-1 columns, and the first n rows and columns of S by their Cholesky factor.
    False unless they are positive definite.
    """
    n = len(columns)
    if not cholesky(S, n, S):
        return False
    for i in range(n):
        for k in range(i):
            for c in range(columns.shape[1]):
                columns[i, c] -= S[i, k] * columns[k, c]
        for c in range(columns.shape[1]):
            columns[i, c] /= S[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            for c in range(columns.shape[1]):
                columns[i, c] -= S[k, i] * columns[k, c]
        for c in range(columns.shape[1]):
            columns[i, c] /= S[i, i]
    return True


@inlined
def whiten(S: FloatArray, y: FloatArray) -> float:
    """Overwrite y (n,) by L^-1 y, and S by its Cholesky factor L; return y' S^-1 y, NaN where there is no root."""
    total = 0.0
    if not cholesky(S, len(y), S):
        return np.nan
    for i in range(len(y)):
        for k in range(i):
            y[i] -= S[i, k] * y[k]
        y[i] /= S[i, i]
        total += y[i] * y[i]
    return total


@inlined
def wrapped(angle_rad: float) -> float:
    """Return the angle in (-pi, pi], unchanged where it lies there."""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    turned = math.pi - np.mod(math.pi - angle_rad, 2.0 * math.pi)
    return math.pi if turned <= -math.pi else turned
