"""Small dense linear algebra on stacks of symmetric matrices."""

from collections.abc import Hashable, Sequence
from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.types import FloatArray, IntArray


@cache
def kernels(name: str) -> ModuleType:
    """Return the module `name` of compiled loops, which is not imported before it is needed: numba is large."""
    return import_module(name)


@cache
def _lapack() -> ModuleType:
    """LAPACK of SciPy, which is large, too."""
    return import_module("scipy.linalg.lapack")


@cache
def identity(n: int) -> FloatArray:
    """The identity matrix, shape (n, n); one shared read-only array for each `n`."""
    matrix = np.eye(n)
    matrix.flags.writeable = False
    return matrix


def equal_ones(items: Sequence[Hashable]) -> list[list[int]]:
    """Indices of equal `items`, which are calculated as one stack: ascending, in the order of the first of each."""
    groups: dict[Hashable, list[int]] = {}
    for index, item in enumerate(items):
        groups.setdefault(item, []).append(index)
    return list(groups.values())


def stacked(matrices: FloatArray) -> FloatArray:
    """Return matrices (m, k, n), of one (k, n) a stack of 1, with rows that follow one another in memory."""
    return np.ascontiguousarray(matrices if matrices.ndim == 3 else matrices[None])


def symmetrise(matrix: FloatArray) -> FloatArray:
    """Symmetric part of `matrix`, shape (..., n, n)."""
    both: FloatArray = matrix + matrix.T if matrix.ndim == 2 else matrix + matrix.mT
    both *= 0.5
    return both


#: Of the standard deviations' product: what rounding a covariance to single precision may leave.
ASYMMETRY = 1e-6


def is_covariance(P: FloatArray, least: float) -> bool:
    """True if `P` (n, n) is finite and symmetric, and its correlations, with 1 for a variance of 0, exceed `least`."""
    variances = np.diag(P)
    if not (np.abs(P) <= LARGEST**2).all() or (variances < 0.0).any():
        return False
    scale = np.sqrt(np.where(variances > 0.0, variances, 1.0))
    correlation = P / np.outer(scale, scale)
    try:
        np.linalg.cholesky(correlation - least * identity(len(P)))
    except np.linalg.LinAlgError:
        return False
    return bool((np.abs(correlation - correlation.T) <= ASYMMETRY).all())


def congruence(F: FloatArray, P: FloatArray) -> FloatArray:
    """F P F', shapes (..., m, n) and (..., n, n)."""
    if F.ndim == P.ndim == 2:
        return np.asarray(F.dot(P).dot(F.T))
    return (
        F @ P @ np.ascontiguousarray(F.mT)
    )  # with a copy of F', at half of the time that the view takes


def applied(A: FloatArray, x: FloatArray) -> FloatArray:
    """A x of matrices (..., m, n) and vectors (..., n), shape (..., m)."""
    return A.dot(x) if A.ndim == 2 else np.asarray(np.vecdot(A, x[..., None, :]))


def psd_solve(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve `matrix @ x = rhs` for a symmetric positive definite `matrix`, shapes (..., n, n) and (..., n, k).
    With one matrix, `rhs` may be a vector (n,). Raises `numpy.linalg.LinAlgError` when `matrix` is singular.
    """
    if matrix.ndim > 2:
        return np.asarray(np.linalg.solve(matrix, rhs))
    _, _, solution, info = _lapack().dgesv(
        matrix, rhs
    )  # the same routine at a third of the time
    if info:
        raise np.linalg.LinAlgError("singular matrix")
    return np.asarray(solution)


def mahalanobis_squared(
    residual: FloatArray, covariance: FloatArray, entries: IntArray | None = None
) -> FloatArray:
    """Squared Mahalanobis distance y' S^-1 y, (..., n) and (..., n, n), of the marginal of `entries` if given."""
    if entries is not None:
        residual, covariance = (
            residual[..., entries],
            covariance[..., entries, :][..., entries],
        )
    if residual.ndim == 1:
        return np.asarray(residual.dot(psd_solve(covariance, residual)))
    return np.asarray(
        np.vecdot(residual, psd_solve(covariance, residual[..., None])[..., 0])
    )


def inverse_root(S: FloatArray) -> FloatArray:
    """Inverse Cholesky factor W of S (n, n), W S W' = I; raises `numpy.linalg.LinAlgError` unless positive definite."""
    root, info = _lapack().dpotrf(S, lower=1)
    if info:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return np.asarray(_lapack().dtrtri(root, lower=1)[0])


def noise_root(Q: FloatArray) -> FloatArray:
    """`inverse_root` of process noise (n, n); a singular one is taken to be `regular`."""
    try:
        return inverse_root(Q)
    except np.linalg.LinAlgError:
        return inverse_root(regular(Q))


def regular(Q: FloatArray) -> FloatArray:
    """Process noise (..., n, n) with a millionth more of each standard deviation, and at least 1e-9: never singular."""
    variances = np.maximum(np.diagonal(Q, axis1=-2, axis2=-1), 1e-6)
    return Q + 1e-12 * variances[..., None] * identity(Q.shape[-1])
