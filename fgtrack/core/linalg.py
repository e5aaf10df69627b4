"""Linear algebra of small symmetric matrices, single or stacked."""

from collections.abc import Hashable, Sequence
from functools import cache
from importlib import import_module
from types import ModuleType

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.types import FloatArray, IntArray


@cache
def kernels(name: str) -> ModuleType:
    """Return the module `name` of compiled loops. It is imported at its first use, because numba loads slowly."""
    return import_module(name)


@cache
def _lapack() -> ModuleType:
    """LAPACK of SciPy; it is imported at its first use, because SciPy loads slowly."""
    return import_module("scipy.linalg.lapack")


@cache
def identity(n: int) -> FloatArray:
    """Identity matrix, shape (n, n): one shared read-only array for each `n`."""
    matrix = np.eye(n)
    matrix.flags.writeable = False
    return matrix


def equal_ones(items: Sequence[Hashable]) -> list[list[int]]:
    """Group equal `items`: for each distinct item its ascending indices, in the order of first occurrence.

    The caller processes the items of a group as one stack of matrices.
    """
    groups: dict[Hashable, list[int]] = {}
    for index, item in enumerate(items):
        groups.setdefault(item, []).append(index)
    return list(groups.values())


def stacked(matrices: FloatArray) -> FloatArray:
    """Return a contiguous stack (m, k, n) of `matrices`; a single matrix (k, n) becomes a stack of one."""
    return np.ascontiguousarray(matrices if matrices.ndim == 3 else matrices[None])


def symmetrise(matrix: FloatArray) -> FloatArray:
    """Symmetric part (A + A') / 2 of `matrix`, shape (..., n, n)."""
    total: FloatArray = matrix + matrix.T if matrix.ndim == 2 else matrix + matrix.mT
    total *= 0.5
    return total


#: Largest difference of two opposite correlations: rounding a covariance to single precision causes less.
ASYMMETRY = 1e-6


def is_covariance(P: FloatArray, least: float) -> bool:
    """True if `P` (n, n) is finite and symmetric, and the eigenvalues of its correlation matrix exceed `least`.

    A component with variance 0 has correlation 1 with itself.
    """
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
    """Congruence F P F', shapes (..., m, n) and (..., n, n), for example a propagated covariance."""
    if F.ndim == P.ndim == 2:
        return np.asarray(F.dot(P).dot(F.T))
    # A copy of F' takes half of the time of the view.
    return F @ P @ np.ascontiguousarray(F.mT)


def applied(A: FloatArray, x: FloatArray) -> FloatArray:
    """Matrix-vector products A x, shape (..., m), of matrices (..., m, n) and vectors (..., n)."""
    return A.dot(x) if A.ndim == 2 else np.asarray(np.vecdot(A, x[..., None, :]))


def psd_solve(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve `matrix @ x = rhs` for a symmetric positive definite `matrix`.

    Shapes (..., n, n) and (..., n, k). With a single matrix, `rhs` may be a vector
    (n,).

    Raises `numpy.linalg.LinAlgError` if `matrix` is singular.
    """
    if matrix.ndim > 2:
        return np.asarray(np.linalg.solve(matrix, rhs))
    # NumPy calls the same routine; without its checks it takes a third of the time.
    _, _, solution, info = _lapack().dgesv(matrix, rhs)
    if info:
        raise np.linalg.LinAlgError("singular matrix")
    return np.asarray(solution)


def mahalanobis_squared(
    residual: FloatArray, covariance: FloatArray, entries: IntArray | None = None
) -> FloatArray:
    """Squared Mahalanobis distance y' S^-1 y, shape (...), of `residual` (..., n) and `covariance` (..., n, n).

    With `entries`, the distance of the marginal of these components.
    """
    if entries is not None:
        residual = residual[..., entries]
        covariance = covariance[..., entries, :][..., entries]
    if residual.ndim == 1:
        return np.asarray(residual.dot(psd_solve(covariance, residual)))
    return np.asarray(
        np.vecdot(residual, psd_solve(covariance, residual[..., None])[..., 0])
    )


def inverse_root(S: FloatArray) -> FloatArray:
    """Inverse Cholesky factor W of S (n, n): W S W' = I.

    Raises `numpy.linalg.LinAlgError` if S is not positive definite.
    """
    root, info = _lapack().dpotrf(S, lower=1)
    if info:
        raise np.linalg.LinAlgError("a covariance is not positive definite")
    return np.asarray(_lapack().dtrtri(root, lower=1)[0])


def noise_root(Q: FloatArray) -> FloatArray:
    """Inverse Cholesky factor of process noise (n, n); singular noise is made `regular` first."""
    try:
        return inverse_root(Q)
    except np.linalg.LinAlgError:
        return inverse_root(regular(Q))


def regular(Q: FloatArray) -> FloatArray:
    """Process noise (..., n, n) with a small diagonal added, which makes it regular (invertible).

    Each standard deviation of the addition is a millionth of the component's, and at
    least 1e-9.
    """
    variances = np.maximum(np.diagonal(Q, axis1=-2, axis2=-1), 1e-6)
    return Q + 1e-12 * variances[..., None] * identity(Q.shape[-1])
