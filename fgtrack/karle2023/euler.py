"""CTRV integrated in Euler steps, as in the published filter (Karle et al. 2023, eq. 10)."""

import math

import numpy as np

from fgtrack.core.linalg import kernels
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.filters.propagation import ExactPropagator
from fgtrack.models.motion import MotionModel


class EulerCtrv(ExactPropagator):
    """CTRV in Euler steps (Karle et al. 2023, eq. 10).

    State entries after the yaw rate stay constant, and accumulate their noise.
    """

    yaw_limit_rad = math.inf
    """Largest predicted yaw: the yaw is clipped to it in each step."""

    def __init__(
        self, motion: MotionModel, density: FloatArray, *, accelerates: bool = False
    ) -> None:
        """Set the noise of the steps.

        `density`, shape (n,), is the diagonal of Q per second. Its first two entries
        are along and across the heading. `accelerates`: the acceleration drives the
        speed but is absent from the transition matrix (defect Q5).
        """
        super().__init__(motion)
        self._density = np.array(density, dtype=np.float64)
        self._accelerates = accelerates

    def propagate(
        self, mean: FloatArray, covariance: FloatArray, steps: IntArray, dt_s: float
    ) -> tuple[FloatArray, FloatArray]:
        """See `ExactPropagator.propagate`."""
        x, P = mean.copy(), covariance.copy()
        euler = kernels("fgtrack.karle2023.euler_kernels")
        euler.propagate(
            x, P, steps, dt_s, self._density, self._accelerates, self.yaw_limit_rad
        )
        return x, P
