"""Time of one prediction and update of Stone Soup's EKF, in order of stamps, without association."""

import time
from datetime import datetime, timedelta
from statistics import median

import numpy as np
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.nonlinear import ConstantTurn
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.types.array import StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater


class PositionSpeed(NonLinearGaussianMeasurement):
    """x, y and speed over ground of x, vx, y, vy, turn rate."""

    ndim_meas = 3

    def function(self, state, noise=False, **kwargs):
        x, vx, y, vy, _ = (state.state_vector[row, :] for row in range(5))
        return StateVectors([x, y, np.hypot(vx, vy)])


def per_detection_us(count: int = 240) -> float:
    """Return the median time; LiDAR (x, y) and RADAR (x, y, speed) of a car at 65 m/s in turn, 40 a second."""
    epoch = datetime(2024, 1, 1)
    predictor, updater = (
        ExtendedKalmanPredictor(ConstantTurn(np.array([0.05, 0.05]), 0.25)),
        ExtendedKalmanUpdater(None),
    )
    lidar = LinearGaussian(5, (0, 2), np.diag([0.09, 0.09]))
    radar = PositionSpeed(5, (0, 2), np.diag([9.0, 9.0, 0.04]))
    state = GaussianState(
        StateVector([0.0, 65.0, 0.0, 0.0, 0.05]),
        np.diag([1.0, 9.0, 1.0, 9.0, 0.09]),
        timestamp=epoch,
    )
    times_us = []
    for k in range(1, count + 1):
        stamp, z = epoch + timedelta(seconds=0.025 * k), [1.625 * k, 0.0, 65.0]
        detection = Detection(
            np.array(z[: 2 + k % 2])[:, None],
            timestamp=stamp,
            measurement_model=radar if k % 2 else lidar,
        )
        before_ns = time.perf_counter_ns()
        predicted = predictor.predict(state, timestamp=stamp)
        state = updater.update(SingleHypothesis(predicted, detection))
        times_us.append((time.perf_counter_ns() - before_ns) / 1e3)
    return median(times_us)
