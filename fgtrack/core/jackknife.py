"""Standard deviations of a least-squares solution by a jackknife over clusters of data.

The solution of each cluster is left out once. The errors in a cluster may be correlated in any way (Bell and
McCaffrey, Survey Methodology 28, 2002). The ratio of an error to its standard deviation follows Student's t
distribution. Its degrees of freedom are the effective number of clusters minus 1. Clusters of unequal
information count as fewer (Carter, Schnepel and Steigerwald, Review of Economics and Statistics 99, 2017).
"""

from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import FloatArray, IntArray

__all__ = ["Information", "dof_of_sum", "jackknife"]

#: Share of the information that the data must carry.
_CARRIED = 0.5


class Information(NamedTuple):
    """Normal equations of parts of the data at the solution d of sum(H) d = -sum(g)."""

    H: FloatArray
    """Information matrices, shape (n, k, k)."""
    g: FloatArray
    """Gradients, shape (n, k)."""
    prior: FloatArray
    """Diagonal of the information of a prior, shape (k,)."""


def jackknife(
    data: Information, clusters: IntArray, functions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of linear functions of the solution, and their degrees of freedom, shape (m,).

    `clusters` are the numbers of the clusters of the parts, shape (n,). `functions` has
    shape (m, k). The standard deviation is infinite if a prior carries the information.
    """
    names, inverse = np.unique(clusters, return_inverse=True)
    size = data.g.shape[1]
    if len(names) < 2 or not size:
        return np.full(len(functions), np.inf), np.zeros(len(functions))
    parts = np.zeros((len(names), size, size))
    scores = np.zeros((len(names), size))
    np.add.at(parts, inverse, data.H)
    np.add.at(scores, inverse, data.g)
    total = parts.sum(axis=0) + np.diag(data.prior)
    changes = psd_solve(total - parts, scores[:, :, None])[:, :, 0]
    moves = changes @ functions.T
    std = np.sqrt((1.0 - 1.0 / len(names)) * np.square(moves).sum(axis=0))
    columns = psd_solve(total, functions.T)
    shares = np.einsum("ji,njk,ki->ni", columns, parts, columns)
    sums = shares.sum(axis=0)
    known = sums > 0.0
    shares = shares / np.where(known, sums, 1.0)
    dof = 1.0 / np.maximum(np.square(shares).sum(axis=0), 1e-12) - 1.0
    carried = sums / np.maximum(np.einsum("ij,ji->i", functions, columns), 1e-300)
    known &= carried > _CARRIED
    return np.where(known, std, np.inf), np.where(known, dof, 0.0)


def dof_of_sum(
    one: FloatArray, one_dof: FloatArray, other: FloatArray, other_dof: float
) -> FloatArray:
    """Return the degrees of freedom of the sum of two estimated variances, shape (n,) (Welch and Satterthwaite).

    They stay `one_dof` where the variance `one` is infinite or 0.
    """
    known = np.isfinite(one) & (one > 0.0) & (one_dof > 0.0)
    one = np.where(known, one, 1.0)
    parts = np.square(one) / np.where(known, one_dof, 1.0)
    parts += np.square(other) / other_dof
    return np.where(known, np.square(one + other) / parts, one_dof)
