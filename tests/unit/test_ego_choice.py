"""Of several candidates, the ego is the one whose poses agree with its speed; fused poses come first."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from fgtrack.core.types import EgoState
from fgtrack.inputs.settings import TopicInput
from fgtrack.meaning.ego_choice import consistency, with_consistent_ego
from fgtrack.meaning.parts import InputPart

Way = Callable[[float], tuple[float, float, float]]
"""x, y and speed after t seconds."""


def states(way: Way, seconds: float = 20.0) -> list[EgoState]:
    result = []
    for k in range(int(20.0 * seconds)):
        x, y, speed = way(0.05 * k)
        stamp_ns = 50_000_000 * k
        result.append(EgoState(stamp_ns, stamp_ns, x, y, 0.0, speed))
    return result


def straight(t: float) -> tuple[float, float, float]:
    return 12.0 * t, 0.0, 12.0


def standing(t: float) -> tuple[float, float, float]:
    return 0.0, 0.0, 12.0


def parked(t: float) -> tuple[float, float, float]:
    return 5.0, 1.0, 0.0


def in_kmh(t: float) -> tuple[float, float, float]:
    return 12.0 * t, 0.0, 43.2


def on_a_circle(t: float) -> tuple[float, float, float]:
    return 100.0 * math.sin(0.12 * t), 100.0 * math.cos(0.12 * t), 12.0


def jittering(t: float) -> tuple[float, float, float]:
    return 12.0 * t + 0.1 * math.sin(977.0 * t), 0.1 * math.cos(800.0 * t), 12.0


@pytest.mark.parametrize("way", [straight, on_a_circle, parked, jittering])
def test_poses_that_move_by_their_speed_are_consistent(way: Way) -> None:
    assert consistency(states(way)).is_consistent


@pytest.mark.parametrize("way", [standing, in_kmh])
def test_poses_that_stand_or_speeds_in_other_units_are_not_consistent(
    way: Way,
) -> None:
    assert not consistency(states(way)).is_consistent


def test_a_single_state_is_not_consistent() -> None:
    assert not consistency(states(straight)[:1]).is_consistent
    assert consistency([]).misfit == np.inf


@pytest.mark.parametrize(
    ("ways", "expected"),
    [
        ({"/can/odom": standing, "/odometry/filtered": straight}, "/odometry/filtered"),
        ({"/a/odom": standing, "/wheel/odom": straight}, "/wheel/odom"),
        ({"/wheel/odom": straight, "/ekf/odom": straight}, "/ekf/odom"),
        ({"/odom": straight, "/b/odom": straight}, "/odom"),
        ({"/localization/odom": in_kmh, "/odom": on_a_circle}, "/odom"),
    ],
)
def test_the_consistent_and_fused_candidate_is_the_ego(
    ways: dict[str, Way], expected: str
) -> None:
    lidar = InputPart("lidar", TopicInput("/lidar"), {})
    egos = [InputPart("ego", TopicInput(topic), {}) for topic in ways]
    ordered = with_consistent_ego([*egos, lidar], lambda part: states(ways[part.label]))
    assert ordered[0].label == expected
    assert expected in ordered[0].role_reason
    assert len(ordered) == len(ways) + 1


def test_the_only_ego_is_not_read() -> None:
    part = InputPart("ego", TopicInput("/odom"), {})

    def read(part: InputPart) -> list[EgoState]:
        raise AssertionError("the only candidate needs no comparison")

    assert with_consistent_ego([part], read) == [part]
