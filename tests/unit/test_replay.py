"""Filters that rewind and replay: what they say of a late measurement."""

import numpy as np
import pytest

from fgtrack.estimation.base import Estimator, Measurement
from fgtrack.estimation.dense_joint import dense_joint
from fgtrack.estimation.oosm import ReorderBuffer
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.motion import CTRV, CV
from fgtrack.testing.streams import LINEAR, MS, START, Stream, measured, shuffled

POSITION = ("x_m", "y_m")


def innovations(estimator: Estimator, stream: Stream) -> list[np.ndarray]:
    found = []
    for measurement in stream.measurements:
        result = estimator.update(measurement)
        assert result.innovation is not None
        assert result.nis is not None
        found.append(np.append(result.innovation, result.nis))
    return found


def expected(stream: Stream) -> list[np.ndarray]:
    """Innovation and NIS of each measurement given all that came before it, from the dense joint posterior."""
    found = []
    for k, m in enumerate(stream.measurements):
        state = dense_joint(stream.motion, START, stream.measurements[:k], [m.stamp_ns])[m.stamp_ns]
        H = m.model.selection(stream.motion.dim)
        y = m.z - H @ state.mean
        found.append(np.append(y, y @ np.linalg.solve(H @ state.covariance @ H.T + m.R, y)))
    return found


@pytest.mark.parametrize("seed", range(20))
def test_innovations_are_predicted_from_everything_that_came_before_whatever_its_stamp(seed: int) -> None:
    stream = shuffled(LINEAR, np.random.default_rng(seed))
    for estimator in (ReplayEkf(LINEAR, START, 1.0), ReorderBuffer(LINEAR, START, 1.0, 1.0)):
        np.testing.assert_allclose(innovations(estimator, stream), expected(stream), rtol=1e-9, atol=1e-9)


def test_a_late_copy_of_what_was_measured_right_after_it_is_no_surprise() -> None:
    motion, rng = CTRV(), np.random.default_rng(3)
    estimator = ReplayEkf(motion, START, 1.0)
    for k in range(1, 8):
        estimator.update(measured(rng, motion, k * 100 * MS, POSITION))
    off = measured(rng, motion, 800 * MS, POSITION)
    far = Measurement(off.stamp_ns, off.model, off.z + 5.0, 1e-6 * np.eye(2))
    assert (estimator.update(far).nis or 0.0) > 10.0
    again = Measurement(far.stamp_ns - 1000, far.model, far.z, 1e-4 * np.eye(2))
    assert (estimator.update(again).nis or 0.0) < 1.0


def test_a_late_heading_on_the_other_side_of_half_a_turn_is_predicted_on_the_short_way() -> None:
    motion, names = CTRV(), (*POSITION, "yaw_rad")
    model = measured(np.random.default_rng(0), motion, 0, names).model
    estimator = ReplayEkf(motion, START, 1.0)
    z = np.array([[10.0, 0.0, 3.1], [9.0, 0.0, -3.1], [9.5, 0.0, 3.14]])
    for offset_ms, each in zip((100, 200, 150), z, strict=True):
        result = estimator.update(Measurement(START.stamp_ns + offset_ms * MS, model, each, 1e-4 * np.eye(3)))
    assert result.innovation is not None
    assert abs(result.innovation[2]) < 0.1


def test_what_comes_in_sequence_is_predicted_from_the_newest_state() -> None:
    estimator, rng = ReplayEkf(CV(), START, 1.0), np.random.default_rng(1)
    for k in range(1, 5):
        measurement = measured(rng, CV(), k * 100 * MS, POSITION)
        predicted = estimator.state_at(measurement.stamp_ns).mean[:2]
        np.testing.assert_array_equal(estimator.update(measurement).innovation, measurement.z - predicted)
