"""What a sensor model says of its noise, and of what it can see."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fgtrack.core.geometry import rotation
from fgtrack.models.sensors import Mount, SensorModel

POSITION = {"x_m": 0.3, "y_m": 0.4}


ORIGIN_M = (-1.74, 0.0)
AHEAD = SensorModel(
    std=POSITION,
    mount=Mount(3.74, 1.0, 0.0),
    max_range_m=50.0,
    field_of_view_rad=math.pi / 2.0,
)


@pytest.mark.parametrize(
    ("sensor", "place", "seen"),
    [
        (AHEAD, (51.9, 1.0), True),  # from (2, 1)
        (AHEAD, (52.1, 1.0), False),
        (AHEAD, (12.0, 10.9), True),
        (AHEAD, (12.0, 11.1), False),
        (AHEAD, (-5.0, 1.0), False),
        (replace(AHEAD, mount=Mount(3.74, 1.0, math.pi)), (-5.0, 1.0), True),
        (replace(AHEAD, mount=Mount(3.74, 1.0, math.pi / 2.0)), (2.0, 21.0), True),
        (replace(AHEAD, field_of_view_rad=math.tau), (-5.0, 1.0), True),
        (
            replace(AHEAD, field_of_view_rad=math.tau, max_range_behind_m=6.0),
            (-5.0, 1.0),
            False,
        ),
        (
            replace(AHEAD, field_of_view_rad=math.tau, max_range_behind_m=80.0),
            (-68.0, 1.0),
            False,
        ),
        (SensorModel(std=POSITION), (-5e6, 1.0), True),
    ],
)
def test_a_sensor_sees_what_is_in_range_and_in_its_field_of_view(
    sensor: SensorModel, place: tuple[float, float], seen: bool
) -> None:
    """Wherever the ego is and heads, and for any number of places."""
    poses = np.array([[0.0, 0.0, 0.0], [100.0, -40.0, 2.5], [-7.0, 3.0, -3.0]])
    places = np.array([pose[:2] + rotation(pose[2]) @ place for pose in poses])
    assert sensor.sees(places, poses, ORIGIN_M).tolist() == [seen] * 3
    assert bool(sensor.sees(places[1], poses[1], ORIGIN_M)) is seen


def test_what_grows_with_range_is_measured_and_does_not_shrink() -> None:
    sensor = SensorModel(std=POSITION, std_growth={"y_m": 0.01})
    assert sensor.variance_growth(("x_m",), np.array([10.0])) is None
    found = sensor.variance_growth(("x_m", "y_m"), np.array([0.0, 10.0, np.nan]))
    assert found is not None
    np.testing.assert_allclose(found, [[0.0, 0.0], [0.0, 0.01], [0.0, 0.0]])
    for growth, said in (
        ({"speed_mps": 0.1}, "use x_m, y_m"),
        ({"x_m": -0.1}, "greater than or equal to 0"),
    ):
        with pytest.raises(ValueError, match=said):
            SensorModel(std=POSITION, std_growth=growth)
