"""The backward step of the smoother of Rauch, Tung and Striebel."""

from collections.abc import Sequence
from itertools import pairwise

from fgtrack.core.linalg import applied, congruence, psd_solve, symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.ekf import Prediction
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.models.motion import MotionModel

Link = tuple[int, FloatArray, FloatArray, Prediction]
"""Stamp, mean (n,) and covariance (n, n) of a state, and its prediction from the link before."""


def rts_step(
    mean: FloatArray, covariance: FloatArray, predicted: Prediction, shift: FloatArray, after: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a state, or a stack of them, after the smoothing of the next one, and C = Cov(x, x_next) P_next^-1.

    x + C s and P + C (P_s - P_next) C', of `mean` (..., n) and `covariance` (..., n, n), with the prediction P_next of
    the next state, its `shift` s (..., n) by the smoothing and its covariance P_s = `after` then (..., n, n). Rauch,
    Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965.
    """
    C = psd_solve(predicted.covariance, predicted.cross).mT
    P = covariance + congruence(C, after - predicted.covariance)
    return mean + applied(C, shift), symmetrise(P), C


def smoothed_back(
    motion: MotionModel, links: Sequence[Link], mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) at the first of `links`, of those at the last, by `rts_step`."""
    for (before_ns, x, P, _), (after_ns, _, _, predicted) in reversed(list(pairwise(links))):
        if before_ns < after_ns:  # else the same state
            mean, covariance, _ = rts_step(x, P, predicted, wrapped(motion, mean - predicted.mean), covariance)
    return mean, covariance
