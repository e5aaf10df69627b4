"""PyRecEst's replay updater: predictions and updates are events, and a late update is replayed among them."""

import numpy as np
from pyrecest.filters.out_of_sequence import OutOfSequenceKalmanUpdater

H = np.eye(2, 4)


class Replay:
    """A prediction to each stamp that is in order; a late position is an event at its own stamp."""

    def __init__(self, given):
        self.given = given
        self.filter = OutOfSequenceKalmanUpdater((given.mean, given.covariance))

    def update(self, observation):
        if tuple(observation.values) != ("x_m", "y_m"):
            raise NotImplementedError("the adapter has positions only")
        stamp_s, now_s = observation.stamp_s, self.filter.current_time
        if stamp_s > now_s:
            self.filter.predict_linear(stamp_s, *self.given.transition(stamp_s - now_s))
        self.filter.update_linear(stamp_s, observation.z, H, observation.R)

    def state_at(self, time_s):
        dt_s = time_s - self.filter.current_time
        if dt_s < 0.0:
            return None
        F, Q = self.given.transition(dt_s)
        state = self.filter.filter_state
        return F @ state.mu, F @ state.C @ F.T + Q
