"""The state between two stamps of a Markov chain, under the motion model."""

import numpy as np

from fgtrack.core.linalg import applied, product, regular
from fgtrack.core.types import FloatArray
from fgtrack.estimation.filters.ekf import joseph, kalman_gain
from fgtrack.models.motion import MotionModel


def between(
    motion: MotionModel, left: FloatArray, right: FloatArray, until_s: float | FloatArray, after_s: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return mean, Lambda, Psi and Sigma of the state `until_s` after one and `after_s` before another one.

    x = mean + Lambda (x_l - l) + Psi (x_r - r) + N(0, Sigma), given the neighbours near their means l = `left` and r =
    `right`, shape (..., n). See Koch and Govaers 2014 (accumulated state densities), or Gaussian-process interpolation
    in Barfoot et al. 2014. With F1, Q1 until the stamp and F2, Q2 after it, the right one is a measurement F2 x +
    N(0, Q2) of a state with covariance Q1, and Psi its gain; Lambda = F1 - Psi F2 F1, Sigma = Q1 - Psi F2 Q1. The
    motion is linearised at `left`.
    """
    first, F1, Q1 = motion.transition(left, until_s)
    second, F2, Q2 = motion.transition(first, after_s)
    try:
        Psi, _ = kalman_gain(Q1, F2, Q2)
    except np.linalg.LinAlgError:  # of noise that leaves out a direction
        Psi, _ = kalman_gain(regular(Q1), F2, regular(Q2))
    mean = first + applied(Psi, right - second)
    return mean, F1 - product(Psi, product(F2, F1)), Psi, joseph(Q1, Psi, F2, Q2)
