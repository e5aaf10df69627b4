"""The backward step of Rauch, Tung and Striebel, and the state between two stamps of a Markov chain."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fgtrack.core.linalg import applied, kernels, regular
from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.ekf import Prediction, joseph, kalman_gain
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.models.motion import MotionModel

_KALMAN = "fgtrack.estimation.kernels.kalman"
Link = tuple[int, FloatArray, FloatArray, Prediction]
"""Stamp, mean (n,) and covariance (n, n) of a state, and its prediction from the link before."""


def rts_step(
    mean: FloatArray,
    covariance: FloatArray,
    predicted: Prediction,
    shift: FloatArray,
    after: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a state, or a stack of them, after the smoothing of the next one, and C = Cov(x, x_next) P_next^-1.
    x + C s and P + C (P_s - P_next) C', of `mean` (..., n) and `covariance` (..., n, n), with the prediction P_next of
    the next state, its `shift` s (..., n) by the smoothing and its covariance P_s = `after` then (..., n, n). Rauch,
    Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965. Raises
    `numpy.linalg.LinAlgError` where P_next has no root.
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
    """Return mean (n,) and covariance (n, n) at the first of `links`, of those at the last, by `rts_step`."""
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
    until_s: float | FloatArray,
    after_s: float | FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return mean, Lambda, Psi and Sigma of the state `until_s` after one and `after_s` before another one.
    x = mean + Lambda (x_l - l) + Psi (x_r - r) + N(0, Sigma), near l = `left` and r = `right`, (..., n) (Koch and
    Govaers 2014). With F1, Q1 until the stamp and F2, Q2 after it, the right one is a measurement F2 x + N(0, Q2) of a
    state with covariance Q1, and Psi its gain; Lambda = F1 - Psi F2 F1, Sigma = Q1 - Psi F2 Q1, linearised at `left`.
    """
    first, F1, Q1 = motion.transition(left, until_s)
    second, F2, Q2 = motion.transition(first, after_s)
    try:
        Psi, _ = kalman_gain(Q1, F2, Q2)
    except np.linalg.LinAlgError:  # of noise that leaves out a direction
        Psi, _ = kalman_gain(regular(Q1), F2, regular(Q2))
    mean = first + applied(Psi, right - second)
    return mean, F1 - Psi @ (F2 @ F1), Psi, joseph(Q1, Psi, F2, Q2)
