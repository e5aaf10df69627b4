"""Several hypotheses at the start of an object, until one is left."""

from dataclasses import replace
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from support.examples import slow

import fgtrack
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import YAW, FloatArray
from fgtrack.estimation import starts
from fgtrack.estimation.base import Estimator, Measurement, Start, UpdateStatus
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.hypotheses import Hypotheses
from fgtrack.estimation.registry import ESTIMATORS, Claims, start_estimator
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRV, CV, MotionModel

MS = 1_000_000
STD = {"x_m": 0.5, "y_m": 0.5}
START = Start(position_std_m=0.5, speed_mps=15.0, speed_std_mps=3.0)


def at(ms: int, x_m: float, y_m: float) -> Measurement:
    return Measurement.of(ms * MS, x_m=x_m, y_m=y_m, std=STD)


def joint_density(motion: MotionModel, start: Start, measurements: list[Measurement]) -> float:
    """log p(z_1, ..., z_n) of positions in a linear model, from their joint covariance."""
    x, P = initial_state(motion, start)
    ordered = sorted(measurements, key=lambda m: m.stamp_ns)
    F = [motion.jacobian(x, m.stamp_ns / 1e9) for m in ordered]
    mean, S = np.concatenate([(each @ x)[:2] for each in F]), np.zeros((2 * len(ordered), 2 * len(ordered)))
    for j, first in enumerate(ordered):
        until = F[j] @ P @ F[j].T + motion.process_noise(x, first.stamp_ns / 1e9)
        for k, later in enumerate(ordered[j:], start=j):
            on = motion.jacobian(x, (later.stamp_ns - first.stamp_ns) / 1e9)
            S[2 * k : 2 * k + 2, 2 * j : 2 * j + 2] = (on @ until)[:2, :2]
            S[2 * j : 2 * j + 2, 2 * k : 2 * k + 2] = (on @ until)[:2, :2].T
        S[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] += first.R
    return float(multivariate_normal.logpdf(np.concatenate([m.z for m in ordered]), mean, S))


@pytest.mark.parametrize("name", ["ekf-replay", "ukf-replay", "smoother", "smoother-banded"])
def test_the_weights_are_those_of_the_joint_density_in_any_order(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgtrack.estimation.hypotheses.SAME", 0.0)
    motion = CV(2.0)
    spreads = (0.0, 0.5), (0.7, 2.0), (-0.4, 1.0)
    given = [replace(START, position_m=(x_m, 0.0), position_std_m=std_m) for x_m, std_m in spreads]
    measurements = [at(100, 0.5, 0.2), at(250, 1.2, 0.1), at(400, 1.4, -0.6)]
    logs = np.array([joint_density(motion, start, measurements) for start in given])
    expected = np.exp(logs - logs.max()) / np.exp(logs - logs.max()).sum()
    for order in permutations(measurements):
        estimator = fgtrack.estimator(name, motion, START, hypotheses=given)
        assert isinstance(estimator, Hypotheses)
        for measurement in order:
            estimator.update(measurement)
        np.testing.assert_allclose(sorted(estimator.weights), sorted(expected), rtol=1e-6)


@pytest.mark.parametrize("name", ["ekf-replay", "ukf-replay", "iplf-replay", "smoother", "rts", "ekf-backward-forward"])
def test_of_several_headings_the_right_one_is_left(name: str) -> None:
    estimator = fgtrack.estimator(name, CTRV(), START, hypotheses=8)
    assert isinstance(estimator, Hypotheses)
    for k in range(1, 31):
        result = estimator.update(at(50 * k, -0.6 * k, 0.4 * k))
        assert result.status is UpdateStatus.IN_SEQUENCE
    assert abs(wrap_angle(estimator.state_at(1500 * MS).mean[YAW] - np.arctan2(0.4, -0.6))) < 0.1
    assert len(estimator.estimators) == 1
    assert estimator.weights.tolist() == [1.0]


def ranges(xy_m: FloatArray, num: int) -> list[Measurement]:
    """Of an object at rest from a sensor that drives along x and then turns."""
    found = []
    for k in range(1, num + 1):
        pose = SensorPose(min(2.0 * k, 40.0), max(0.0, 2.0 * k - 40.0))
        range_m = float(np.hypot(*(xy_m - np.array([pose.x_m, pose.y_m]))))
        found.append(Measurement.of(100 * k * MS, range_m=range_m, std={"range_m": 0.3}, pose=pose))
    return found


@pytest.mark.parametrize("name", ["ekf-replay", "iekf-replay", "smoother"])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_both_places_of_two_ranges_live_until_the_sensor_turns(name: str, side: float) -> None:
    truth = np.array([15.0, side * 30.0])
    measurements = ranges(truth, 40)
    seen = [measurements[k] for k in (0, 19)]
    at_rest = Start(yaw_rad=0.0, yaw_std_rad=0.1, speed_std_mps=0.1)
    places_m, ranges_m = [each.pose[:2] for each in seen], [float(each.z[0]) for each in seen]
    given = starts.intersections(at_rest, places_m, ranges_m, 0.3)
    np.testing.assert_allclose([each.position_m for each in given], [[15.0, 30.0], [15.0, -30.0]], atol=1e-9)
    estimator = fgtrack.estimator(name, CTRV(), given[0], hypotheses=given, lag_s=5.0)
    for measurement in measurements[:19]:
        estimator.update(measurement)
    assert isinstance(estimator, Hypotheses)
    assert len(estimator.estimators) == 2  # the sensor has driven straight on: both are as good
    mixture = estimator.mixture_at(1900 * MS)
    assert abs(mixture.mean[1]) < 3.0
    assert mixture.covariance[1, 1] > 25.0**2
    for measurement in measurements[19:]:
        estimator.update(measurement)
    assert len(estimator.estimators) == 1
    assert np.hypot(*(estimator.state_at(4000 * MS).mean[:2] - truth)) < 1.0


@pytest.mark.parametrize("name", ["ekf-replay", *slow("smoother", "rts")])
def test_the_contract_holds_with_several_hypotheses(name: str) -> None:
    """A second one beside the true start, that is not dropped at once."""
    made = ESTIMATORS.load(name)

    def several(motion: MotionModel, start: Start, lag_s: float) -> Estimator:
        given = [start, replace(start, speed_mps=start.speed_mps + 9.0)]
        return start_estimator(name, made, motion, start, lag_s, {"hypotheses": given})

    # of two starts it is the likelier one, and which is dropped first depends on the order
    vars(several).update({**vars(Claims.of(made)), "initiates": True, "exact": "", "nonlinear": "never"})
    checks = fgtrack.testing.estimator_checks(several, seed=3, num_streams=3)
    del checks["is the kalman filter in sequence"]
    for check in checks.values():
        check()


@pytest.mark.parametrize(
    ("wanted", "text"),
    [(0, "at least 1, is 0"), ([replace(START, stamp_ns=5)], "one and the same stamp"), ([], "at least one start")],
)
def test_what_makes_no_sense_is_refused(wanted: Any, text: str) -> None:
    with pytest.raises(fgtrack.CallError, match=text):
        fgtrack.estimator("ekf-replay", CTRV(), START, hypotheses=wanted)


def test_two_that_have_become_the_same_are_as_probable_as_both(monkeypatch: pytest.MonkeyPatch) -> None:
    given = [replace(START, yaw_rad=0.0, speed_mps=speed_mps) for speed_mps in (15.0, 15.1, 30.0)]
    found = []
    for same in (0.0, 1.0):
        monkeypatch.setattr("fgtrack.estimation.hypotheses.SAME", same)
        estimator = fgtrack.estimator("ekf-replay", CTRV(), START, hypotheses=given)
        estimator.update(at(100, 1.5, 0.0))
        assert isinstance(estimator, Hypotheses)
        found.append(estimator.weights)
    separate, joined = found
    assert separate[2] < 0.1  # the third is another one, and less probable
    np.testing.assert_allclose(joined, [separate[0] + separate[1], separate[2]], rtol=1e-9)


def test_a_measurement_that_no_hypothesis_takes_changes_nothing() -> None:
    estimator = fgtrack.estimator("ekf-replay", CTRV(), START, hypotheses=4)
    assert isinstance(estimator, Hypotheses)
    before = estimator.weights
    result = estimator.update(replace(at(100, 1.0, 1.0), R=np.full((2, 2), np.nan)))
    assert result.status is UpdateStatus.FAILED
    np.testing.assert_array_equal(estimator.weights, before)
    assert estimator.update(at(-100, 1.0, 1.0)).status is UpdateStatus.TOO_OLD
    assert len(estimator.estimators) == 4


def test_headings_share_the_circle_and_keep_the_spread_of_the_speed() -> None:
    found = starts.headings(replace(START, speed_mps=0.0, speed_std_mps=40.0), 8)
    np.testing.assert_allclose(sorted(each.yaw_rad or 0.0 for each in found), np.arange(-3, 5) * np.pi / 4, atol=1e-12)
    assert found[0].yaw_std_rad == pytest.approx(np.pi / 4 / np.sqrt(12.0))
    assert found[0].speed_mps == pytest.approx(40.0 * np.sqrt(2.0 / np.pi))
    assert found[0].speed_mps ** 2 + found[0].speed_std_mps ** 2 == pytest.approx(40.0**2)
    fast = starts.headings(START, 2)[0]  # a sign that is known is not folded
    assert (fast.speed_mps, fast.speed_std_mps) == pytest.approx((15.0, 3.0), abs=1e-3)
    with pytest.raises(fgtrack.CallError, match="at least 2"):
        starts.headings(START, 1)


def test_distances_are_equally_uncertain_in_relation() -> None:
    found = starts.distances(START, (10.0, 5.0), np.pi / 2, 0.01, 20.0, 320.0, 4)
    away = [np.asarray(each.position_m) - np.array([10.0, 5.0]) for each in found]
    np.testing.assert_allclose([each[1] for each in away], [30.0, 60.0, 120.0, 240.0])
    for each, offset in zip(found, away, strict=True):
        std_m = np.sqrt(np.diag(np.asarray(each.position_covariance)))
        assert std_m[1] / offset[1] == pytest.approx(20.0 / np.sqrt(12.0) / 30.0)
        assert std_m[0] == pytest.approx(0.01 * offset[1])
    with pytest.raises(fgtrack.CallError, match="nearest"):
        starts.distances(START, (0.0, 0.0), 0.0, 0.01, 20.0, 10.0, 3)


def test_circles_that_do_not_meet_touch() -> None:
    found = starts.intersections(START, [(0.0, 0.0), (10.0, 0.0)], [4.0, 5.0], 0.3)
    assert len(found) == 1
    assert 4.0 < found[0].position_m[0] < 5.0
    with pytest.raises(fgtrack.CallError, match="two sensor positions are the same"):
        starts.intersections(START, [(1.0, 2.0), (1.0, 2.0)], [4.0, 5.0], 0.3)
