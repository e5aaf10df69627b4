"""A measurement that Stone Soup does not have, for the benchmark beside it."""

import numpy as np
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.types.array import StateVectors


class PositionSpeed(NonLinearGaussianMeasurement):
    """x, y and speed over ground of x, vx, y, vy, turn rate."""

    ndim_meas = 3

    def function(self, state, noise=False, **kwargs):
        x, vx, y, vy, _ = (state.state_vector[row, :] for row in range(5))
        return StateVectors([x, y, np.hypot(vx, vy)])

    def rvs(self, num_samples=1, **kwargs):
        raise NotImplementedError

    def pdf(self, state1, state2, **kwargs):
        raise NotImplementedError
