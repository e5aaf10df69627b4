"""The state between two stamps of a Markov chain, under the motion model."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import psd_solve
from fgtrack.core.types import FloatArray
from fgtrack.models.motion import MotionModel


class Between(NamedTuple):
    """x = mean + Lambda (x_l - l) + Psi (x_r - r) + N(0, Sigma), given the neighbours near their means l and r.

    See Koch and Govaers 2014 (accumulated state densities), or Gaussian-process interpolation in Barfoot et al. 2014.
    """

    mean: FloatArray
    """Shape (n,)."""
    Lambda: FloatArray
    """Shape (n, n)."""
    Psi: FloatArray
    """Shape (n, n)."""
    Sigma: FloatArray
    """Shape (n, n)."""


def between(motion: MotionModel, left: Sequence[float], right: FloatArray, until_s: float, after_s: float) -> Between:
    """State `until_s` after a node with mean `left` (n,) and `after_s` before one with mean `right` (n,).

    With F1, Q1 until the stamp and F2, Q2 after it: Psi = Q1 F2' (F2 Q1 F2' + Q2)^-1, Lambda = F1 - Psi F2 F1,
    Sigma = Q1 - Psi F2 Q1. The motion is linearised at `left`.
    """
    first = motion.step(left, until_s)
    second = motion.step(first.mean, after_s)
    spread = second.F @ first.Q
    Psi = psd_solve(spread @ second.F.T + second.Q, spread).T
    kept = np.eye(len(right)) - Psi @ second.F
    mean = np.asarray(first.mean) + Psi @ (right - np.asarray(second.mean))
    return Between(mean, kept @ first.F, Psi, kept @ first.Q @ kept.T + Psi @ second.Q @ Psi.T)
