"""An estimator of all objects in array operations."""

import numpy as np

from fgtrack import (
    StatesAt,
    TrackState,
    UpdateResult,
    UpdateStatus,
    initial_state,
    robust_weight,
)


class DropBank:
    """Kalman filters of all objects in one array; a late measurement is dropped."""

    bank = True

    def __init__(self, motion, lag_s):
        self.motion = motion
        self.lag_ns = round(lag_s * 1e9)
        self.present_ns = 0
        self.track_ids = ()
        self.stamps_ns = np.zeros(0, dtype=np.int64)
        self.x, self.P = np.zeros((0, motion.dim)), np.zeros((0, motion.dim, motion.dim))

    @property
    def window_start_ns(self):
        """Measurements with an older stamp cannot be fused by any track."""
        return self.present_ns - self.lag_ns

    def advance(self, now_ns):
        """The clock moved."""
        self.present_ns = now_ns

    def birth(self, track_id, start):
        x, P = initial_state(self.motion, start)
        self.track_ids = (*self.track_ids, track_id)
        self.stamps_ns = np.append(self.stamps_ns, start.stamp_ns)
        self.x, self.P = np.concatenate([self.x, x[None]]), np.concatenate([self.P, P[None]])

    def remove(self, track_id):
        row = self.track_ids.index(track_id)
        self.track_ids = self.track_ids[:row] + self.track_ids[row + 1 :]
        self.stamps_ns, self.x, self.P = (np.delete(each, row, axis=0) for each in (self.stamps_ns, self.x, self.P))

    def states_at(self, stamp_ns):
        """States of all tracks at a stamp, for the association; before their newest measurements without noise."""
        dt_s = (stamp_ns - self.stamps_ns) / 1e9
        F, Q = self.motion.jacobian(self.x, dt_s), self.motion.process_noise(self.x, np.maximum(dt_s, 0.0))
        P = F @ self.P @ np.swapaxes(F, -1, -2) + Q
        return StatesAt(self.track_ids, self.motion.predict(self.x, dt_s), (P + np.swapaxes(P, -1, -2)) / 2)

    def update(self, stamp_ns, track_ids, measurements):
        """Fuse one measurement for each of some tracks, all of one stamp."""
        states = self.states_at(stamp_ns)
        return [self.fuse(stamp_ns, *pair, states) for pair in zip(track_ids, measurements, strict=True)]

    def fuse(self, stamp_ns, track_id, measurement, states):
        row = self.track_ids.index(track_id)
        if stamp_ns < self.stamps_ns[row]:
            return UpdateResult(UpdateStatus.TOO_OLD)
        x, P = states.means[row], states.covariances[row]
        H = measurement.model.jacobian(x, measurement.pose)
        y = measurement.model.residual(measurement.z, measurement.model.predict(x, measurement.pose))
        S = H @ P @ H.T + measurement.R
        if not (np.isfinite(y).all() and np.isfinite(S).all()):
            return UpdateResult(UpdateStatus.FAILED)
        R = measurement.R / robust_weight(measurement.loss, y, S - measurement.R, measurement.R)
        K = np.linalg.solve(S - measurement.R + R, H @ P).T
        A = np.eye(len(x)) - K @ H
        P = A @ P @ A.T + K @ R @ K.T
        self.stamps_ns[row], self.x[row], self.P[row] = stamp_ns, x + K @ y, (P + P.T) / 2
        return UpdateResult(UpdateStatus.IN_SEQUENCE, y, measurement.nis(y, S))

    def present(self):
        """States now as x, y, yaw, speed, yaw rate, for the output."""
        states = self.states_at(max(self.present_ns, int(self.stamps_ns.max(initial=0))))
        means, covariances = self.motion.published(states.means, states.covariances)
        return [
            TrackState(self.present_ns, mean, covariance) for mean, covariance in zip(means, covariances, strict=True)
        ]

    def smoothed(self):
        """States of the past that later measurements have improved: a filter has none."""
        return []
