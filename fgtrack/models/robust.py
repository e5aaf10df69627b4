"""Weight of a measurement under a robust loss, as in iteratively reweighted least squares.

The weight at a whitened residual of length d is rho'(d) / d of the loss rho, which begins as d^2 / 2; c is its width.
A width is given for one component: of k components c is where the chi distribution with k degrees of freedom has the
same probability beyond it, so a loss treats the same share of good measurements as outliers whatever they measure.
Names and forms are those of GTSAM. Weights begin at 1 and never grow with d, so each reweighting lowers prior plus loss
(Huber and Ronchetti, Robust Statistics, 2009, section 7.8).
"""

import math
from functools import cache

from fgtrack.core.linalg import kernels
from fgtrack.models.sensors import RobustLoss

_KERNELS = "fgtrack.models.measurement_kernels"
#: An outlier that a loss ignores altogether still has a finite covariance.
LEAST_WEIGHT = 1e-12
#: The number of a loss in compiled loops is its index; None is the Gaussian.
KINDS = (None, "huber", "cauchy", "tukey", "geman_mcclure", "dcs")


@cache
def width(loss: RobustLoss, size: int) -> float:
    """Width for the length of a whitened residual of `size` components: P(chi_size > width) = P(|N(0, 1)| > c)."""
    from scipy.special import chdtrc, chdtri

    beyond = float(chdtrc(1.0, loss.width**2))
    return math.sqrt(float(chdtri(float(size), beyond))) if beyond else loss.width


def compiled_form(loss: RobustLoss | None, size: int) -> tuple[int, float]:
    """Number of the kind, and the width for `size` components, of a loss in compiled loops."""
    return (0, 1.0) if loss is None else (KINDS.index(loss.kind), width(loss, size))


def weight(loss: RobustLoss, distance: float, size: int) -> float:
    """Weight of a measurement of `size` components, from `LEAST_WEIGHT` to 1, at a whitened residual of `distance`."""
    return _at(loss, distance, size)[1]


def penalty(loss: RobustLoss | None, distance: float, size: int) -> float:
    """The loss rho itself; without a `loss` the square, d^2 / 2."""
    return _at(loss, distance, size)[0]


def _at(loss: RobustLoss | None, distance: float, size: int) -> tuple[float, float]:
    """Loss and weight."""
    found: tuple[float, float] = kernels(_KERNELS).loss_at(
        *compiled_form(loss, size), distance
    )
    return found
