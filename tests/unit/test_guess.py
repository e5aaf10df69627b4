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
