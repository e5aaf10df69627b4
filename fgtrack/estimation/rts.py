"""The backward step of Rauch, Tung and Striebel, and the state between two stamps of a Markov chain."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fgtrack.core.linalg import kernels, regular
from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.ekf import Prediction, correct
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.models.motion import MotionModel

_KALMAN = "fgtrack.estimation.kernels.kalman"
Link = tuple[int, FloatArray, FloatArray, Prediction]
"""Stamp, mean (n,) and covariance (n, n) of a state, and the prediction of this state from the link before."""


def rts_step(
    mean: FloatArray,
    covariance: FloatArray,
    predicted: Prediction,
    shift: FloatArray,
    after: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean, covariance and gain of states after the next state was smoothed.

    A state x, P (`mean` (..., n), `covariance` (..., n, n)) becomes x + C s and P + C (P_s - P_next) C'. The gain is
    C = Cov(x, x_next) P_next^-1. The next state has the predicted covariance P_next. Smoothing has moved its mean by
    s = `shift` (..., n), and its covariance to P_s = `after` (..., n, n).

    Source: Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965.
    Raises `numpy.linalg.LinAlgError` where P_next is not positive definite.
    """
    n, shape = mean.shape[-1], covariance.shape
    x, s = (
        np.array(np.broadcast_to(each, shape[:-1]), dtype=np.float64, order="C")
        for each in (mean, shift)
    )
    P, P_next, gain, P_s = (
        np.array(np.broadcast_to(each, shape), dtype=np.float64, order="C")
        for each in (covariance, predicted.covariance, predicted.cross, after)
    )
    stacks = (each.reshape(-1, n, n) for each in (P, P_next, gain))
    if not kernels(_KALMAN).smooth_states(
        x.reshape(-1, n), *stacks, s.reshape(-1, n), P_s.reshape(-1, n, n)
    ):
        raise np.linalg.LinAlgError("the covariance of a prediction has no root")
    return x, P, gain.mT


def smoothed_back(
    motion: MotionModel, links: Sequence[Link], mean: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) at the first of `links`, by `rts_step` from those at the last link."""
    for (before_ns, x, P, _), (after_ns, _, _, predicted) in reversed(
        list(pairwise(links))
    ):
        if before_ns < after_ns:  # else the same state
            mean, covariance, _ = rts_step(
                x, P, predicted, wrapped(motion, mean - predicted.mean), covariance
            )
    return mean, covariance


def between(
    motion: MotionModel,
    left: FloatArray,
    right: FloatArray,
    until_s: float,
    after_s: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return mean, Lambda, Psi and Sigma of the state between two neighbours, `until_s` after the left neighbour.

    The right neighbour follows `after_s` later. Near l = `left` and r = `right`, shape (n,), the state is
    x = mean + Lambda (x_l - l) + Psi (x_r - r) + N(0, Sigma) (Koch and Govaers 2014). With F1, Q1 until the stamp and
    F2, Q2 after the stamp, x_r is a measurement F2 x + N(0, Q2) of a state with covariance Q1. So Psi is the gain of
    this measurement, Lambda = F1 - Psi F2 F1, and Sigma is the covariance after the correction.

    Raises `numpy.linalg.LinAlgError` where the process noise cannot be inverted.
    """
    first, F1, Q1 = motion.transition(left, until_s)
    second, F2, Q2 = motion.transition(first, after_s)
    Psi, Sigma, is_fused = _gain(Q1, F2, Q2)
    if not is_fused:  # the noise leaves out a direction
        Psi, Sigma, is_fused = _gain(regular(Q1), F2, regular(Q2))
    if not is_fused:
        raise np.linalg.LinAlgError("the process noise between two states has no root")
    return first + Psi @ (right - second), F1 - Psi @ (F2 @ F1), Psi, Sigma


def _gain(
    P: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, bool]:
    """Return the gain (n, k) and the covariance (n, n) after a measurement; False where nothing can be fused.

    Column j of the gain is the step of the mean for an innovation of 1 in component j.
    """
    k, n = H.shape
    result = correct(
        np.zeros((k, n)), np.tile(P, (k, 1, 1)), np.eye(k), H, np.tile(R, (k, 1, 1))
    )
    return result.mean.T, result.covariance[0], bool(result.fused.all())
