"""What the names and values of columns and fields are taken for."""

import math

import numpy as np
import pytest

from fgtrack.inputs.settings import Field
from fgtrack.meaning.guess import agreeing_with_motion, guesses, time_unit


@pytest.mark.parametrize(
    ("name", "samples", "component", "path"),
    [
        ("t", [0.0], "stamp", "t"),
        ("ms", [0.0], "stamp", "ms"),
        ("recv_time", [0.0], "receipt", "recv_time"),
        ("pose.position.x", [1.0, 2.0], "x_m", "pose.position.x"),
        ("posY_km", [1.0], "y_m", Field("posY_km", 1000.0)),
        ("east", [1.0], "x_m", "east"),
        ("pose.orientation", [0.1], "yaw_rad", "pose.orientation"),
        ("heading", [0.0, 350.0], "yaw_rad", Field("heading", degrees=True)),
        ("yaw", [0.0, 6.2], "yaw_rad", "yaw"),
        ("azimuth", [-4.0, 5.0], "bearing_rad", Field("azimuth", degrees=True)),
        ("bearing_deg", [-1.0, 1.0], "bearing_rad", Field("bearing_deg", degrees=True)),
        ("speed_kmh", [50.0], "speed_mps", Field("speed_kmh", 1.0 / 3.6)),
        ("kmh", [50.0], "speed_mps", Field("kmh", 1.0 / 3.6)),
        ("Speed [km/h]", [50.0], "speed_mps", Field("Speed [km/h]", 1.0 / 3.6)),
        ("Speed (m/s)", [50.0], "speed_mps", "Speed (m/s)"),
        ("v [mi/h]", [50.0], "speed_mps", Field("v [mi/h]", 0.44704)),
        ("Heading [°]", [5.0], "yaw_rad", Field("Heading [°]", degrees=True)),
        (
            "yaw rate [deg/s]",
            [1.0],
            "yaw_rate_radps",
            Field("yaw rate [deg/s]", degrees=True),
        ),
        ("tx_m", [1.0], "x_m", "tx_m"),
        (
            "kinematics.pose_with_covariance.pose.position.x",
            [1.0],
            "x_m",
            "kinematics.pose_with_covariance.pose.position.x",
        ),
        ("generationDeltaTime", [1.0], None, None),
        ("pose_covariance", [1.0], None, None),
        ("rangeRate", [1.0], "range_rate_mps", "rangeRate"),
        ("yaw_rate_deg", [1.0], "yaw_rate_radps", Field("yaw_rate_deg", degrees=True)),
        ("dimensions.x", [4.0], "length_m", "dimensions.x"),
        ("track_id", [4.0], "object_id", "track_id"),
        ("x_std", [4.0], None, None),
        ("acceleration.x", [4.0], None, None),
        ("temperature", [4.0], None, None),
        ("Obj_DistLong", [40.0], "x_m", "Obj_DistLong"),
        ("dist_lat", [-3.0], "y_m", "dist_lat"),
        ("distance_lateral", [-3.0], "y_m", "distance_lateral"),
        ("lat", [48.1], "latitude_deg", "lat"),
        ("doppler_velocity", [-3.0], "range_rate_mps", "doppler_velocity"),
        (
            "closing_speed_kmh",
            [3.0],
            "range_rate_mps",
            Field("closing_speed_kmh", 1.0 / 3.6),
        ),
    ],
)
def test_a_field_is_taken_by_its_name_and_its_unit_by_name_and_values(
    name, samples, component, path
):
    found = {key: one.path for key, one in guesses({name: samples}).items()}
    assert found == ({} if component is None else {component: path})


@pytest.mark.parametrize(
    ("lat", "expected"),
    [
        ([-3.0, 0.1, 3.5], {"x_m": "long", "y_m": "lat"}),
        ([48.1, 48.2], {"latitude_deg": "lat", "longitude_deg": "long"}),
        ([-0.1, 0.1], {"latitude_deg": "lat", "longitude_deg": "long"}),
    ],
)
def test_lat_and_long_around_0_are_distances(lat, expected):
    found = guesses({"lat": lat, "long": [20.0, 30.0, 40.0]})
    assert {key: one.path for key, one in found.items()} == expected


def test_two_velocities_are_a_speed_and_of_two_names_the_first_is_taken():
    found = guesses(
        {"velocity.x": [1.0], "velocity.y": [1.0], "range": [1.0], "distance": [1.0]}
    )
    assert {key: one.path for key, one in found.items()} == {
        "range_m": "range",
        "speed_mps": ["velocity.x", "velocity.y"],
    }


@pytest.mark.parametrize(
    ("name", "samples", "unit"),
    [
        ("t", [1.7e9, 1.7e9 + 0.05], "s"),
        ("t", [1.7e12], "ms"),
        ("t", [1.7e18], "ns"),
        ("t_us", [0.0, 1.0], "us"),
        ("t", [0.0, 0.05, 0.1], "s"),
        ("t", [0.0, 50.0, 100.0], "ms"),
        ("t", [0.0, 5e7, 1e8], "ns"),
    ],
)
def test_the_unit_of_times_is_that_of_their_size_name_or_period(name, samples, unit):
    assert time_unit(name, samples)[0] == unit


@pytest.mark.parametrize("name", ["header.frame_id", "class_id", "sensorId", "msg_id"])
def test_an_id_of_something_else_is_no_object(name: str) -> None:
    found = guesses({name: [0.0, 1.0], "track_id": [4.0, 5.0]})
    assert found["object_id"].path == "track_id"
    assert guesses({name: [0.0, 1.0]}) == {}


@pytest.mark.parametrize("compass", [True, False])
@pytest.mark.parametrize("degrees", [True, False])
def test_a_heading_and_a_speed_are_those_with_which_the_positions_move(
    compass, degrees
):
    t_s = np.arange(200) * 0.1
    yaw_rad = 0.3 + 0.02 * t_s
    x_m, y_m = np.cumsum(1.5 * np.cos(yaw_rad)), np.cumsum(1.5 * np.sin(yaw_rad))
    heading = (0.5 * math.pi - yaw_rad if compass else yaw_rad) % (2.0 * math.pi)
    heading = np.degrees(heading) if degrees else heading
    values = {
        "ms": 1e3 * t_s,
        "x": x_m,
        "y": y_m,
        "heading": heading,
        "speed": np.full(200, 15.0 * 3.6),
    }
    found = agreeing_with_motion(
        guesses({name: one.tolist() for name, one in values.items()}), values, "ms"
    )
    path = found["yaw_rad"].path
    read = (
        [path.value(one) for one in heading]
        if isinstance(path, Field)
        else heading.tolist()
    )
    np.testing.assert_allclose(np.cos(read - yaw_rad), 1.0, atol=1e-9)
    assert found["speed_mps"].path == Field("speed", 1.0 / 3.6)
    assert (
        "3.6 times the distance travelled per second: kmh" in found["speed_mps"].reason
    )
    strange = agreeing_with_motion(found, {**values, "heading": -2.0 * heading}, "ms")
    assert "check it" in strange["yaw_rad"].reason


@pytest.mark.parametrize(
    "names",
    [
        ("qx", "qy", "qz", "qw"),
        ("q_x", "q_y", "q_z", "q_w"),
        (
            "pose.orientation.x",
            "pose.orientation.y",
            "pose.orientation.z",
            "pose.orientation.w",
        ),
        ("Rotation_X", "Rotation_Y", "Rotation_Z", "Rotation_W"),
        (
            "/odom/pose/orientation/x",
            "/odom/pose/orientation/y",
            "/odom/pose/orientation/z",
            "/odom/pose/orientation/w",
        ),
        ("quat_x", "quat_y", "quat_z", "quat_w"),
    ],
)
def test_four_fields_of_a_quaternion_are_the_heading(names):
    found = guesses({name: [0.1, 0.2] for name in (names[3], *names[:3])})
    assert found["yaw_rad"].path == list(names)
    assert "yaw_rad" not in guesses({name: [0.1] for name in names[:3]})
    assert (
        guesses({"yaw": [0.1], **{name: [0.1] for name in names}})["yaw_rad"].path
        == "yaw"
    )


def test_integers_in_tiny_degrees_are_positions():
    found = guesses({"latitude": [480000000.0], "longitude": [1000.0]})
    assert found["latitude_deg"].path == Field("latitude", 1e-7)
    assert found["longitude_deg"].path == Field("longitude", 1e-7)
    usual = guesses({"latitude": [48.0], "longitude": [11.0]})
    assert usual["latitude_deg"].path == "latitude"


@pytest.mark.parametrize("named", ["mps", "kmh", "knots"])
@pytest.mark.parametrize(
    ("true", "scale"), [("mps", 1.0), ("kmh", 3.6), ("mph", 2.23694)]
)
def test_the_distance_travelled_decides_the_unit_of_the_speed(named, true, scale):
    t = np.arange(0.0, 20.0, 0.1)
    speed = 10.0 + np.sin(t)
    name = f"speed_{named}"
    values = {
        "t": t,
        "x": np.cumsum(speed) * 0.1,
        "y": np.zeros(200),
        name: scale * speed,
    }
    own = guesses({key: each.tolist() for key, each in values.items()})
    found = agreeing_with_motion(own, values, "s")["speed_mps"].path
    factor = found.scale if isinstance(found, Field) else 1.0
    assert factor * scale == pytest.approx(1.0, rel=0.01), true
