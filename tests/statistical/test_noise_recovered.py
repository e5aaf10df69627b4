"""`tune` finds the noise that a recording was drawn with, in scenarios of different kinds."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.settings import Config
from fgtrack.core.time import nanoseconds
from fgtrack.core.types import Message
from fgtrack.meaning.assumed import source_of
from fgtrack.models.motion import CTRV
from fgtrack.noise.parameters import TuneReport
from fgtrack.noise.tune import tune_sources
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import Clutter
from fgtrack.sim.simulate import simulate

Truth = dict[str, float]
#: Part of the recordings that is used.
SECONDS = 40.0


def by_model(**changes: float) -> Scenario:
    """Three objects drawn from CTRV, with these standard deviations per second at 100 Hz."""
    std = {"position": 0.2, "yaw": 0.3, "speed": 1.0, "yaw_rate": 0.5} | changes
    scenario = read_scenario("drawn_ctrv")
    motion = CTRV.from_std_per_step(std, 100.0)
    return replace(
        scenario,
        opponents=tuple(replace(one, motion=motion) for one in scenario.opponents),
    )


def ctrv(seed: int) -> tuple[Iterator[Message], Config, Truth]:
    """Late positions with outliers, lost detections and clutter; LiDAR and RADAR differ along and across."""
    scenario = by_model(speed=3.0, yaw_rate=1.0, yaw=0.1)
    lidar, radar = scenario.sensors
    lidar = replace(
        lidar,
        std={"x_m": 0.5, "y_m": 0.2},
        outlier_probability=0.02,
        outlier_factor=5.0,
    )
    radar = replace(
        radar, std={"x_m": 1.5, "y_m": 0.6, "speed_mps": 0.5}, outlier_probability=0.01
    )
    radar = replace(radar, detection_probability=0.8, clutter=Clutter(0.5))
    truth = {
        f"sensors.{one.name}.std.{name}": value
        for one in (lidar, radar)
        for name, value in one.std.items()
    }
    truth |= {
        "motion.std_per_s.speed": 3.0,
        "motion.std_per_s.yaw_rate": 1.0,
        "motion.std_per_s.yaw": 0.1,
    }
    truth["motion.std_per_s.position"] = 0.2
    messages = simulate(
        replace(scenario, sensors=(lidar, radar)), np.random.default_rng(seed)
    )
    return iter(messages), read_config("open_space"), truth


def urban(seed: int) -> tuple[Iterator[Message], Config, Truth]:
    """Six slow cars around an ego at rest: their heading is unknown and certain late; clutter, and 3 % of outliers."""
    scenario = read_scenario("drawn_ctrv")
    motion_std = {"position": 0.1, "yaw": 0.1, "speed": 1.0, "yaw_rate": 0.3}
    motion = CTRV.from_std_per_step(motion_std, 100.0)
    cars = tuple(
        replace(
            scenario.opponents[0],
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad,
            speed_mps=6.0,
            yaw_rate_radps=0.0,
            motion=motion,
        )
        for x_m, y_m, yaw_rad in (
            (60.0, 0.0, 3.0),
            (-60.0, 5.0, 0.2),
            (0.0, 70.0, -1.5),
            (10.0, -70.0, 1.7),
            (120.0, 120.0, -2.4),
            (-120.0, -120.0, 0.8),
        )
    )
    std = {
        "lidar_cluster": {"x_m": 0.2, "y_m": 0.1},
        "radar": {"range_m": 0.4, "bearing_rad": 0.01, "range_rate_mps": 0.2},
    }
    wrong_std = (
        "sensors.lidar_cluster.std={x_m: 0.5, y_m: 0.5}",
        "sensors.radar.births=false",
    )
    sensors = tuple(
        replace(
            one,
            std=std[one.name],
            rate_hz=10.0,
            max_range_m=300.0,
            detection_probability=0.9,
            outlier_probability=0.03,
            outlier_factor=5.0,
            clutter=Clutter(1.0),
        )
        for one in scenario.sensors
    )
    ego = replace(scenario.ego, speed_mps=0.0)
    config = read_config(
        "open_space",
        [
            *wrong_std,
            "sensors.radar.std={range_m: 1.0, bearing_rad: 0.03, range_rate_mps: 0.1}",
            "birth.speed_std_mps=10.0",
        ],
    )
    truth = {
        f"sensors.{sensor}.std.{name}": value
        for sensor, parts in std.items()
        for name, value in parts.items()
    }
    truth |= {f"motion.std_per_s.{name}": value for name, value in motion_std.items()}
    drawn = replace(scenario, ego=ego, opponents=cars, sensors=sensors)
    return iter(simulate(drawn, np.random.default_rng(seed))), config, truth


def wrong(report: TuneReport, truth: Truth) -> list[str]:
    """What is further from the truth than three standard errors or, where it is known, 15 %."""
    found = []
    for one in report.parameters:
        if one.known in ("yes", "roughly"):
            assert one.std_error is not None
            error = math.log(one.tuned / truth[one.key])
            if abs(error) > min(
                math.log(1.15) if one.known == "yes" else math.inf, 3.0 * one.std_error
            ):
                found.append(
                    f"{one.key}: {one.tuned}, true is {truth[one.key]}, standard error {one.std_error:.3f}"
                )
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "seed"), [(ctrv, 11), (ctrv, 12), (urban, 12), (urban, 13)]
)
def test_every_identifiable_standard_deviation_is_found(
    scene: Callable[[int], tuple[Iterator[Message], Config, Truth]], seed: int
) -> None:
    messages, config, truth = scene(seed)
    kept = list(messages)
    kept = [
        one
        for one in kept
        if one.receipt_ns < kept[0].receipt_ns + nanoseconds(SECONDS)
    ]
    report = tune_sources({"scene": source_of(lambda: kept)}, config)
    assert wrong(report, truth) == []
    measured = [one for one in report.parameters if one.key.startswith("sensors")]
    assert all(one.known == "yes" for one in measured), [
        one.key for one in measured if one.known != "yes"
    ]
    assert report.held_out is not None
    assert report.held_out.after > report.held_out.before
    for one in report.held_out.innovations:
        assert (
            0.8 < one.after < 2.3
        )  # outliers count: 3 % that are 5 times as large add 0.72
