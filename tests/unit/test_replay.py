"""Filters that rewind and replay: what they say of a late measurement."""

from itertools import permutations

import numpy as np
import pytest
from support.examples import slow

from fgtrack.core.time import nanoseconds
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.oosm.buffers import ReorderBuffer
from fgtrack.estimation.registry import estimator, estimator_bank
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRV
from fgtrack.testing.references import dense_joint
from fgtrack.testing.streams import LINEAR, MS, START, Stream, measured, shuffled

POSITION = ("x_m", "y_m")
LAG_S = 1.0
HERE = SensorPose()
SEEN = Start(
    stamp_ns=10**11,
    position_m=(6.0, 3.0),
    yaw_rad=0.3,
    yaw_std_rad=0.3,
    speed_mps=10.0,
    speed_std_mps=3.0,
)


def radar(
    stamp_ns: int, range_m: float, bearing_rad: float, pose: SensorPose = HERE
) -> Measurement:
    std = {"range_m": 0.2, "bearing_rad": 0.03}
    return Measurement.of(
        stamp_ns, range_m=range_m, bearing_rad=bearing_rad, std=std, pose=pose
    )


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
        state = dense_joint(
            stream.motion, START, stream.measurements[:k], [m.stamp_ns]
        )[m.stamp_ns]
        H = m.model.selection(stream.motion.dim)
        y = m.z - H @ state.mean
        found.append(
            np.append(y, y @ np.linalg.solve(H @ state.covariance @ H.T + m.R, y))
        )
    return found


@pytest.mark.parametrize("seed", range(3))
def test_innovations_are_predicted_from_everything_that_came_before_whatever_its_stamp(
    seed: int,
) -> None:
    stream = shuffled(LINEAR, np.random.default_rng(seed))
    for each in (ReplayEkf(LINEAR, START, 1.0), ReorderBuffer(LINEAR, START, 1.0, 1.0)):
        np.testing.assert_allclose(
            innovations(each, stream), expected(stream), rtol=1e-9, atol=1e-9
        )


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


def test_a_late_heading_on_the_other_side_of_half_a_turn_is_predicted_on_the_short_way() -> (
    None
):
    motion, names = CTRV(), (*POSITION, "yaw_rad")
    model = measured(np.random.default_rng(0), motion, 0, names).model
    estimator = ReplayEkf(motion, START, 1.0)
    z = np.array([[10.0, 0.0, 3.1], [9.0, 0.0, -3.1], [9.5, 0.0, 3.14]])
    for offset_ms, each in zip((100, 200, 150), z, strict=True):
        result = estimator.update(
            Measurement(START.stamp_ns + offset_ms * MS, model, each, 1e-4 * np.eye(3))
        )
    assert result.innovation is not None
    assert abs(result.innovation[2]) < 0.1


@pytest.mark.parametrize(
    "name",
    ["ekf-replay", *slow("iekf-replay", "ukf-replay", "iplf-replay", "imm-replay")],
)
@pytest.mark.parametrize("after_s", [0.0, LAG_S], ids=["birth", "oldest"])
def test_on_the_oldest_stamp_of_the_window_the_order_of_arrival_does_not_matter(
    name: str, after_s: float
) -> None:
    """Ranges and bearings, of which the first to be fused decides where the others are linearised."""
    stamp_ns = SEEN.stamp_ns + nanoseconds(after_s)
    poses = (HERE, SensorPose(1.0, 1.0, 0.1), HERE)
    there = [
        radar(stamp_ns, r, b, pose)
        for r, b, pose in zip((6.5, 5.0, 6.0), (0.5, 0.35, 0.45), poses, strict=True)
    ]
    newest = radar(stamp_ns + nanoseconds(LAG_S), 17.0, 0.35)
    found = []
    for order in permutations(there):
        arrived = (order[0], newest, *order[1:])
        tracked, bank = (
            estimator(name, CTRV(), SEEN, lag_s=LAG_S),
            estimator_bank(name, CTRV(), LAG_S, {}),
        )
        tracks = range(8)  # in arrays, where the estimator has them
        for track in tracks:
            bank.birth(track, SEEN)
        for measurement in arrived:
            assert tracked.update(measurement).innovation is not None
            bank.update(measurement.stamp_ns, tracks, [measurement] * len(tracks))
        state, together = (
            tracked.state_at(newest.stamp_ns),
            bank.states_at(newest.stamp_ns),
        )
        found.append(
            (state.mean, state.covariance, together.means, together.covariances)
        )
    for later in found[1:]:
        for one, other in zip(found[0], later, strict=True):
            np.testing.assert_array_equal(one, other)
