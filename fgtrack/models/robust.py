"""Robust losses: the weight of a measurement in iteratively reweighted least squares.

The weight at a whitened residual of length d is rho'(d) / d. The loss rho behaves as
d^2 / 2 for small d, and c is its width.

A width is configured for a single component. For k components, c is scaled: a chi
variable with k degrees of freedom exceeds it with the same probability. So a loss
treats the same share of good measurements as outliers, however many components they
have.

Names and forms follow GTSAM. Weights are 1 at d = 0 and never increase with d. So each
reweighting lowers the sum of prior cost and loss (Huber and Ronchetti, Robust
Statistics, 2009, section 7.8).
"""

import math
from functools import cache

from fgtrack.core.linalg import kernels
from fgtrack.models.sensors import RobustLoss

_KERNELS = "fgtrack.models.measurement_kernels"
#: Smallest weight. With it the covariance of a rejected outlier remains finite.
LEAST_WEIGHT = 1e-12
#: Kinds of losses by their number in compiled loops; None is the Gaussian.
KINDS = (None, "huber", "cauchy", "tukey", "geman_mcclure", "dcs")


@cache
def width(loss: RobustLoss, size: int) -> float:
    """Width c for the length of a whitened residual of `size` components.

    It solves P(chi_size > c) = P(|N(0, 1)| > loss.width).
    """
    from scipy.special import chdtrc, chdtri

    beyond = float(chdtrc(1.0, loss.width**2))
    return math.sqrt(float(chdtri(float(size), beyond))) if beyond else loss.width


def compiled_form(loss: RobustLoss | None, size: int) -> tuple[int, float]:
    """Return the number of the loss in `KINDS` and its width for `size` components."""
    return (0, 1.0) if loss is None else (KINDS.index(loss.kind), width(loss, size))


def weight(loss: RobustLoss, distance: float, size: int) -> float:
    """Weight of a measurement of `size` components with the whitened residual `distance`.

    The weight lies between `LEAST_WEIGHT` and 1.
    """
    return _at(loss, distance, size)[1]


def penalty(loss: RobustLoss | None, distance: float, size: int) -> float:
    """Return the loss rho(distance); without a `loss` the quadratic distance^2 / 2."""
    return _at(loss, distance, size)[0]


def _at(loss: RobustLoss | None, distance: float, size: int) -> tuple[float, float]:
    """Return the loss rho(distance) and the weight rho'(distance) / distance."""
    found: tuple[float, float] = kernels(_KERNELS).loss_at(
        *compiled_form(loss, size), distance
    )
    return found
