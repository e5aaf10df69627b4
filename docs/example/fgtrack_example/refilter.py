"""An estimator of one object."""

import numpy as np

from fgtrack import (
    CallError,
    Measurement,
    MotionModel,
    Start,
    TrackState,
    UpdateResult,
    UpdateStatus,
    initial_state,
    robust_weight,
)


class Refilter:
    """EKF that re-filters the measurements of its window, in the order of their stamps."""

    exact = "any lag, any number"
    solves = "ekf"

    def __init__(self, motion: MotionModel, start: Start, lag_s: float) -> None:
        self.motion = motion
        self.lag_ns = round(lag_s * 1e9)
        self.window_ns = (start.stamp_ns, start.stamp_ns)
        self.first = TrackState(start.stamp_ns, *initial_state(motion, start))
        self.measurements: list[Measurement] = []

    def update(self, measurement: Measurement) -> UpdateResult:
        oldest_ns, newest_ns = self.window_ns
        if measurement.stamp_ns < oldest_ns:
            return UpdateResult(UpdateStatus.TOO_OLD)
        if not (np.isfinite(measurement.z).all() and np.isfinite(measurement.R).all()):
            return UpdateResult(UpdateStatus.FAILED)
        measurement = measurement.seen_by(self.motion)
        y, _, S = self.innovation(self.state_at(measurement.stamp_ns), measurement)
        self.measurements.append(measurement)
        self.measurements.sort(key=lambda m: (m.stamp_ns, m.model.components, m.z.tolist()))
        self.window_ns = (oldest_ns, max(newest_ns, measurement.stamp_ns))
        self.advance(self.window_ns[1])
        late = measurement.stamp_ns < newest_ns
        status = UpdateStatus.OUT_OF_SEQUENCE if late else UpdateStatus.IN_SEQUENCE
        return UpdateResult(status, y, measurement.nis(y, S))

    def withdraw(self, measurement: Measurement) -> None:
        kept = [each for each in self.measurements if each.order != measurement.order]
        if len(kept) == len(self.measurements):
            raise CallError("withdraw: the window has no such measurement")
        self.measurements = kept

    def state_at(self, stamp_ns: int) -> TrackState:
        state = self.first
        for measurement in self.measurements:
            if measurement.stamp_ns <= stamp_ns:
                state = self.corrected(self.predicted(state, measurement.stamp_ns), measurement)
        return self.predicted(state, stamp_ns)

    def advance(self, now_ns: int) -> None:
        self.window_ns = (max(self.window_ns[0], now_ns - self.lag_ns), self.window_ns[1])
        while self.measurements and self.measurements[0].stamp_ns < self.window_ns[0]:
            measurement = self.measurements.pop(0)
            self.first = self.corrected(self.predicted(self.first, measurement.stamp_ns), measurement)

    def predicted(self, state: TrackState, stamp_ns: int) -> TrackState:
        dt_s = (stamp_ns - state.stamp_ns) / 1e9
        F, Q = self.motion.jacobian(state.mean, dt_s), self.motion.process_noise(state.mean, dt_s)
        P = F @ state.covariance @ F.T + Q
        return TrackState(stamp_ns, self.motion.predict(state.mean, dt_s), (P + P.T) / 2)

    def corrected(self, state: TrackState, measurement: Measurement) -> TrackState:
        y, H, S = self.innovation(state, measurement)
        R = measurement.R / robust_weight(measurement.loss, y, S - measurement.R, measurement.R)
        K = np.linalg.solve(S - measurement.R + R, H @ state.covariance).T
        A = np.eye(len(state.mean)) - K @ H
        P = A @ state.covariance @ A.T + K @ R @ K.T
        return TrackState(state.stamp_ns, state.mean + K @ y, (P + P.T) / 2)

    def innovation(self, state: TrackState, measurement: Measurement) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model, pose = measurement.model, measurement.pose
        H = model.jacobian(state.mean, pose)
        y = model.residual(measurement.z, model.predict(state.mean, pose))
        return y, H, H @ state.covariance @ H.T + measurement.R
