"""Weight of a measurement under a robust loss, as in iteratively reweighted least squares.

The weight at a whitened residual of length d is rho'(d) / d of the loss rho, which begins as d^2 / 2; c is its width.
A width is given for one component: of k components c is where the chi distribution with k degrees of freedom has the
same probability beyond it, so a loss treats the same share of good measurements as outliers whatever they measure.
Names and forms are those of GTSAM. Weights begin at 1 and never grow with d, so each reweighting lowers prior plus loss
(Huber and Ronchetti, Robust Statistics, 2009, section 7.8).
"""

import math
from functools import cache

from fgtrack.models.sensors import RobustLoss

#: An outlier that a loss ignores altogether still has a finite covariance.
LEAST_WEIGHT = 1e-12


@cache
def width(loss: RobustLoss, size: int) -> float:
    """Width for the length of a whitened residual of `size` components: P(chi_size > width) = P(|N(0, 1)| > c)."""
    from scipy.special import chdtrc, chdtri

    beyond = float(chdtrc(1.0, loss.width**2))
    return math.sqrt(float(chdtri(float(size), beyond))) if beyond else loss.width


def _loss(loss: RobustLoss, d: float, size: int) -> tuple[float, float]:
    """The loss rho(d) and the weight rho'(d) / d; `dcs` is dynamic covariance scaling (Agarwal et al. 2013)."""
    c = width(loss, size)
    share = c * c / (c * c + d * d)
    if loss.kind == "cauchy":
        return 0.5 * c * c * math.log1p((d / c) ** 2), share
    if loss.kind == "geman_mcclure":
        return 0.5 * d * d * share, share**2
    if loss.kind == "tukey":
        left = max(1.0 - (d / c) ** 2, 0.0)
        return c * c / 6.0 * (1.0 - left**3), left**2
    if d <= c:
        return 0.5 * d * d, 1.0
    if loss.kind == "huber":
        return c * (d - 0.5 * c), c / d
    return c * c * (1.5 - 2.0 * share), (2.0 * share) ** 2


def weight(loss: RobustLoss, distance: float, size: int) -> float:
    """Weight of a measurement of `size` components, from `LEAST_WEIGHT` to 1, at a whitened residual of `distance`."""
    if not math.isfinite(distance):
        return LEAST_WEIGHT
    return max(_loss(loss, distance, size)[1], LEAST_WEIGHT)


def penalty(loss: RobustLoss | None, distance: float, size: int) -> float:
    """The loss rho itself; without a `loss` the square, d^2 / 2."""
    return 0.5 * distance * distance if loss is None else _loss(loss, distance, size)[0]
