"""Decisions on the mounts of simulated drives: a mount that nothing shows is asked for, and never guessed."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from fgtrack.config.settings import Config
from fgtrack.core.types import DetectionList
from fgtrack.meaning.decision import Decision
from fgtrack.meaning.placement import mount_decisions
from fgtrack.meaning.sample import Sample
from tests.support.scripts import load

DRIVES = load("mounts", "drives")
Sensor = DRIVES.Sensor
CONVOY = {"parked": 0, "turning": 0.0, "along": 2, "oncoming": 0}
"""A drive that does not show the mount of the reference."""


def decisions(
    seed: int,
    *sensors: Sensor,
    given: Mapping[str, object] | None = None,
    **drive: float,
) -> dict[str, Decision]:
    """Return the decisions for tables of the sensors, and for the user's settings in `given`."""
    user = Config().replace(given or {})
    config = user
    for item in sensors:
        frame = {"polar": "sensor", "sensor": "ego"}.get(item.form, item.form)
        key = f"input.csv.detections.{item.name}"
        table = {f"{key}.file": f"{item.name}.csv", f"{key}.columns": {"x_m": "x"}}
        config = config.replace({f"{key}.frame": frame, **table, **(given or {})})
    frames = {name: item.frame for name, item in config.input.csv.detections.items()}
    messages = [
        replace(item, frame=frames[item.sensor])
        if isinstance(item, DetectionList)
        else item
        for item in DRIVES.drive(seed, sensors, **drive).messages
    ]
    sample = Sample(Path("drive"), user, config, messages)
    return {each.about: each for each in mount_decisions(sample)}


FRONT = Sensor("front", form="ego", half_view_rad=0.9)
REAR = Sensor("rear", math.pi, -1.0, half_view_rad=0.9)


def test_a_radar_without_common_objects_is_asked_for_beside_another_sensor() -> None:
    found = decisions(1, FRONT, REAR, **CONVOY)
    assert found["rear"].certainty == "open"
    assert "sensors.rear.mount" in str(found["rear"].question)
    assert found["front"].certainty == "assumed"
    assert "input.csv.detections.front.frame" in str(found["front"].question)


@pytest.mark.slow
def test_a_radar_with_an_unknown_lever_arm_is_left_out_beside_another_sensor() -> None:
    """The traffic shows its yaw, but its objects would be at other places than those of the camera."""
    found = decisions(1, FRONT, REAR, parked=2)
    assert found["rear"].leaves_out
    assert "its lever arm is unknown beside other sensors" in found["rear"].reason
    assert not found["front"].leaves_out


@pytest.mark.slow
def test_of_radars_with_unknown_lever_arms_those_with_most_detections_are_used() -> (
    None
):
    front = replace(REAR, name="front", yaw_rad=0.0, range_m=90.0)
    found = decisions(1, front, replace(REAR, range_m=50.0), parked=2)
    assert found["front"].is_provisional
    assert found["rear"].leaves_out


def test_a_lone_radar_in_a_convoy_is_asked_for() -> None:
    found = decisions(1, Sensor("radar", half_view_rad=0.9), **CONVOY)
    assert found["radar"].certainty == "open"
    assert "sensors.radar.mount" in str(found["radar"].question)


def test_traffic_confirms_that_a_lone_radar_looks_ahead_but_asks_for_its_lever_arm() -> (
    None
):
    found = decisions(1, Sensor("radar", half_view_rad=0.9), parked=0)
    assert found["radar"].certainty == "open"
    assert found["radar"].is_provisional
    assert not found["radar"].leaves_out
    assert not found["radar"].settings
    assert "objects stand still or move along" in found["radar"].reason
    assert "sensors.radar.mount" in str(found["radar"].question)


def test_a_given_mount_is_not_asked_for() -> None:
    mount = {"sensors.rear.mount": {"x_m": -1.0, "yaw_rad": 3.14}}
    assert "rear" not in decisions(1, FRONT, REAR, given=mount, **CONVOY)


LEFT = Sensor("left", 0.3, 2.0, 1.0, "sensor", 1.5, clutter=0.2)
RIGHT = Sensor("right", -0.4, 2.0, -1.0, "sensor", 1.5, clutter=0.2)


def test_positions_in_frames_that_differ_are_asked_for() -> None:
    found = decisions(2, LEFT, RIGHT, **CONVOY)
    for name in ("left", "right"):
        assert found[name].certainty == "open"
        assert f"input.csv.detections.{name}.frame: ego" in str(found[name].question)
        assert "degrees" in found[name].reason


def test_the_answer_for_one_frame_shows_the_other_mount() -> None:
    answer = {"input.csv.detections.right.frame": "ego"}
    right = Sensor("right", form="ego", half_view_rad=1.5, clutter=0.2)
    found = decisions(2, LEFT, right, given=answer, parked=0, turning=0.0)
    assert found["left"].certainty == "tested"
    mount = found["left"].settings["sensors", "left", "mount"]
    assert isinstance(mount, dict)
    assert abs(mount["yaw_rad"] - 0.3) < 0.02


def test_sensors_that_agree_may_be_assumed_in_the_ego_frame() -> None:
    one = Sensor("one", form="ego", half_view_rad=1.5, clutter=0.2)
    other = Sensor("other", form="ego", half_view_rad=1.5, clutter=0.2)
    found = decisions(2, one, other, **CONVOY)
    assert {item.certainty for item in found.values()} <= {"assumed", "tested"}


def test_radars_in_different_axes_are_asked_for_together() -> None:
    front = Sensor("front", 0.1, 3.0, half_view_rad=1.3, clutter=0.2)
    left = Sensor("left", 0.8, 2.0, 1.0, half_view_rad=1.3, clutter=0.2)
    found = decisions(2, front, left, **CONVOY)
    assert {item.certainty for item in found.values()} == {"open"}


@pytest.mark.parametrize("seed", [1, 3])
@pytest.mark.parametrize("parked", [0, 1])
def test_traffic_shows_the_yaw_of_a_lone_radar(seed: int, parked: int) -> None:
    found = decisions(seed, Sensor("radar", 0.8, half_view_rad=1.3), parked=parked)
    assert found["radar"].certainty == "open"
    assert not found["radar"].leaves_out
    assert yaw_rad(found["radar"]) == pytest.approx(0.8, abs=0.03)
    assert "displaced by the error of its assumed mount" in str(found["radar"].question)


def yaw_rad(decision: Decision) -> float:
    mount = decision.settings["sensors", decision.about, "mount"]
    assert isinstance(mount, dict)
    return float(mount["yaw_rad"])


def test_sensors_that_agree_on_a_turned_axis_are_mounted_by_the_traffic() -> None:
    top = Sensor("top", math.pi / 2, form="sensor", half_view_rad=math.pi, clutter=0.2)
    radar = Sensor("radar", 0.0, 3.0, half_view_rad=0.9, clutter=0.2)
    found = decisions(1, top, radar, parked=1)
    assert yaw_rad(found["top"]) == pytest.approx(math.pi / 2, abs=0.03)
    assert "radar" not in found or found["radar"].certainty == "tested"


def test_a_mount_against_an_assumed_lever_arm_names_the_assumption() -> None:
    left = Sensor("left", 0.6, 3.0, 0.8, half_view_rad=1.3, clutter=0.2)
    right = Sensor("right", -0.6, 3.0, -0.8, half_view_rad=1.3, clutter=0.2)
    found = decisions(2, left, right, parked=1)
    reasons = sorted(item.reason for item in found.values())
    assert "whose lever arm is assumed" in reasons[0]
    assert "objects stand still or move along" in reasons[1]
    assert all(item.is_provisional for item in found.values())
    assert sorted(item.certainty for item in found.values()) == ["open", "tested"]


@pytest.mark.slow
def test_positions_with_the_axes_of_the_ego_are_the_reference_of_turned_positions() -> (
    None
):
    roof = Sensor("roof", 0.1, 1.2, form="sensor", half_view_rad=math.pi, clutter=0.2)
    camera = Sensor("camera", form="ego", half_view_rad=0.9, clutter=0.2)
    found = decisions(1, roof, camera, parked=1)
    assert yaw_rad(found["roof"]) == pytest.approx(0.1, abs=0.02)
    assert found["roof"].settings["sensors", "roof", "mount"] == {
        "x_m": pytest.approx(1.2, abs=0.5),
        "y_m": pytest.approx(0.0, abs=0.2),
        "yaw_rad": pytest.approx(0.1, abs=0.02),
    }
    assert not any(item.is_provisional for item in found.values())
