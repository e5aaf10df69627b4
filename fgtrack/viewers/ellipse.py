"""The ellipse that a covariance stands for."""

import math

import numpy as np
from scipy.special import chdtri

from fgtrack.core.types import FloatArray

#: How many standard deviations from the mean an ellipse reaches. In two dimensions 86 % lie within two.
DEVIATIONS = 2.0
#: How many reach around 95 % of a Gaussian in the plane.
AROUND_95 = math.sqrt(float(chdtri(2, 0.05)))


def ellipses(covariances: FloatArray, deviations: float = DEVIATIONS) -> FloatArray:
    """Whole lengths of the long and the short axis, and direction of the long one, shape (n, 3).

    `covariances` are those of x and y, shape (n, 2, 2). A direction lies in [0, pi). What is not known is NaN.
    """
    found = np.full((len(covariances), 3), math.nan)
    known = np.isfinite(covariances).all(axis=(1, 2))
    variances, axes = np.linalg.eigh(covariances[known])  # rising
    lengths = 2.0 * deviations * np.sqrt(np.maximum(variances, 0.0))
    direction = np.mod(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]), math.pi)
    found[known] = np.stack([lengths[:, 1], lengths[:, 0], direction], axis=-1)
    return found
