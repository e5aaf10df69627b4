"""Mounts of sensors and frames of positions, estimated from simulated drives with known mounts."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.meaning import frames
from fgtrack.meaning.frames import frame_of, is_optical
from fgtrack.meaning.mounts import Mounts, Pose2, estimated_mounts
from fgtrack.meaning.mounts.table import Table
from fgtrack.meaning.mounts.traffic import TrafficYaw, traffic_yaw
from fgtrack.meaning.tracklets import EgoMotion, points_of, tracklets
from tests.support.scripts import load

DRIVES = load("mounts", "drives")
Sensor = DRIVES.Sensor


def estimate(messages: list[Message], *preferred: str, **assumed: Pose2) -> Mounts:
    points, motion = points_of(messages)
    return estimated_mounts(points, motion, assumed, preferred)


def errors(mounts: Mounts, sensor: Sensor) -> np.ndarray:
    item = mounts[sensor.name]
    yaw_rad = wrap_angle(item.yaw_rad - sensor.yaw_rad)
    return np.array([yaw_rad, item.x_m - sensor.x_m, item.y_m - sensor.y_m])


@pytest.mark.long
def test_two_radars_are_mounted_by_a_camera_in_the_ego_frame() -> None:
    one = DRIVES.drive(3)
    mounts = estimate(one.messages, "camera")
    bounds = DRIVES.bound(one)
    for sensor, bound in zip(one.sensors[1:], bounds, strict=True):
        half = np.array(mounts[sensor.name].half_widths)
        assert mounts[sensor.name].is_off
        assert (np.abs(errors(mounts, sensor)) < 5.0 * bound).all()
        assert (half > bound).all()
        assert (half < 12.0 * bound).all()
    assert not mounts["camera"].is_off


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_sensors_in_the_map_and_backwards_are_mounted(seed: int) -> None:
    sensors = (
        Sensor("lidar", form="map", half_view_rad=math.pi, range_std_m=0.2),
        Sensor("rear", math.pi - 0.1, -1.0, 0.3, half_view_rad=1.2),
        Sensor("left", 1.4, 2.0, 0.9, "sensor", 1.2),
    )
    mounts = estimate(DRIVES.drive(seed, sensors).messages)
    assert mounts.references["rear"] == "lidar"
    for sensor in sensors[1:]:
        assert (np.abs(errors(mounts, sensor)) < [0.01, 0.2, 0.2]).all()


@pytest.mark.long
def test_a_mount_that_is_three_degrees_off_is_significant() -> None:
    one = DRIVES.drive(5)
    right = estimate(one.messages, "camera", left=Pose2(0.6, 3.2, 0.9))
    wrong = estimate(
        one.messages, "camera", left=Pose2(0.6 + math.radians(3.0), 3.2, 0.9)
    )
    assert not right["left"].is_off
    assert wrong["left"].is_off


@pytest.mark.long
def test_still_objects_show_the_yaw_of_a_lone_sensor() -> None:
    lone = (Sensor("radar", 2.8, half_view_rad=1.3),)
    mounts = estimate(DRIVES.drive(4, lone, parked=6).messages)
    assert mounts["radar"].yaw_rad == pytest.approx(2.8, abs=0.02)
    assert mounts["radar"].is_sure_of_yaw


@pytest.mark.parametrize("yaw_rad", [0.25, 1.3, math.pi])
def test_moving_cars_show_the_yaw_of_a_lone_sensor(yaw_rad: float) -> None:
    lone = (Sensor("radar", yaw_rad, half_view_rad=1.3),)
    mounts = estimate(DRIVES.drive(4, lone, parked=0).messages)
    assert abs(wrap_angle(mounts["radar"].yaw_rad - yaw_rad)) < 0.02
    assert mounts["radar"].is_sure_of_yaw
    assert mounts["radar"].is_off
    assert not mounts["radar"].is_known


def test_a_car_that_crosses_does_not_show_the_yaw() -> None:
    yaw = crossing_traffic_yaw(cars=1)
    assert yaw.probability < 0.9


def crossing_traffic_yaw(cars: int) -> TrafficYaw:
    """Return the yaw by `cars` that cross the path of an ego on a straight road."""
    motion = EgoMotion(np.array([[t, 10.0 * t, 0.0, 0.0] for t in range(30)]))
    times_s = np.arange(10.0, 16.0, 0.1)
    rows = []
    for number in range(cars):
        at_m = np.column_stack([np.full(60, 190.0 + number), 9.0 * (times_s - 12.0)])
        rows.append(at_m - motion.poses(times_s)[:, :2])
    size = 60 * cars
    numbers = np.repeat(np.arange(cars), 60)
    stamps_s = np.tile(times_s, cars)
    table = Table(
        np.zeros(size, dtype=np.int64),
        numbers,
        np.zeros(size, dtype=np.int64),
        numbers,
        stamps_s,
        np.concatenate(rows),
        np.concatenate(rows),
        motion.poses(stamps_s),
        np.full((size, 2, 2), 0.1),
        np.zeros(size, dtype=bool),
    )
    yaw = traffic_yaw(table, [Pose2()], motion)
    assert yaw is not None
    return yaw


def test_nothing_shows_the_mount_of_a_lone_sensor_in_a_convoy() -> None:
    lone = (Sensor("radar", 0.7),)
    convoy = {"parked": 0, "turning": 0.0, "along": 2, "oncoming": 0}
    mounts = estimate(DRIVES.drive(4, lone, **convoy).messages)
    assert mounts["radar"].pose == Pose2()
    assert math.isinf(mounts["radar"].half_widths[0])
    assert "assumed" in str(mounts["radar"])


@pytest.mark.long
def test_equal_mounts_are_not_significant() -> None:
    sensors = (
        Sensor("lidar", form="ego", half_view_rad=math.pi),
        Sensor("radar", form="ego", half_view_rad=1.2),
    )
    mounts = estimate(DRIVES.drive(6, sensors).messages, "lidar")
    assert not mounts["radar"].is_off
    assert mounts["radar"].is_sure_of_yaw


@pytest.mark.long
def test_near_sides_of_hulls_are_no_mount() -> None:
    sensors = (
        Sensor("lidar", form="ego", half_view_rad=math.pi, clutter=0.0),
        Sensor("radar", form="ego", half_view_rad=math.pi, clutter=0.0),
    )
    messages = [
        replace(item, objects=[nearer(each, 2.0) for each in item.objects])
        if isinstance(item, DetectionList) and item.sensor == "radar"
        else item
        for item in DRIVES.drive(7, sensors).messages
    ]
    mounts = estimate(messages, "lidar")
    assert abs(mounts["radar"].x_m) < 0.3
    assert not mounts["radar"].is_off


def nearer(item: Detection, by_m: float) -> Detection:
    assert item.x_m is not None
    assert item.y_m is not None
    share = 1.0 - by_m / math.hypot(item.x_m, item.y_m)
    return replace(item, x_m=share * item.x_m, y_m=share * item.y_m)


def test_the_noise_of_a_sensor_is_estimated_from_its_tracklets() -> None:
    lone = (Sensor("radar", range_std_m=0.5, bearing_std_rad=0.01),)
    points, _ = points_of(DRIVES.drive(2, lone).messages)
    chains, noise = tracklets(points["radar"])
    assert np.mean(chains >= 0) > 0.5
    along, across = np.sqrt(noise.variances(np.array([40.0])))[0]
    assert along == pytest.approx(0.5, rel=0.2)
    assert across == pytest.approx(0.4, rel=0.2)


@pytest.mark.parametrize("form", ["map", "ego"])
@pytest.mark.parametrize("turning", [0.0, 2.0])
def test_the_frame_of_positions_is_tested(form: str, turning: float) -> None:
    lone = (Sensor("radar", form=form),)
    points, motion = points_of(DRIVES.drive(1, lone, turning=turning).messages)
    unknown = points["radar"].read_in_map(False)
    result = frame_of(unknown, motion)
    assert result.in_map == (form == "map")
    assert "m" in result.reason


@pytest.mark.parametrize(("ratio", "in_map"), [(5.0, None), (1.4, False)])
def test_clear_distances_count_more_than_a_small_difference_of_the_motions(
    monkeypatch: pytest.MonkeyPatch, ratio: float, in_map: bool | None
) -> None:
    lone = (Sensor("radar", form="ego"),)
    points, motion = points_of(DRIVES.drive(1, lone, turning=0.0).messages)
    for_the_map = frames._Evidence(True, "the motions prefer the map", ratio)
    monkeypatch.setattr(frames, "_by_motion", lambda _: for_the_map)
    result = frame_of(points["radar"], motion)
    assert result.is_contradictory == (in_map is None)
    assert result.in_map == in_map


def test_the_frame_is_undecided_while_the_ego_stands_at_the_origin() -> None:
    messages: list[Message] = [
        EgoState(k * 10**8, k * 10**8, 0.0, 0.0, 0.0, 0.0) for k in range(100)
    ]
    for k in range(100):
        item = Detection(x_m=10.0 + 0.3 * k, y_m=2.0)
        messages.append(DetectionList("radar", k * 10**8, k * 10**8, [item]))
    messages.sort(key=lambda each: each.receipt_ns)
    points, motion = points_of(messages)
    assert frame_of(points["radar"], motion).in_map is None


def test_the_axis_without_motion_is_vertical() -> None:
    rng = np.random.default_rng(3)
    ground = rng.uniform([-20.0, -30.0, 0.3], [60.0, 30.0, 0.8], (100, 3))
    assert is_optical(ground) is False
    assert is_optical(ground[:, [0, 2, 1]]) is True
    assert is_optical(ground[:5]) is None
