"""Range rate of a sensor far from the reference point of a turning ego: as good as of one at it."""

from dataclasses import replace

import numpy as np
import pytest

from fgtrack.evaluation.matching import match
from fgtrack.evaluation.scores.consistency import consistency
from fgtrack.models.sensors import Mount, SensorModel
from fgtrack.pipeline.config import Config, MotionConfig
from fgtrack.pipeline.public import replay
from fgtrack.sim.scenario import EgoMessages, Scenario
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.simulate import simulate
from fgtrack.sim.vehicles import DrawnVehicle
from fgtrack.tracking.birth import MeasuredBirth

STD = {"range_m": 0.3, "bearing_rad": 0.01, "range_rate_mps": 0.1}
AT_REFERENCE = Mount(0.0, 0.0, 0.0)
MOTION = MotionConfig(kind="ctrv")
OBJECTS = ((40.0, 40.0, 1.0), (-60.0, 30.0, -2.0))


def judged(mount: Mount, yaw_rate_radps: float, seed: int) -> tuple[float, float, tuple[float, float]]:
    """RMSE, mean NIS and its band, of a drive of 10 s."""
    motion = MOTION.model()
    exact = EgoMessages(
        position_std_m=0.0, yaw_std_rad=0.0, speed_std_mps=0.0, yaw_rate_std_radps=0.0, accel_std_mps2=0.0
    )
    still = dict.fromkeys(vars(motion), 0.0)
    scenario = Scenario(
        ego=DrawnVehicle(0.0, 0.0, 0.0, 15.0, yaw_rate_radps, motion=replace(motion, **still)),
        opponents=tuple(DrawnVehicle(*place, 5.0, 0.1, motion=motion) for place in OBJECTS),
        sensors=(SimulatedSensor("radar", STD, mount=mount, max_range_m=1000.0),),
        map=None,
        duration_s=10.0,
        ego_messages=exact,
    )
    config = Config(
        estimator="smoother-banded",
        sensors={"radar": SensorModel(std=STD, mount=mount)},
        motion=MOTION,
        birth=MeasuredBirth(ego_speed_factor=0.0, speed_std_mps=20.0),
    )
    run = replay(simulate(scenario, np.random.default_rng(seed)), config)
    matching = match(run)
    tracks, truth = matching.tracks.where(matching.paired), matching.true_states[matching.paired]
    squared = (tracks["x_m"] - truth[:, 0]) ** 2 + (tracks["y_m"] - truth[:, 1]) ** 2
    nis = consistency(run, matching).nis["radar"]
    return float(np.sqrt(squared.mean())), nis.mean, nis.band


@pytest.mark.parametrize(
    ("mount", "yaw_rate_radps"),
    [
        (Mount(3.7, 0.9, 0.8), 0.3),
        (Mount(-2.5, -0.5, 3.0), 0.5),  # behind
        (Mount(1.5, 2.5, 1.57), -0.5),  # to the side
    ],
)
def test_the_lever_arm_costs_nothing(mount: Mount, yaw_rate_radps: float) -> None:
    with_arm, nis, (low, high) = judged(mount, yaw_rate_radps, seed=3)
    without = judged(replace(AT_REFERENCE, yaw_rad=mount.yaw_rad), yaw_rate_radps, seed=3)[0]
    assert with_arm == pytest.approx(without, rel=0.1)
    assert low < nis < high
