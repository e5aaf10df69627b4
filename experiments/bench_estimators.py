"""Time per detection of the estimators of one object, beside Stone Soup's extended Kalman filter in the same run.

    make bench

One car drives a bend at 65 m/s for 30 s, seen by the paper's sensors: LiDAR 20 Hz x, y, 151 ms late; RADAR 20 Hz x, y,
speed, 62 ms late. The estimators get the detections in order of arrival and put each in its place: a LiDAR detection
has two RADAR detections to be applied again behind it. The yardstick gets the same in order of stamps, one prediction
and one update each, with its constant turn (state x, vx, y, vy, turn rate) and its own numeric Jacobians. Were it to
rewind for late detections as `ekf-replay` does, it would need a prediction and an update for each applied again.
"""

import time
from collections.abc import Callable
from datetime import datetime, timedelta

import numpy as np
import pytest
from stonesoup.models.measurement.linear import LinearGaussian
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.nonlinear import ConstantTurn
from stonesoup.predictor.kalman import ExtendedKalmanPredictor
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import ExtendedKalmanUpdater

from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateStatus
from fgtrack.estimation.factor_graph import FixedLagSmoother, SmootherSettings
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV

MOTION = CTRV()
LAG_S = 1.0
DURATION_S = 30.0
START = np.array([0.0, 0.0, 0.3, 65.0, 0.05])  # x, y, yaw, speed, yaw rate


def smoother(start: Start, lag_s: float) -> FixedLagSmoother:
    settings = SmootherSettings(lag_s=lag_s, lagged_s=(), final=False)
    return FixedLagSmoother(MOTION, start, settings)


ESTIMATORS: dict[str, Callable[[Start], Estimator]] = {
    "ekf-replay": lambda prior: ReplayEkf(MOTION, prior, LAG_S),
    "smoother, 1 s": lambda prior: smoother(prior, 1.0),
    "smoother, 3 s": lambda prior: smoother(prior, 3.0),
}
REQUIRED = {"ekf-replay": 10.0, "smoother, 1 s": 4.0, "smoother, 3 s": 2.6}
"""How many times as fast as one prediction and update of Stone Soup an estimator should be per detection."""

SENSORS = (  # first stamp, delay, standard deviation of each component
    (0.05, 0.151, {"x_m": 0.3, "y_m": 0.3}),
    (0.07, 0.062, {"x_m": 3.0, "y_m": 3.0, "speed_mps": 0.2}),
)
PERIOD_S = 0.05


class PositionSpeed(NonLinearGaussianMeasurement):
    """x, y and speed over ground of x, vx, y, vy, turn rate, for Stone Soup."""

    ndim_meas = 3

    def function(self, state, noise=False, **kwargs):
        x, vx, y, vy, _ = (state.state_vector[row, :] for row in range(5))
        return StateVectors([x, y, np.hypot(vx, vy)])

    def rvs(self, num_samples=1, **kwargs):
        raise NotImplementedError

    def pdf(self, state1, state2, **kwargs):
        raise NotImplementedError


def stream() -> list[Measurement]:
    """Measurements of the car in order of arrival."""
    rng = np.random.default_rng(0)
    arrivals: list[tuple[float, Measurement]] = []
    for first_s, delay_s, std in SENSORS:
        model = measurement_model(tuple(std), MOTION)
        stds = np.array(list(std.values()))
        for stamp_s in np.arange(first_s, DURATION_S, PERIOD_S):
            z = model.predict(MOTION.predict(START, stamp_s)) + stds * rng.standard_normal(len(stds))
            arrivals.append((stamp_s + delay_s, Measurement(nanoseconds(stamp_s), model, z, np.diag(stds**2))))
    return [measurement for _, measurement in sorted(arrivals, key=lambda arrival: arrival[0])]


def prior() -> Start:
    x, y, yaw, speed, yaw_rate = START.tolist()
    return Start(
        stamp_ns=0,
        position_m=(x, y),
        yaw_rad=yaw,
        yaw_std_rad=0.3,
        speed_mps=speed,
        speed_std_mps=3.0,
        yaw_rate_radps=yaw_rate,
        yaw_rate_std_radps=0.3,
    )


def run_estimator(name: str, measurements: list[Measurement]) -> tuple[list[int], list[bool], FloatArray]:
    """Time of each update in ns, whether it was late, and the last position."""
    estimator = ESTIMATORS[name](prior())
    times_ns, late = [], []
    for measurement in measurements:
        before = time.perf_counter_ns()
        result = estimator.update(measurement)
        times_ns.append(time.perf_counter_ns() - before)
        assert result.status in (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE)
        late.append(result.status is UpdateStatus.OUT_OF_SEQUENCE)
    return times_ns, late, estimator.state_at(nanoseconds(DURATION_S)).mean[:2]


def run_stone_soup(measurements: list[Measurement]) -> tuple[list[int], FloatArray]:
    """Time of each prediction and update in ns, and the last position."""
    epoch = datetime(2024, 1, 1)
    predictor = ExtendedKalmanPredictor(ConstantTurn(np.array([0.05, 0.05]), MOTION.yaw_rate_density_rad2ps3))
    updater = ExtendedKalmanUpdater(None)
    _, _, yaw, speed, yaw_rate = START.tolist()
    start = [[0.0], [speed * np.cos(yaw)], [0.0], [speed * np.sin(yaw)], [yaw_rate]]
    state = GaussianState(np.array(start), np.diag([1.0, 9.0, 1.0, 9.0, 0.09]), timestamp=epoch)
    times_ns = []
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        model = (
            LinearGaussian(5, (0, 2), measurement.R)
            if len(measurement.z) == 2
            else PositionSpeed(5, (0, 2), measurement.R)
        )
        stamp = epoch + timedelta(seconds=seconds(measurement.stamp_ns))
        detection = Detection(measurement.z[:, None], timestamp=stamp, measurement_model=model)
        before = time.perf_counter_ns()
        predicted = predictor.predict(state, timestamp=stamp)
        state = updater.update(SingleHypothesis(predicted, detection))
        times_ns.append(time.perf_counter_ns() - before)
    return times_ns, np.array(state.state_vector[[0, 2], 0], dtype=float)


def num_applied(measurements: list[Measurement]) -> list[int]:
    """How many measurements are applied when each arrives: it and those of newer stamps that came before it."""
    stamps_ns = [measurement.stamp_ns for measurement in measurements]
    return [1 + sum(older > stamp_ns for older in stamps_ns[:k]) for k, stamp_ns in enumerate(stamps_ns)]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_update_with_a_detection(benchmark, name):
    measurements = stream()
    runs: list[tuple[list[int], list[bool], FloatArray]] = []
    yards: list[tuple[list[int], FloatArray]] = []

    def run() -> None:
        yards.append(run_stone_soup(measurements))
        runs.append(run_estimator(name, measurements))

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)
    yard_us = float(np.median([times_ns for times_ns, _ in yards])) / 1e3
    times_us = np.array([times_ns for times_ns, _, _ in runs]) / 1e3
    late = np.array(runs[0][1])
    median_us, p99_us = (float(np.quantile(times_us, q)) for q in (0.5, 0.99))
    prompt_us, late_us = (float(np.median(times_us[:, which])) for which in (~late, late))
    mean_us = float(np.median(times_us, axis=0).mean())  # of each detection's median: the machine has other work, too
    rewinding_us = yard_us * float(np.mean(num_applied(measurements)))
    benchmark.extra_info.update(stone_soup_us=yard_us, median_us=median_us, mean_us=mean_us, p99_us=p99_us)
    ratio = {what: yard_us / us for what, us in (("median", median_us), ("prompt", prompt_us), ("late", late_us))}
    print(
        f"\n{name}: median {median_us:.0f} us per detection (in sequence {prompt_us:.0f}, late {late_us:.0f}), "
        f"mean {mean_us:.0f}, 99 % below {p99_us:.0f}; Stone Soup's prediction and update {yard_us:.0f} us: "
        f"{ratio['median']:.1f} times as fast (in sequence {ratio['prompt']:.1f}, late {ratio['late']:.1f}, "
        f"mean {yard_us / mean_us:.1f}; required {REQUIRED[name]:.0f}), "
        f"{rewinding_us / mean_us:.1f} times where it rewinds, too"
    )
    truth = MOTION.predict(START, DURATION_S)[:2]
    assert max(np.hypot(*(position - truth)) for *_, position in (*yards, *runs)) < 5.0
