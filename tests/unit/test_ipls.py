"""The iterated posterior linearisation smoother, beyond the contract."""

from dataclasses import replace

import numpy as np
import pytest

import fgtrack
from fgtrack.core.time import nanoseconds
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.dense_joint import dense_joint, difference
from fgtrack.estimation.ipls import PosteriorLinearisationSmoother
from fgtrack.estimation.registry import estimator, estimator_bank
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.testing.streams import LINEAR, MS, START, measured, shuffled

MOTION = CTRV()
POSITION = measurement_model(("x_m", "y_m"), MOTION)


def fix(at_s: float, yaw_rad: float, rng: np.random.Generator, speed_mps: float = 20.0) -> Measurement:
    z = at_s * speed_mps * np.array([np.cos(yaw_rad), np.sin(yaw_rad)]) + 0.2 * rng.standard_normal(2)
    return Measurement(nanoseconds(at_s), POSITION, z, 0.04 * np.eye(2))


def fed(found: Estimator, rng: np.random.Generator, num: int = 15) -> Estimator:
    for k in range(1, num):
        assert found.update(measured(rng, MOTION, k * 50 * MS, ("x_m", "y_m", "range_m"))).status == "in_sequence"
    return found


def test_converged_it_agrees_with_the_smoother_where_the_model_is_nearly_linear() -> None:
    names = "ipls", "smoother"
    one, other = (fed(estimator(name, MOTION, START, lag_s=3.0), np.random.default_rng(2)) for name in names)
    for each in (one, other):
        each.converge()  # type: ignore[attr-defined]
    for ms in (0, 100, 325, 500, 700, 800):
        mean_sigma, covariance = difference(
            one.state_at(START.stamp_ns + ms * MS), other.state_at(START.stamp_ns + ms * MS)
        )
        assert mean_sigma < 0.1
        assert covariance < 0.1


def test_states_that_leave_the_window_are_smoothed_ones_each_given_once() -> None:
    smoother = PosteriorLinearisationSmoother(LINEAR, START, 0.2)
    stream = sorted(shuffled(LINEAR, np.random.default_rng(1)).measurements, key=lambda m: m.stamp_ns)
    given = []
    for k, measurement in enumerate(stream):
        known = stream[: k + 1]
        smoother.update(measurement)
        for state in smoother.take_final():
            expected = dense_joint(LINEAR, START, known, [state.stamp_ns])[state.stamp_ns]
            assert max(difference(state, expected)) < 1e-7
            given.append(state.stamp_ns)
    given += [state.stamp_ns for state in smoother.take_rest()]
    assert given == sorted({START.stamp_ns, *(m.stamp_ns for m in stream)})


@pytest.mark.parametrize("yaw_rad", [-2.5, 1.5, 3.0])
def test_a_new_object_of_unknown_direction_is_smoothed_along_it(yaw_rad: float) -> None:
    start = Start(position_m=(0.0, 0.0), position_std_m=0.2, speed_mps=5.0, speed_std_mps=20.0)
    found, plain = (estimator("ipls", MOTION, start, initiation=how) for how in ("regression", "one-point"))
    for k in range(1, 8):
        for each in (found, plain):
            each.update(fix(0.05 * k, yaw_rad, np.random.default_rng([k, 1])))
    state = found.state_at(nanoseconds(0.35))
    assert np.cos(state.mean[2] - yaw_rad) > np.cos(0.15)
    assert abs(state.mean[3] - 20.0) < 3.0
    first = found.state_at(0)
    assert np.cos(first.mean[2] - yaw_rad) > np.cos(0.25)


def test_a_late_measurement_finds_what_was_measured_after_it() -> None:
    rng = np.random.default_rng(3)
    smoother = fed(PosteriorLinearisationSmoother(MOTION, START, 2.0), rng)
    far = measured(rng, MOTION, 800 * MS)
    smoother.update(replace(far, z=far.z + 5.0, R=1e-6 * np.eye(2)))
    again = smoother.update(replace(far, stamp_ns=far.stamp_ns - 1000, z=far.z + 5.0, R=1e-4 * np.eye(2)))
    assert (again.nis or 9.0) < 1.0


def test_a_bank_reports_lagged_and_final_states() -> None:
    bank = estimator_bank("ipls", LINEAR, 0.3, {}, lagged_s=(0.1,))
    bank.advance(START.stamp_ns)
    bank.birth(7, START)
    rng, reports = np.random.default_rng(0), []
    for k in range(1, 13):
        item = measured(rng, LINEAR, k * 50 * MS)
        bank.advance(item.stamp_ns)
        bank.update(item.stamp_ns, [7], [item])
        reports += bank.smoothed()
    bank.remove(7)
    reports += bank.smoothed()
    final = [report.state.stamp_ns for report in reports if report.lag_s is None]
    assert final == [START.stamp_ns + k * 50 * MS for k in range(13)]
    assert sum(report.lag_s == 0.1 for report in reports) == 11
    assert {report.track_id for report in reports} == {7}


def test_in_the_tracker_it_has_the_window_and_the_outputs_of_the_smoother() -> None:
    options = {"smoother.lag_s": 0.5, "smoother.lagged_s": [0.2]}
    messages = list(fgtrack.simulate("single_opponent", seed=1, duration_s=2.5))
    run, other = (
        fgtrack.replay(messages, "smoother", map="oval", estimator=name, set=options) for name in ("ipls", "smoother")
    )
    assert len(run.tracks["x_m"]) == len(other.tracks["x_m"])
    assert len(run.smoothed["x_m"]) == pytest.approx(len(other.smoothed["x_m"]), rel=0.05)
    assert np.median(np.abs(run.tracks["x_m"] - other.tracks["x_m"])) < 0.05
