"""Vehicles with roads of their own: waypoints, CSV paths, and paths of recorded objects."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.config.reading import read_scenario
from fgtrack.core.errors import DataError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import (
    ACCEL,
    SPEED,
    YAW,
    YAW_RATE,
    DetectionList,
    FloatArray,
    TruthState,
)
from fgtrack.pipeline.simulation import recorded_path
from fgtrack.sim import RecordedVehicle, Scenario, SimulatedSensor, WaypointVehicle

CORNER = ((0.0, 0.0), (60.0, 0.0), (100.0, 40.0), (100.0, 100.0))
CAMERA = SimulatedSensor("camera", {"x_m": 0.1, "y_m": 0.1}, rate_hz=10.0)


def parked(x_m: float, y_m: float) -> WaypointVehicle:
    return WaypointVehicle(((0.0, 0.0),), ((x_m, y_m), (x_m + 1.0, y_m)))


def truth_of(messages: object, object_id: int) -> FloatArray:
    """Stamp in s, x, y, yaw, speed of an object, shape (n, 5)."""
    rows = [
        (one.stamp_ns / 1e9, one.x_m, one.y_m, one.yaw_rad, one.speed_mps)
        for one in messages  # type: ignore[attr-defined]
        if isinstance(one, TruthState) and one.object_id == object_id
    ]
    return np.array(rows, dtype=float)


def derivatives_agree(states: object, times_s: FloatArray, tolerance: float) -> None:
    h = 1e-3
    now, ahead, behind = (states(times_s + shift) for shift in (0.0, h, -h))  # type: ignore[operator]
    velocity = (ahead[:, :2] - behind[:, :2]) / (2.0 * h)
    np.testing.assert_allclose(np.hypot(*velocity.T), now[:, SPEED], atol=tolerance)
    along = np.arctan2(velocity[:, 1], velocity[:, 0])
    fast = now[:, SPEED] > 0.2
    np.testing.assert_allclose(
        wrap_angles(along - now[:, YAW])[fast], 0.0, atol=tolerance
    )
    turn = wrap_angles(ahead[:, YAW] - behind[:, YAW]) / (2.0 * h)
    np.testing.assert_allclose(turn[fast], now[fast, YAW_RATE], atol=tolerance)
    gain = (ahead[:, SPEED] - behind[:, SPEED]) / (2.0 * h)
    np.testing.assert_allclose(gain, now[:, ACCEL], atol=0.02 + tolerance)


def test_a_vehicle_drives_through_its_waypoints_at_its_speed() -> None:
    car = WaypointVehicle(((0.0, 10.0),), CORNER)
    times = np.linspace(0.0, 20.0, 401)
    states = car.states(times)
    for point in CORNER:
        assert np.hypot(*(states[:, :2] - point).T).min() < 0.3
    np.testing.assert_allclose(states[:, SPEED], 10.0, atol=0.02)
    derivatives_agree(car.states, times, 0.05)


def test_beyond_the_ends_of_an_open_road_a_vehicle_drives_straight_on() -> None:
    states = WaypointVehicle(((0.0, 10.0),), CORNER, arc_m=-50.0).states(
        np.array([0.0, 1.0, 60.0, 61.0])
    )
    np.testing.assert_allclose(states[[0, 2], YAW], states[[1, 3], YAW])
    np.testing.assert_allclose(
        np.hypot(*np.diff(states[:, :2], axis=0)[[0, 2]].T), 10.0, atol=0.02
    )
    assert states[:, YAW_RATE] == pytest.approx(0.0)


def test_a_road_that_ends_where_it_began_is_driven_in_laps() -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 37)
    circle = tuple(
        map(tuple, np.stack([50.0 * np.cos(angle), 50.0 * np.sin(angle)], 1))
    )
    car = WaypointVehicle(((0.0, 5.0),), (*circle[:-1], circle[0]))
    lap_s = 2.0 * np.pi * 50.0 / 5.0
    states = car.states(np.array([1.0, 1.0 + lap_s, 1.0 + 3.0 * lap_s]))
    np.testing.assert_allclose(states[1:, :2], states[[0, 0], :2], atol=0.05)
    np.testing.assert_allclose(states[:, YAW_RATE], 0.1, atol=1e-3)


def test_a_vehicle_stops_and_drives_on() -> None:
    car = WaypointVehicle(((0.0, 10.0), (4.0, 0.0), (6.0, 0.0), (9.0, 8.0)), CORNER)
    times = np.linspace(0.0, 12.0, 241)
    states = car.states(times)
    assert np.isfinite(states).all()
    rest = states[(times >= 4.0) & (times <= 6.0)]
    assert (rest[:, [SPEED, YAW_RATE, ACCEL]] == 0.0).all()
    assert np.ptp(rest[:, :3], axis=0) == pytest.approx(0.0)
    derivatives_agree(car.states, times, 0.05)


def test_waypoints_from_a_file_are_those_in_the_scenario(tmp_path: Path) -> None:
    file = tmp_path / "road.csv"
    file.write_text("name,x_m,y_m\n" + "".join(f"p,{x},{y}\n" for x, y in CORNER))
    times = np.linspace(0.0, 9.0, 10)
    np.testing.assert_array_equal(
        WaypointVehicle(((0.0, 10.0),), file=str(file)).states(times),
        WaypointVehicle(((0.0, 10.0),), CORNER).states(times),
    )


def test_a_scenario_without_a_track_is_open_ground() -> None:
    scenario = Scenario(
        parked(0.0, 0.0), (WaypointVehicle(((0.0, 10.0),), CORNER),), (CAMERA,)
    )
    assert scenario.map is None
    assert read_scenario("default").map == "oval"
    messages = list(fgtrack.simulate(replace(scenario, duration_s=10.0)))
    assert (
        max(len(one.objects) for one in messages if isinstance(one, DetectionList)) == 1
    )


@pytest.mark.parametrize("kind", ["stream", "truth.csv", "own.csv"])
def test_a_recorded_object_drives_its_path_again(tmp_path: Path, kind: str) -> None:
    drive = tmp_path / "drive.jsonl"
    fgtrack.simulate("single_opponent", seed=1, duration_s=6.0, out=drive)
    before = truth_of(fgtrack.simulate("single_opponent", seed=1, duration_s=6.0), 0)
    file = drive
    if kind == "truth.csv":
        file = fgtrack.replay(drive, out=tmp_path / "run").path / "truth.csv"  # type: ignore[operator]
    if kind == "own.csv":
        file = tmp_path / "own.csv"
        rows = "".join(f"{t - 1000.0},{x},{y}\n" for t, x, y, *_ in before.tolist())
        file.write_text("t_s,x_m,y_m\n" + rows)
    again = RecordedVehicle(str(file), None if kind == "own.csv" else 0)
    scenario = Scenario(parked(before[0, 1], before[0, 2]), (again,), duration_s=6.0)
    after = truth_of(fgtrack.simulate(scenario), 0)
    np.testing.assert_allclose(after[:, 1:3], before[:, 1:3], atol=1e-3)
    inner = slice(5, -5)
    np.testing.assert_allclose(after[inner, 4], before[inner, 4], atol=0.05)
    np.testing.assert_allclose(
        wrap_angles(after[inner, 3] - before[inner, 3]), 0.0, atol=1e-3
    )


def test_a_recorded_object_is_absent_before_and_after_its_path(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text("t_s,x_m,y_m\n2,5,1\n3,15,1\n4,25,1\n5,35,1\n")
    scenario = Scenario(
        parked(0.0, 0.0), (RecordedVehicle(str(file)),), (CAMERA,), duration_s=8.0
    )
    messages = list(fgtrack.simulate(scenario))
    stamps_s = truth_of(messages, 0)[:, 0] - 1000.0
    assert (stamps_s.min(), stamps_s.max()) == pytest.approx((2.0, 5.0))
    seen_s = [
        one.stamp_ns / 1e9 - 1000.0
        for one in messages
        if isinstance(one, DetectionList) and one.objects
    ]
    assert (min(seen_s), max(seen_s)) == pytest.approx((2.0, 5.0))
    later = replace(scenario, opponents=(RecordedVehicle(str(file), start_s=2.0),))
    assert truth_of(fgtrack.simulate(later), 0)[0, 0] == pytest.approx(1000.0)


def test_noise_of_recorded_positions_is_smoothed(tmp_path: Path) -> None:
    times = np.arange(0.0, 20.0, 0.1)
    noise = np.random.default_rng(3).normal(0.0, 0.3, (2, len(times)))
    file = tmp_path / "gps.csv"
    rows = zip(times, 10.0 * times + noise[0], noise[1], strict=True)
    file.write_text("t_s,x_m,y_m\n" + "".join(f"{t},{x},{y}\n" for t, x, y in rows))
    at = np.linspace(2.0, 18.0, 100)
    off = [
        np.abs(
            recorded_path(RecordedVehicle(str(file), std_m=std_m)).states(at)[:, SPEED]
            - 10.0
        ).max()
        for std_m in (0.0, 0.3)
    ]
    assert off[1] < 0.5 < 2.0 < off[0]


def test_an_object_that_stands_keeps_its_direction(tmp_path: Path) -> None:
    file = tmp_path / "path.csv"
    file.write_text(
        "t_s,x_m,y_m\n0,0,0\n1,0,5\n2,0,10\n3,0,10\n4,0,10\n5,0,10\n6,0,10\n"
    )
    states = recorded_path(RecordedVehicle(str(file))).states(np.array([1.0, 5.0, 6.0]))
    assert np.isfinite(states).all()
    assert abs(abs(states[2, YAW]) - np.pi / 2.0) < 0.3


@pytest.mark.parametrize(
    ("text", "object_id", "message"),
    [
        ("t_s,x_m\n0,1\n1,2\n", None, "has no column y_m; its columns are t_s, x_m"),
        ("t_s,x_m,y_m\n0,1,2\n1,nan,2\n", None, "line 3: x_m is not a finite number"),
        ("t_s,x_m,y_m\n0,1,2\n1,here,2\n", None, "not a table of numbers"),
        (
            "t_s,x_m,y_m\n0,1,2\n",
            None,
            "a path needs positions at two times, there are 1",
        ),
        (
            "t_s,x_m,y_m,object_id\n0,1,2,4\n1,1,2,5\n",
            None,
            "must be one of 4, 5, is None",
        ),
        ("t_s,x_m,y_m,object_id\n0,1,2,4\n1,1,2,5\n", 6, "must be one of 4, 5, is 6"),
    ],
)
def test_a_path_that_cannot_be_driven_is_named(
    tmp_path: Path, text: str, object_id: int | None, message: str
) -> None:
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(DataError, match=message):
        recorded_path(RecordedVehicle(str(file), object_id))


def test_a_recorded_ego_covers_the_scenario_or_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "ego.csv"
    file.write_text("t_s,x_m,y_m\n0,0,0\n1,9,0\n2,20,0\n3,30,0\n4,40,0\n")
    scenario = Scenario(RecordedVehicle(str(file)), (), (CAMERA,), duration_s=4.0)
    assert len(truth_of(fgtrack.simulate(scenario), -1)) == 401
    with pytest.raises(DataError, match="ego: its recorded path must cover"):
        fgtrack.simulate(replace(scenario, duration_s=5.0))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "waypoints: give either waypoints or a file"),
        ({"waypoints": [[0, 0], [1, 1]], "file": "x.csv"}, "waypoints: give either"),
        ({"waypoints": [[0, 0]]}, "must be at least two points"),
        ({"waypoints": [[0, 0], [1, 1], [1, 1]]}, "number 3 repeats the one before"),
        (
            {"waypoints": [[0, 0], [1, 1]], "speed": [[1, 2], [1, 3]]},
            "times of the knots",
        ),
        (
            {"waypoints": [[0, 0], [1, 1]], "speed": [[1, -2]]},
            "greater than or equal to 0",
        ),
    ],
)
def test_a_road_that_makes_no_sense_is_named(
    keys: dict[str, object], message: str
) -> None:
    car = {"kind": "waypoints", "speed": [[0, 10]], **keys}
    with pytest.raises(fgtrack.CallError, match=message):
        read_scenario({"ego": car})
