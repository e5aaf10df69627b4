"""Compilation of loops by numba, kept on disk where a folder can be written, and loops over small dense matrices.

Calls of NumPy, BLAS and assignments of slices in compiled code take seconds to compile: loops do not.
"""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from fgtrack.core.types import FloatArray

__all__ = ["add_product_transposed", "inlined", "njit", "product", "solve"]


# Any: numba has no types.
def njit(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function once: it is stored in a cache folder, if one can be written."""

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(signature, cache=True, error_model="numpy")(function)
        except RuntimeError:  # no folder to store it in
            return numba.njit(signature, error_model="numpy")(function)

    return compiled


#: Decorator of functions that only compiled ones call.
inlined = numba.njit(error_model="numpy")


@inlined
def product(A: FloatArray, B: FloatArray, found: FloatArray) -> None:
    """Write A B."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            value = 0.0
            for k in range(A.shape[1]):
                value += A[i, k] * B[k, j]
            found[i, j] = value


@inlined
def add_product_transposed(A: FloatArray, B: FloatArray, found: FloatArray) -> None:
    """Add A B', which is symmetric, to `found`: its lower triangle, and the mirror of that."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            value = found[i, j]
            for k in range(A.shape[1]):
                value += A[i, k] * B[j, k]
            found[i, j] = found[j, i] = value


@inlined
def solve(S: FloatArray, columns: FloatArray) -> bool:
    """Overwrite columns by S^-1 columns and S by its Cholesky factor; False unless S is positive definite."""
    n = S.shape[0]
    for i in range(n):
        for j in range(i + 1):
            value = S[i, j]
            for k in range(j):
                value -= S[i, k] * S[j, k]
            if j < i:
                S[i, j] = value / S[j, j]
            elif value > 0.0:
                S[i, i] = np.sqrt(value)
            else:
                return False
    for c in range(columns.shape[1]):
        for i in range(n):
            for k in range(i):
                columns[i, c] -= S[i, k] * columns[k, c]
            columns[i, c] /= S[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                columns[i, c] -= S[k, i] * columns[k, c]
            columns[i, c] /= S[i, i]
    return True
