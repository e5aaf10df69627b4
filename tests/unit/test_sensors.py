"""What a sensor model says of its noise."""

import numpy as np
import pytest

from fgtrack.models.sensors import SensorModel

POSITION = {"x_m": 0.3, "y_m": 0.4}


def test_a_yaw_that_is_not_measured_is_as_uncertain_as_the_heading_of_the_map() -> None:
    taken = SensorModel(std=POSITION, yaw_from_map_std_rad=0.2)
    measured = SensorModel(std={**POSITION, "yaw_rad": 0.1}, yaw_from_map_std_rad=0.2)
    assert (taken.component_std("yaw_rad"), measured.component_std("yaw_rad")) == (0.2, 0.1)
    np.testing.assert_allclose(taken.noise(("y_m", "yaw_rad")), np.diag([0.16, 0.04]))
    for sensor, name in ((SensorModel(std=POSITION), "yaw_rad"), (taken, "speed_mps")):
        with pytest.raises(KeyError, match=name):
            sensor.component_std(name)
