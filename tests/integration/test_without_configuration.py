"""Recordings of different scenes are tracked without a configuration."""

from dataclasses import replace

import numpy as np
import pytest
from support.examples import slow

import fgtrack
from fgtrack.advice.run_quality import RunQuality
from fgtrack.config.reading import read_scenario
from fgtrack.core.types import DetectionList, Message, TruthState
from fgtrack.runs import Run
from fgtrack.sim.simulate import simulate
from fgtrack.sim.vehicles import TrackVehicle

OBJECT_S, SHORTEST_S = 40.0, 12.0
"""Of all objects together: within it one loss by chance is not yet two a minute."""
AHEAD_M = (25.0, -20.0, 45.0, -35.0, 60.0, -45.0, 12.0, 75.0)
LEFT_M = (2.5, -2.5, -2.5, 2.5, 2.5, -2.5, 3.5, -2.5)


def scene(
    num_opponents: int,
    speed_mps: float,
    ego_mps: float | None = None,
    ahead_m: tuple[float, ...] = AHEAD_M,
) -> list[Message]:
    """Messages of opponents around an ego on the oval, which speed up by a tenth."""
    scenario = read_scenario("default")
    start_m, speeds = 300.0, ((4.0, speed_mps), (8.0, 1.1 * speed_mps))
    ego_speeds = speeds if ego_mps is None else ((1.0, ego_mps),)
    opponents = tuple(
        TrackVehicle(arc_m=start_m + ahead, lateral_m=left, speed=speeds)
        for ahead, left in zip(ahead_m[:num_opponents], LEFT_M, strict=False)
    )
    ego = TrackVehicle(arc_m=start_m, lateral_m=0.0, speed=ego_speeds)
    changed = replace(
        scenario,
        ego=ego,
        opponents=opponents,
        duration_s=max(OBJECT_S / num_opponents, SHORTEST_S),
        detection_origin_x_m=0.0,
    )
    return list(simulate(changed, np.random.default_rng(1)))


def check_tracked(run: Run) -> None:
    """Fail unless each object is tracked 95 % of the time in which a sensor could see it, nearly without breaks."""
    found = RunQuality.of(run)
    assert found.truth is not None
    assert found.truth.ticks_in_view > 100
    assert found.truth.tracked_share_in_view >= 0.95
    assert found.breaks_per_minute <= 2.0


@pytest.mark.parametrize(
    ("num_opponents", "speed_mps"),
    [(2, 30.0), *slow((1, 10.0), (1, 65.0), (8, 10.0), (8, 65.0))],
)
def test_cars_around_a_driving_ego(num_opponents: int, speed_mps: float) -> None:
    check_tracked(fgtrack.replay(scene(num_opponents, speed_mps)))


@pytest.mark.slow
def test_traffic_around_an_ego_that_stands() -> None:
    check_tracked(fgtrack.replay(scene(2, 5.0, ego_mps=0.01, ahead_m=(-40.0, -20.0))))


@pytest.mark.slow
def test_a_forward_sensor_misses_no_car_behind() -> None:
    messages = scene(2, 30.0, ahead_m=(30.0, -25.0))
    run = fgtrack.replay(messages)
    lidar = run.config["sensors"]["lidar_cluster"]
    assert (
        run.config["sensors"]["radar"]["field_of_view_rad"]
        < 3.0
        < lidar["field_of_view_rad"]
    )
    check_tracked(run)


@pytest.mark.slow
def test_lists_of_one_object_miss_nobody() -> None:
    messages: list[Message] = []
    for message in scene(4, 30.0):
        if not isinstance(message, DetectionList):
            messages.append(message)
        elif message.sensor == "lidar_cluster":
            messages += [replace(message, objects=[one]) for one in message.objects]
    run = fgtrack.replay(messages)
    assert not run.config["sensors"]["lidar_cluster"]["scan"]
    check_tracked(run)


def test_a_car_that_no_sensor_sees_is_not_tracked() -> None:
    messages = [one for one in scene(1, 30.0) if not isinstance(one, DetectionList)]
    assert any(isinstance(one, TruthState) for one in messages)
    with pytest.raises(AssertionError):
        check_tracked(fgtrack.replay(messages))
