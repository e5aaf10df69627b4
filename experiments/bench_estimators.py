"""Time per detection of every estimator of one object, of Stone Soup in the same run, and of bare LAPACK and gtsam.

One car drives a bend at 65 m/s, seen by the paper's sensors: LiDAR 20 Hz x, y, 151 ms late; RADAR 20 Hz x, y, speed,
62 ms late. The estimators get the detections in order of arrival and put each in its place: a LiDAR detection has two
RADAR detections to be applied again behind it. Stone Soup gets the same in order of stamps, one prediction and one
update each, with its constant turn (state x, vx, y, vy, turn rate) and its own numeric Jacobians; its smoother goes
back over the window after every update. Were it to rewind for late detections as `ekf-replay` does, it would need a
prediction and an update for each applied again.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from statistics import median

import numpy as np
from bench_tracker import Clock

import fgtrack
from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV

MOTION = CTRV()
START = np.array([0.0, 0.0, 0.3, 65.0, 0.05])  # x, y, yaw, speed, yaw rate
SENSORS = (  # first stamp, delay, standard deviation of each component
    (0.05, 0.151, {"x_m": 0.3, "y_m": 0.3}),
    (0.07, 0.062, {"x_m": 3.0, "y_m": 3.0, "speed_mps": 0.2}),
)
PERIOD_S = 0.05
_APPLIED = (UpdateStatus.IN_SEQUENCE, UpdateStatus.OUT_OF_SEQUENCE)


@dataclass(frozen=True)
class PerDetection:
    """Time of each detection, in order of arrival, in one pass."""

    times_us: list[float]
    late: list[bool]
    """Whether it was fused out of sequence; empty where everything came in sequence."""
    position_m: FloatArray
    """At the end, shape (2,)."""

    def median_us(self, late: bool | None = None) -> float:
        """Median of all, or of those late or not; NaN without any."""
        chosen = (
            self.times_us
            if late is None
            else [t for t, is_ in zip(self.times_us, self.late, strict=True) if is_ is late]
        )
        return median(chosen) if chosen else float("nan")

    @property
    def p99_us(self) -> float:
        """99 % quantile of all."""
        return float(np.quantile(self.times_us, 0.99))


def stream(duration_s: float) -> list[Measurement]:
    """Measurements of the car in order of arrival."""
    rng = np.random.default_rng(0)
    arrivals: list[tuple[float, Measurement]] = []
    for first_s, delay_s, std in SENSORS:
        model = measurement_model(tuple(std), MOTION)
        stds = np.array(list(std.values()))
        for stamp_s in np.arange(first_s, duration_s, PERIOD_S):
            z = model.predict(MOTION.predict(START, stamp_s)) + stds * rng.standard_normal(len(stds))
            arrivals.append((stamp_s + delay_s, Measurement(nanoseconds(stamp_s), model, z, np.diag(stds**2))))
    return [measurement for _, measurement in sorted(arrivals, key=lambda arrival: arrival[0])]


def truth_m(duration_s: float) -> FloatArray:
    """Where the car is at the end, shape (2,)."""
    return MOTION.predict(START, duration_s)[:2]


def prior() -> Start:
    """What is known of the car at first."""
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


def run_estimator(
    name: str, measurements: Sequence[Measurement], duration_s: float, clock: Clock = time.perf_counter_ns
) -> PerDetection:
    """One pass of an estimator by name, with a window of 1 s."""
    estimator = fgtrack.estimator(name, MOTION, prior(), lag_s=1.0)
    times_us, late = [], []
    for measurement in measurements:
        before_ns = clock()
        result = estimator.update(measurement)
        times_us.append((clock() - before_ns) / 1e3)
        late.append(result.status is UpdateStatus.OUT_OF_SEQUENCE)
    return PerDetection(times_us, late, estimator.state_at(nanoseconds(duration_s)).mean[:2])


def num_applied(measurements: Sequence[Measurement]) -> list[int]:
    """How many measurements are applied when each arrives: it and those of newer stamps that came before it."""
    stamps_ns = [measurement.stamp_ns for measurement in measurements]
    return [1 + sum(older > stamp_ns for older in stamps_ns[:k]) for k, stamp_ns in enumerate(stamps_ns)]


def run_stone_soup(
    measurements: Sequence[Measurement], smooth_s: float = 0.0, clock: Clock = time.perf_counter_ns
) -> PerDetection:
    """Stone Soup's EKF in order of stamps; where `smooth_s` > 0, its smoother over that window after each update, too.

    Raises `ImportError` where Stone Soup is not installed.
    """
    from bench_stone_soup import PositionSpeed
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.nonlinear import ConstantTurn
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.smoother.kalman import ExtendedKalmanSmoother
    from stonesoup.types.array import StateVector
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    epoch = datetime(2024, 1, 1)
    transition = ConstantTurn(np.array([0.05, 0.05]), MOTION.yaw_rate_density_rad2ps3)
    predictor, updater = ExtendedKalmanPredictor(transition), ExtendedKalmanUpdater(None)
    smoother = ExtendedKalmanSmoother(transition)
    _, _, yaw, speed, yaw_rate = START.tolist()
    mean = StateVector([0.0, speed * np.cos(yaw), 0.0, speed * np.sin(yaw), yaw_rate])
    state = GaussianState(mean, np.diag([1.0, 9.0, 1.0, 9.0, 0.09]), timestamp=epoch)
    states, times_us = [], []
    for measurement in sorted(measurements, key=lambda m: m.stamp_ns):
        is_lidar = len(measurement.z) == 2
        model = LinearGaussian(5, (0, 2), measurement.R) if is_lidar else PositionSpeed(5, (0, 2), measurement.R)
        stamp = epoch + timedelta(seconds=seconds(measurement.stamp_ns))
        detection = Detection(measurement.z[:, None], timestamp=stamp, measurement_model=model)
        before_ns = clock()
        predicted = predictor.predict(state, timestamp=stamp)
        state = updater.update(SingleHypothesis(predicted, detection))
        if smooth_s:
            states = [one for one in (*states, state) if (stamp - one.timestamp).total_seconds() <= smooth_s]
            smoother.smooth(Track(states))
        times_us.append((clock() - before_ns) / 1e3)
    return PerDetection(times_us, [], np.array(state.state_vector[[0, 2], 0], dtype=float))


def lapack_us(tracks: int, rows: int) -> float:
    """Elimination and back-substitution of `rows` rows of a block-tridiagonal system for all tracks, bare LAPACK calls.

    Of every row the Cholesky factor of its 5 x 5 block, the solution for the coupling to the next row and the product
    that it takes off there; then the solution backwards. Nothing is linearised, nothing is looked up.
    """
    rng = np.random.default_rng(0)
    coupling = rng.normal(size=(rows, tracks, 5, 5))
    diagonal = 20.0 * np.eye(5) + coupling @ coupling.transpose(0, 1, 3, 2)
    right = rng.normal(size=(rows, tracks, 5, 1))

    def once() -> None:
        block, vector, kept = diagonal[0], right[0], []
        for row in range(rows):
            np.linalg.cholesky(block)
            gain = np.linalg.solve(block, np.concatenate([coupling[row], vector], axis=-1))
            kept.append(gain)
            if row + 1 < rows:
                transposed = coupling[row].transpose(0, 2, 1)
                block = diagonal[row + 1] - transposed @ gain[..., :5]
                vector = right[row + 1] - transposed @ gain[..., 5:]
        x = kept[-1][..., 5:]
        for gain in reversed(kept[:-1]):
            x = gain[..., 5:] - gain[..., :5] @ x

    return _median_us(once)


def gtsam_us(tracks: int, rows: int) -> float:
    """gtsam's own elimination and back-substitution of a chain of `rows` Gaussian nodes, one track after another."""
    import gtsam

    rng, graph = np.random.default_rng(0), gtsam.GaussianFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(5)
    for row in range(rows):
        graph.add(row, np.eye(5), rng.normal(size=5), unit)
        if row:
            graph.add(row - 1, rng.normal(size=(5, 5)), row, -np.eye(5), rng.normal(size=5), unit)
    ordering = gtsam.Ordering()
    for row in range(rows):
        ordering.push_back(row)

    def once() -> None:
        for _ in range(tracks):
            graph.eliminateSequential(ordering).optimize()

    return _median_us(once)


def _median_us(once: Callable[[], None], repeats: int = 30) -> float:
    """Median time of a call."""
    times = []
    for _ in range(repeats):
        before_ns = time.perf_counter_ns()
        once()
        times.append(time.perf_counter_ns() - before_ns)
    return median(times) / 1e3
