"""A measurement model of a plug-in is linearised outside the compiled loops, with the same result."""

import numpy as np
import pytest

import fgtrack
from fgtrack.core.types import FloatArray
from fgtrack.estimation.registry import estimator_bank
from fgtrack.models.measurement import AT_ORIGIN, MeasurementModel, SensorPose

NAMES = ("range_m", "bearing_rad", "range_rate_mps")
MOTION = fgtrack.CTRV()
POSE = SensorPose(-60.0, 3.0, 0.1, 20.0, 1.0)
STD = np.array([0.3, 0.01, 0.2])


class Own(MeasurementModel):
    """The shipped equations, but with functions of its own."""

    calls = 0

    def predict(self, x: FloatArray, pose: SensorPose = AT_ORIGIN) -> FloatArray:
        Own.calls += 1
        return super().predict(x, pose)


def states(estimator: str, model: MeasurementModel, seed: int) -> list[FloatArray]:
    """Means and standard deviations of three objects after each list, some late and some under a robust loss."""
    rng, ids = np.random.default_rng(seed), [0, 1, 2]
    first = np.zeros((3, 5))
    first[:, :2], first[:, 3] = rng.uniform(-30.0, 30.0, (3, 2)), 20.0
    bank, found = estimator_bank(estimator, MOTION, 1.0, {}), list[FloatArray]()
    bank.advance(0)
    for track_id, state in enumerate(first):
        start = fgtrack.Start(position_m=state[:2], yaw_rad=0.0, speed_mps=20.0)
        bank.birth(track_id, start)
    shipped = fgtrack.measurement_model(NAMES, MOTION)
    for k in range(1, 40):
        at_s = 0.05 * (k if k % 3 else max(k - 4.5, 0.5))
        loss = None if k % 4 else fgtrack.RobustLoss("huber", 1.345)
        z = shipped.predict(MOTION.predict(first, at_s), POSE)
        z = z + STD * rng.standard_normal(z.shape)
        stamp_ns, R = round(1e9 * at_s), np.diag(STD**2)
        seen = [fgtrack.Measurement(stamp_ns, model, own, R, POSE, loss) for own in z]
        bank.advance(50_000_000 * k)
        bank.update(stamp_ns, ids, seen)
        now = bank.states_at(50_000_000 * k)
        found += [now.means, np.sqrt(np.diagonal(now.covariances, axis1=1, axis2=2))]
    return found


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded", "smoother"])
def test_an_own_model_with_the_shipped_equations_gives_the_same_states(
    estimator: str,
) -> None:
    Own.calls = 0
    shipped = fgtrack.measurement_model(NAMES, MOTION)
    expected = states(estimator, shipped, 3)
    assert Own.calls == 0
    found = states(estimator, Own(NAMES, MOTION.state_names), 3)
    assert Own.calls > 100
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
