"""Small dense linear algebra on stacks of symmetric matrices."""

import numpy as np

from fgtrack.core.types import FloatArray


def symmetrise(matrix: FloatArray) -> FloatArray:
    """Symmetric part of `matrix`, shape (..., n, n)."""
    return np.asarray(0.5 * (matrix + np.swapaxes(matrix, -1, -2)))


def psd_solve(matrix: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve `matrix @ x = rhs` for a symmetric positive definite `matrix`.

    Shapes (..., n, n) and (..., n, k). Raises `numpy.linalg.LinAlgError` when `matrix` is singular.
    """
    return np.asarray(np.linalg.solve(matrix, rhs))


def mahalanobis_squared(residual: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared Mahalanobis distance y' S^-1 y; shapes (..., n) and (..., n, n), result (...)."""
    solved = psd_solve(covariance, residual[..., None])[..., 0]
    return np.asarray(np.sum(residual * solved, axis=-1))
