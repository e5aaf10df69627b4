"""Yaws that may belong to the front or to the rear are read in the order of stamps."""

from typing import Any

import pytest

from fgtrack.testing.drawn_scenes import drawn
from fgtrack.testing.outcomes import difference, outcome

CTRV: dict[str, Any] = {
    "kind": "ctrv",
    "std_per_s": {"position": 0.5, "yaw": 0.2, "speed": 15.0, "yaw_rate": 3.0},
}


@pytest.mark.parametrize("seed", [7, 11])
def test_late_lists_change_no_reading_of_a_yaw(seed: int) -> None:
    scene = drawn(
        seed,
        ("yaw", "position"),
        num_objects=1 + seed % 8,
        length_s=3.5,
        frame="map",
        motion=CTRV,
    )
    assert difference(outcome(scene.late(seed, 0.9, 0.3)), outcome(scene)) == ""
