"""The value of late detections for the present, held to closed forms of a linear model."""

from collections.abc import Sequence

import numpy as np
import pytest

from fgtrack.core.time import nanoseconds, seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateStatus
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.oosm import RewindForget
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV
from fgtrack.pipeline.information_value import ReceivedMeasurement, information_values
from fgtrack.testing.references import dense_joint

MOTION = CV(velocity_density_m2ps3=5.0)
POSITION = measurement_model(("x_m", "y_m"), MOTION)
START_NS = 1_000_000_000_000
NOW_NS = START_NS + 2_000_000_000
MS = 1_000_000
PRIOR = Start(
    stamp_ns=START_NS,
    position_m=np.array([3.0, -2.0]),
    position_covariance=9.0 * np.eye(2),
    yaw_rad=0.3,
    yaw_std_rad=0.2,
    speed_mps=20.0,
    speed_std_mps=5.0,
    yaw_rate_radps=0.0,
    yaw_rate_std_radps=0.1,
    accel_mps2=0.0,
    accel_std_mps2=1.0,
)


def fix(stamp_ns: int, std_m: float, z: Sequence[float] = (0.0, 0.0)) -> Measurement:
    return Measurement(stamp_ns, POSITION, np.array(z), std_m**2 * np.eye(2))


#: A radar without delay at 20 Hz, up to the present.
RADAR = [fix(START_NS + k * 50 * MS, 0.5) for k in range(1, 41)]


def fed(estimator: Estimator, measurements: Sequence[Measurement]) -> Estimator:
    for measurement in measurements:
        estimator.advance(measurement.stamp_ns)
        assert estimator.update(measurement).status is UpdateStatus.IN_SEQUENCE
    return estimator


def gain(estimator: Estimator, late: Measurement, receipt_ns: int = NOW_NS) -> float:
    [value] = information_values(estimator, [ReceivedMeasurement("lidar", receipt_ns, late)])
    return value.gain_nats


def log_det(P: FloatArray) -> float:
    return float(np.log(np.linalg.det(P)))


def joint_gain(measurements: Sequence[Measurement], late: Measurement) -> float:
    """What `late` adds to `measurements`, from the joint posterior of all states."""
    without, with_it = (
        dense_joint(MOTION, PRIOR, given, [NOW_NS])[NOW_NS].covariance
        for given in (measurements, [*measurements, late])
    )
    return 0.5 * (log_det(without) - log_det(with_it))


AGES_S = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.8, 1.2)


def test_the_first_detection_is_worth_the_mutual_information_with_the_present() -> None:
    """0.5 log(det S / det(S - H C' P^-1 C H')), C = F(a) P_tau the covariance of the present and the state at tau."""
    gains = []
    x, P_0 = initial_state(MOTION, PRIOR)
    H = POSITION.selection(4)
    for age_s in AGES_S:
        to_tau = 2.0 - age_s
        F = MOTION.jacobian(x, to_tau)
        P_tau = F @ P_0 @ F.T + MOTION.process_noise(x, to_tau)
        F = MOTION.jacobian(x, age_s)
        P = F @ P_tau @ F.T + MOTION.process_noise(x, age_s)
        S = H @ P_tau @ H.T + 0.09 * np.eye(2)
        HC = H @ (F @ P_tau).T
        expected = 0.5 * (log_det(S) - log_det(S - HC @ np.linalg.solve(P, HC.T)))
        gains.append(gain(ReplayEkf(MOTION, PRIOR, 5.0), fix(NOW_NS - nanoseconds(age_s), 0.3)))
        assert gains[-1] == pytest.approx(expected, rel=1e-9)
    assert np.all(np.diff(gains) < 0.0)


def test_among_others_the_gain_falls_with_age_and_is_that_of_the_joint_posterior() -> None:
    gains = []
    for age_s in AGES_S:
        late = fix(NOW_NS - nanoseconds(age_s), 0.3)
        gains.append(gain(fed(ReplayEkf(MOTION, PRIOR, 5.0), RADAR), late))
        assert gains[-1] == pytest.approx(joint_gain(RADAR, late), rel=1e-9)
    assert np.all(np.diff(gains) < 0.0)
    assert gains[0] > 0.5
    assert 0.0 < gains[-1] < 0.01


def test_gains_of_an_exact_method_add_up_whatever_the_order_of_arrival() -> None:
    lidar = [fix(NOW_NS - age * MS, 0.3) for age in (0, 90, 170, 260)]
    total = joint_gain(RADAR, lidar[0]) + sum(joint_gain([*RADAR, *lidar[:k]], lidar[k]) for k in (1, 2, 3))
    for order in ([0, 1, 2, 3], [3, 1, 0, 2]):
        arrivals = [ReceivedMeasurement("lidar", NOW_NS, lidar[k]) for k in order]
        values = list(information_values(fed(ReplayEkf(MOTION, PRIOR, 5.0), RADAR), arrivals))
        assert sum(value.gain_nats for value in values) == pytest.approx(total, rel=1e-9)


def test_a_detection_that_the_method_drops_is_worth_exactly_nothing() -> None:
    late = ReceivedMeasurement("lidar", NOW_NS, fix(NOW_NS - 500 * MS, 0.3))
    estimator = fed(ReplayEkf(MOTION, PRIOR, lag_s=0.3), RADAR)
    [value] = information_values(estimator, [late], lambda stamp_ns: np.zeros(2))
    assert (value.status, value.gain_nats, value.error_change_m) == (UpdateStatus.TOO_OLD, 0.0, 0.0)
    assert joint_gain(RADAR, late.measurement) > 0.0


def test_backward_forward_loses_more_than_it_learns_and_the_loss_grows_with_age() -> None:
    """After its update the present is the state at tau, corrected and predicted; what came after tau is gone."""
    gains = []
    for age_s in (0.05, 0.1, 0.2, 0.4):
        late = fix(NOW_NS - nanoseconds(age_s), 0.3)
        gains.append(gain(fed(RewindForget(MOTION, PRIOR, 5.0), RADAR), late))
        kept = [m for m in RADAR if m.stamp_ns <= late.stamp_ns]
        left, whole = (
            dense_joint(MOTION, PRIOR, given, [NOW_NS])[NOW_NS].covariance for given in ([*kept, late], RADAR)
        )
        assert gains[-1] == pytest.approx(0.5 * (log_det(whole) - log_det(left)), rel=1e-9)
        assert joint_gain(RADAR, late) > 0.0
    assert np.all(np.diff(gains) < 0.0)
    assert gains[0] > 0.0  # one radar detection is worth less than a lidar detection
    assert gains[1] < 0.0


def test_a_value_names_its_detection_and_says_how_the_error_changed() -> None:
    truth = np.array([7.0, -1.0])
    estimator = fed(ReplayEkf(MOTION, PRIOR, 5.0), RADAR)
    stamp_ns = NOW_NS - 151 * MS
    before = estimator.state_at(NOW_NS).mean[:2]
    arrivals = [
        ReceivedMeasurement("lidar", NOW_NS, fix(stamp_ns, 0.1, (7.0, -1.0))),
        ReceivedMeasurement("radar", NOW_NS, RADAR[-1]),
    ]
    first, second = information_values(estimator, arrivals, lambda at_ns: truth if at_ns == NOW_NS else None)
    assert (first.sensor, first.stamp_ns, first.receipt_ns, first.status) == (
        "lidar",
        stamp_ns,
        NOW_NS,
        UpdateStatus.OUT_OF_SEQUENCE,
    )
    assert (first.delay_s, second.sensor, second.delay_s) == (0.151, "radar", 0.0)
    assert first.error_change_m is not None
    assert second.error_change_m is not None
    after = estimator.state_at(NOW_NS).mean[:2]
    total_m = float(np.linalg.norm(after - truth) - np.linalg.norm(before - truth))
    assert first.error_change_m + second.error_change_m == pytest.approx(total_m)
    assert first.error_change_m < 0.0


def test_the_mean_error_falls_by_what_late_detections_tell() -> None:
    rng, changes = np.random.default_rng(0), []
    root = np.linalg.cholesky(MOTION.process_noise(np.zeros(4), 0.05))
    x, P_0 = initial_state(MOTION, PRIOR)
    for _ in range(60):
        truth = [x + np.linalg.cholesky(P_0) @ rng.standard_normal(4)]
        for _ in RADAR:
            truth.append(MOTION.predict(truth[-1], 0.05) + root @ rng.standard_normal(4))

        def seen(k: int, std_m: float, truth: Sequence[FloatArray] = truth) -> Measurement:
            return fix(START_NS + k * 50 * MS, std_m, (truth[k][:2] + std_m * rng.standard_normal(2)).tolist())

        estimator = fed(ReplayEkf(MOTION, PRIOR, 5.0), [seen(k, 0.5) for k in range(1, 41)])
        late = ReceivedMeasurement("lidar", NOW_NS, seen(38, 0.1))
        values = information_values(estimator, [late], lambda _, truth=truth: truth[-1][:2])  # type: ignore[misc]
        changes += [value.error_change_m for value in values if value.error_change_m is not None]
    assert len(changes) == 60
    assert np.mean(changes) < -3.0 * np.std(changes) / np.sqrt(60)


def test_without_truth_or_where_it_is_unknown_there_is_no_error_change() -> None:
    late = ReceivedMeasurement("lidar", NOW_NS, fix(NOW_NS, 0.3))
    for unknown in (None, lambda stamp_ns: None):
        [value] = information_values(ReplayEkf(MOTION, PRIOR, 5.0), [late], unknown)
        assert value.error_change_m is None
        assert seconds(value.receipt_ns - value.stamp_ns) == value.delay_s == 0.0
