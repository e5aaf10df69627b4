"""Components without information are recognised in the messages of a sensor."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.meaning.components import uninformative
from fgtrack.models.sensors import Mount

MS = 1_000_000
EGO_MPS = 12.0
Extra = Callable[[np.ndarray, float, np.random.Generator], dict[str, float]]
"""Values of a detection from the position in the ego frame, its heading and a generator; its speed is 8 m/s."""


def messages(extra: Extra, frame: str = "ego", turn_rad: float = 0.0) -> list[Message]:
    """An ego on a straight road and three cars, seen by a sensor that is turned by `turn_rad`."""
    rng = np.random.default_rng(2)
    result: list[Message] = []
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    to_sensor = np.array([[c, s], [-s, c]])
    for k in range(150):
        t = 0.1 * k
        ns = 100 * k * MS
        result.append(EgoState(ns, ns, EGO_MPS * t, 0.0, 0.0, EGO_MPS))
        objects = []
        for x0, y0, heading in ((30.0, 4.0, 0.1), (80.0, -20.0, 1.5), (90.0, 9.0, 3.0)):
            way = 8.0 * t * np.array([math.cos(heading), math.sin(heading)])
            at = np.array([x0 - EGO_MPS * t, y0]) + way + rng.normal(0.0, 0.2, 2)
            x, y = to_sensor @ at
            objects.append(Detection(x_m=x, y_m=y, **extra(at, heading, rng)))
        result.append(DetectionList("one", ns, ns + MS, objects, frame))  # type: ignore[arg-type]
    return result


def test_identity_orientations_are_recognised() -> None:
    found = uninformative(messages(lambda at, heading, rng: {"yaw_rad": 0.0}))
    assert found.keys() == {"one"}
    assert "equal" in found["one"]["yaw_rad"]


def test_measurements_are_kept() -> None:
    def extra(at, heading, rng):  # type: ignore[no-untyped-def]
        return {
            "yaw_rad": heading + rng.normal(0.0, 0.1),
            "speed_mps": 8.0 + rng.normal(0.0, 0.5),
        }

    assert uninformative(messages(extra)) == {}


@pytest.mark.parametrize("turn_rad", [0.6, math.pi, -2.0])
def test_orientations_of_a_turned_sensor_are_kept(turn_rad: float) -> None:
    def extra(at, heading, rng):  # type: ignore[no-untyped-def]
        return {"yaw_rad": heading - turn_rad + rng.normal(0.0, 0.1)}

    read = messages(extra, "sensor", turn_rad)
    assert uninformative(read, {"one": Mount(yaw_rad=turn_rad)}) == {}


def test_a_relative_speed_is_no_speed() -> None:
    def extra(at, heading, rng):  # type: ignore[no-untyped-def]
        velocity = 8.0 * np.array([math.cos(heading), math.sin(heading)])
        return {"speed_mps": float(np.hypot(*(velocity - [EGO_MPS, 0.0])))}

    found = uninformative(messages(extra))
    assert "relative speed" in found["one"]["speed_mps"]


def test_a_list_in_the_map_without_an_ego_is_tested_too() -> None:
    read = [
        each
        for each in messages(lambda at, heading, rng: {"yaw_rad": 1.0}, "map")
        if isinstance(each, DetectionList)
    ]
    assert "yaw_rad" in uninformative(read)["one"]
