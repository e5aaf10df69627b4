"""Steps of the smoother that go further than their linearisation holds are taken again with damping."""

import numpy as np
import pytest

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.failures import Failure
from fgtrack.estimation.object_bank import state_of
from fgtrack.estimation.smoothing.bank import SmootherBank
from fgtrack.estimation.smoothing.gtsam.batch import BatchBank
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalBank
from fgtrack.models.measurement import SensorPose, measurement_model
from fgtrack.models.motion import CTRV, CV, Transition
from fgtrack.models.sensors import RobustLoss

STD_RAD, RANGE_STD_M, STEP_S = np.deg2rad(0.1), 60.0, 0.2
MOTION = CV(velocity_density_m2ps3=0.05)
MODEL = measurement_model(("bearing_rad",), MOTION)


def heard(rng: np.random.Generator) -> tuple[list[Measurement], FloatArray]:
    """Bearings of an object 100 m away, give or take 60 m, from an observer that turns after 5 s; where it is last."""
    x = np.array(
        [
            max(100.0 + RANGE_STD_M * rng.standard_normal(), 10.0),
            0.0,
            *(10.0 * rng.standard_normal(2)),
        ]
    )
    place, found = np.zeros(2), []
    for k in range(51):
        pose = SensorPose(float(place[0]), float(place[1]))
        z = MODEL.predict(x, pose) + STD_RAD * rng.standard_normal(1)
        found.append(
            Measurement(
                round(k * STEP_S * NS_PER_S), MODEL, z, np.array([[STD_RAD**2]]), pose
            )
        )
        last, x = x, MOTION.predict(x, STEP_S)
        course_rad = np.interp(k * STEP_S, [5.0, 7.0], [0.0, 0.5 * np.pi])
        place = place + 20.0 * STEP_S * np.array(
            [np.cos(course_rad), np.sin(course_rad)]
        )
    return found, last


SPREAD = np.diag([RANGE_STD_M**2, (100.0 * STD_RAD) ** 2])
BIRTH = Start(position_m=(100.0, 0.0), position_covariance=SPREAD, speed_std_mps=10.0)


def tracked(streams: list[list[Measurement]], make: type[SmootherBank]) -> SmootherBank:
    """All objects in one bank."""
    bank = make(MOTION, 20.0)
    for track_id in range(len(streams)):
        bank.birth(track_id, BIRTH)
    for measurements in zip(*(stream[1:] for stream in streams), strict=True):
        bank.update(measurements[0].stamp_ns, range(len(streams)), measurements)
    return bank


@pytest.mark.slow
def test_bearings_alone_lead_where_levenberg_marquardt_does() -> None:
    found = [heard(np.random.default_rng(seed)) for seed in (2,)]
    streams = [stream for stream, _ in found]
    slow, *banks = (
        tracked(streams, each) for each in (BatchBank, SmootherBank, IncrementalBank)
    )
    assert not slow.failures.counts
    for bank in banks:
        assert bank.failures.counts[Failure.STEP_DAMPED] > 0
        for track_id, (measurements, truth) in enumerate(found):
            state, expected = (
                state_of(each, MOTION, track_id, measurements[-1].stamp_ns)
                for each in (bank, slow)
            )
            std = np.sqrt(np.diag(expected.covariance))
            assert np.abs((state.mean - expected.mean) / std).max() < 0.1
            d = state.mean - truth
            assert (
                d @ np.linalg.solve(state.covariance, d) < 23.5
            )  # one in ten thousand


def test_positions_need_none() -> None:
    model = measurement_model(("x_m", "y_m"), MOTION)
    fixes = [
        Measurement(k * NS_PER_S, model, np.array([5.0 * k, 1.0]), np.eye(2))
        for k in range(5)
    ]
    assert not tracked([fixes], SmootherBank).failures.counts


class OwnTransition(CTRV):
    """CTRV as a model that is not compiled."""

    def transition(self, x: FloatArray, dt_s: float | FloatArray) -> Transition:
        return super().transition(x, dt_s)


def test_the_compiled_cost_of_a_window_is_that_of_its_models() -> None:
    """With a robust loss, a prior of left states, and stamps 1 us apart, whose process noise is almost singular."""
    rng, banks = np.random.default_rng(5), [SmootherBank(CTRV(), 0.8)]
    banks.append(SmootherBank(OwnTransition(), 0.8))
    loss = RobustLoss("huber", 1.0)
    times_s = (0.1, 0.3, 0.5, 0.500002, 0.7, 1.2, 0.9)
    for bank in banks:
        bank.birth(0, Start(position_m=(20.0, 5.0), yaw_rad=0.3, speed_mps=9.0))
    for time_s in times_s:
        measurement = Measurement.of(
            round(time_s * NS_PER_S),
            range_m=20.0 + 9.0 * time_s + rng.normal(),
            bearing_rad=0.25 + 0.1 * rng.normal(),
            std={"range_m": 0.5, "bearing_rad": 0.02},
            loss=loss,
        )
        for bank in banks:
            bank.update(measurement.stamp_ns, [0], [measurement])
    compiled, numpy = (bank.solver for bank in banks)
    estimates = compiled.estimates(0)
    assert len(estimates) == 6
    for _ in range(10):
        means = estimates + 0.1 * rng.normal(size=estimates.shape)
        expected = numpy._cost(0, means)
        assert expected > 10.0
        assert compiled._cost(0, means) == pytest.approx(expected, rel=1e-6)
