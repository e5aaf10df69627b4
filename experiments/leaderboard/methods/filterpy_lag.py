"""filterpy's fixed-lag smoother: it has no door for late data, so what is late is left out."""

import numpy as np
from filterpy.kalman import FixedLagSmoother

NUM_STEPS = 20


class FixedLag:
    """A smoother of the last 20 positions in order."""

    def __init__(self, given):
        self.given = given
        self.smoother = FixedLagSmoother(dim_x=4, dim_z=2, N=NUM_STEPS)
        self.smoother.x, self.smoother.P = given.mean, given.covariance
        self.smoother.H = np.eye(2, 4)
        self.stamps_s = [0.0]

    def update(self, observation):
        if tuple(observation.values) != ("x_m", "y_m"):
            raise NotImplementedError("the adapter has positions only")
        dt_s = observation.stamp_s - self.stamps_s[-1]
        if dt_s < 0.0:
            return False
        self.smoother.F, self.smoother.Q = self.given.transition(dt_s)
        self.smoother.R = observation.R
        self.smoother.smooth(observation.z)
        self.stamps_s.append(observation.stamp_s)
        return True

    def state_at(self, time_s):
        F, Q = self.given.transition(time_s - self.stamps_s[-1])
        if time_s >= self.stamps_s[-1]:
            return F @ self.smoother.x, F @ self.smoother.P @ F.T + Q
        step = int(np.searchsorted(self.stamps_s, time_s, "right")) - 1
        if step == 0:
            return None
        F, _ = self.given.transition(time_s - self.stamps_s[step])
        return F @ self.smoother.xSmooth[step - 1]
