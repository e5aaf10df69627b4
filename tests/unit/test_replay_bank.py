"""The replaying EKFs of many tracks in arrays are those of each track by itself."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from support.examples import few

from fgtrack.core.time import nanoseconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start, UpdateStatus
from fgtrack.estimation.filters.replay import ReplayEkf
from fgtrack.estimation.filters.replay_bank import ReplayBank
from fgtrack.estimation.object_bank import ObjectBank
from fgtrack.estimation.registry import estimator_bank
from fgtrack.models.measurement import (
    AT_ORIGIN,
    MeasurementModel,
    SensorPose,
    measurement_model,
)
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.streams import MS, START

LAG_S = 0.6


KINDS = (
    ("x_m", "y_m"),
    ("x_m", "y_m", "speed_mps"),
    ("x_m", "y_m", "yaw_rad"),
    ("range_m", "bearing_rad"),
)
LOSSES = (None, None, None, RobustLoss("huber", 1.0))


class Squared(MeasurementModel):
    """A measurement model that compiled loops do not contain: the first component is squared, in hectometres."""

    linear = False

    def predict(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        h = measurement_model(self.components, CTRV()).predict(x, pose)
        h = np.array(h)
        h[..., 0] *= 0.01 * h[..., 0]
        return h

    def jacobian(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        plain = measurement_model(self.components, CTRV())
        H = np.array(plain.jacobian(x, pose))
        H[..., 0, :] *= 0.02 * plain.predict(x, pose)[..., 0, None]
        return H


class Banks:
    """The bank and, as what it has to agree with, one estimator for each object."""

    def __init__(self, motion: MotionModel, initiation: str = "regression") -> None:
        self.motion = motion
        self.expected = ObjectBank(
            motion, lambda start: ReplayEkf(motion, start, LAG_S, initiation), LAG_S
        )
        self.found = ReplayBank(motion, LAG_S, initiation)

    def advance(self, now_ns: int) -> None:
        self.expected.advance(now_ns)
        self.found.advance(now_ns)

    def birth(self, track_id: int, start: Start) -> None:
        self.expected.birth(track_id, start)
        self.found.birth(track_id, start)

    def remove(self, track_id: int) -> None:
        self.expected.remove(track_id)
        self.found.remove(track_id)

    def update(
        self, stamp_ns: int, track_ids: list[int], measurements: list[Measurement]
    ) -> list[UpdateStatus]:
        found = self.found.update(stamp_ns, track_ids, measurements)
        for one, other in zip(
            found, self.expected.update(stamp_ns, track_ids, measurements), strict=True
        ):
            assert one.status is other.status
            assert (one.innovation is None) is (other.innovation is None)
            if one.innovation is not None:
                np.testing.assert_allclose(
                    one.innovation, other.innovation, rtol=1e-9, atol=1e-9
                )
                np.testing.assert_allclose(one.nis, other.nis, rtol=1e-8, atol=1e-9)
                np.testing.assert_allclose(
                    one.innovation_covariance,
                    other.innovation_covariance,
                    rtol=1e-9,
                    atol=1e-9,
                )
        self.agree(stamp_ns)
        return [one.status for one in found]

    def agree(self, stamp_ns: int) -> None:
        assert self.found.track_ids == self.expected.track_ids
        assert self.found.window_start_ns == self.expected.window_start_ns
        one, other = self.found.states_at(stamp_ns), self.expected.states_at(stamp_ns)
        assert one.track_ids == other.track_ids
        np.testing.assert_allclose(one.means, other.means, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            one.covariances, other.covariances, rtol=1e-9, atol=1e-9
        )
        for track_id, mean in zip(one.track_ids, one.means, strict=True):
            np.testing.assert_array_equal(
                self.found.states_of(stamp_ns, track_id).means, [mean]
            )
        for state, same in zip(
            self.found.present(), self.expected.present(), strict=True
        ):
            assert state.stamp_ns == same.stamp_ns
            np.testing.assert_allclose(state.mean, same.mean, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(
                state.covariance, same.covariance, rtol=1e-9, atol=1e-9
            )


def drawn(rng: np.random.Generator, motion: MotionModel, offset_ns: int) -> Measurement:
    """Something measured of an object that drives on about a straight line."""
    names = KINDS[rng.integers(len(KINDS))]
    model, pose = (
        measurement_model(names, motion),
        SensorPose(-40.0, 5.0, 0.3, 3.0, 0.0),
    )
    travelled_m = 20.0 * offset_ns * 1e-9
    state = {
        "x_m": 3.0 + travelled_m * 0.92,
        "y_m": -2.0 + travelled_m * 0.39,
        "yaw_rad": 0.4,
        "speed_mps": 20.0,
    }
    state |= {"vx_mps": 18.4, "vy_mps": 7.8}
    std = np.array(
        [
            0.02 if name == "bearing_rad" else 0.1 if name == "yaw_rad" else 0.5
            for name in names
        ]
    )
    x = np.array([state.get(name, 0.0) for name in motion.state_names])
    if not motion.cartesian and names[0] == "range_m" and rng.random() < 0.3:
        model = Squared(names, motion.state_names)
    z = model.predict(x, pose) + std * rng.standard_normal(len(names))
    assumed = ("yaw_rad",) if "yaw_rad" in names and rng.random() < 0.5 else ()
    loss = LOSSES[rng.integers(len(LOSSES))]
    return Measurement(
        START.stamp_ns + offset_ns, model, z, np.diag(std**2), pose, loss, assumed
    )


@few
@given(
    seed=st.integers(0, 2**32 - 1),
    motion=st.sampled_from([CTRV(), CTRA(), CV()]),
    sought=st.booleans(),
)
def test_any_history_is_that_of_one_estimator_for_each_object(
    seed: int, motion: MotionModel, sought: bool
) -> None:
    rng = np.random.default_rng(seed)
    banks, now_ms, born = Banks(motion), 0, 0
    start = (
        replace(START, yaw_rad=None, yaw_std_rad=None, speed_mps=15.0)
        if sought
        else START
    )
    banks.advance(START.stamp_ns)
    for _ in range(40):
        now_ms += int(rng.integers(0, 60))
        banks.advance(START.stamp_ns + now_ms * MS)
        alive = list(banks.found.track_ids)
        if len(alive) < 4 and rng.random() < 0.4:
            late_ms = int(rng.integers(0, 100)) if now_ms > 100 else 0
            begun = start if rng.random() < 0.5 else replace(START, yaw_rad=0.3)
            banks.birth(
                born, replace(begun, stamp_ns=START.stamp_ns + (now_ms - late_ms) * MS)
            )
            born += 1
        elif alive and rng.random() < 0.06:
            banks.remove(alive[rng.integers(len(alive))])
        alive = [i for i in banks.found.track_ids if rng.random() < 0.8]
        offset_ns = (now_ms - 10 * int(rng.integers(-1, 30))) * MS
        if rng.random() < 0.05:
            offset_ns -= 2000 * MS
        measurements = [drawn(rng, motion, offset_ns) for _ in alive]
        broken = [rng.random() < 0.05 for _ in alive]
        measurements = [
            replace(m, z=m.z * np.nan) if bad else m
            for m, bad in zip(measurements, broken, strict=True)
        ]
        statuses = banks.update(START.stamp_ns + offset_ns, alive, measurements)
        refused = (UpdateStatus.FAILED, UpdateStatus.TOO_OLD)
        assert all(
            status in refused
            for status, bad in zip(statuses, broken, strict=True)
            if bad
        )
        banks.agree(
            START.stamp_ns + now_ms * MS - int(rng.integers(0, nanoseconds(LAG_S)))
        )


def test_a_stream_of_a_window_many_times_as_long_stays_the_same_and_small() -> None:
    """Late lists, lists of one stamp in both orders, and tracks of different ages."""
    rng, motion = np.random.default_rng(3), CTRV()
    banks = Banks(motion)
    for track_id in range(5):
        banks.birth(
            track_id, replace(START, stamp_ns=START.stamp_ns + 7 * track_id * MS)
        )
    for k in range(1, 60):
        banks.advance(START.stamp_ns + 50 * k * MS)
        for late_ms in (0, 40, 40, 95):
            offset_ns = (50 * k - late_ms) * MS
            chosen = [i for i in range(5) if rng.random() < 0.9]
            banks.update(
                START.stamp_ns + offset_ns,
                chosen,
                [drawn(rng, motion, offset_ns) for _ in chosen],
            )
    assert banks.found._arrays[0].shape == (8, 64)


def test_the_tracker_gets_the_bank_and_other_filters_are_one_for_each_object() -> None:
    assert isinstance(
        estimator_bank("ekf-replay", CTRV(), 1.0, {"initiation": "two-point"}),
        ReplayBank,
    )
    assert not isinstance(estimator_bank("rts", CTRV(), 1.0, {}), ReplayBank)
