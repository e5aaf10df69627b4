"""Constant and random orientations are no measurements; others have a convention."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from fgtrack.meaning.motions import Scans, straight_paths
from fgtrack.meaning.orientations import YawMeaning, yaw_meaning

EGO_MPS = 10.0
EGO_RADPS = 0.1
OBJECTS = ((25.0, 2.0, 0.3, 12.0), (50.0, 20.0, -1.6, 8.0), (60.0, -9.0, 2.9, 7.0))

Reported = Callable[[float, float, np.random.Generator], float]
"""Orientation from the heading in the map, the yaw of the ego and a generator."""


def recorded(reported: Reported, moving: bool = True) -> Scans:
    """Lists for 15 s of an ego on a circle."""
    rng = np.random.default_rng(4)
    stamps_s = np.arange(0.0, 15.0, 0.1)
    yaw_rad = EGO_RADPS * stamps_s
    radius_m = EGO_MPS / EGO_RADPS
    poses = np.column_stack(
        [radius_m * np.sin(yaw_rad), radius_m * (1.0 - np.cos(yaw_rad)), yaw_rad]
    )
    positions = []
    values = []
    for t, (x, y, yaw) in zip(stamps_s, poses, strict=True):
        to_frame = np.array(
            [[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]]
        )
        points = []
        angles = []
        for x0, y0, heading, speed in OBJECTS:
            way_m = speed * t if moving else 0.0
            at = (
                np.array([x0, y0])
                + way_m * np.array([math.cos(heading), math.sin(heading)])
                + rng.normal(size=2) * 0.2
            )
            points.append(to_frame @ (at - [x, y]))
            angles.append([reported(heading, yaw, rng)])
        positions.append(np.array(points))
        values.append(np.array(angles))
    return Scans(stamps_s, positions, values, poses)


def meaning(
    reported: Reported, *conventions: str, moving: bool = True
) -> YawMeaning | None:
    scans = recorded(reported, moving)
    return yaw_meaning(
        scans,
        straight_paths(scans),
        conventions or ("counter-clockwise from x",),  # type: ignore[arg-type]
    )


@pytest.mark.parametrize(
    "reported",
    [
        lambda heading, yaw, rng: 0.0,
        lambda heading, yaw, rng: 1.2345,
        lambda heading, yaw, rng: (
            -yaw
        ),  # identity in the map, as it is in the ego frame
        lambda heading, yaw, rng: math.pi * rng.integers(2),
        lambda heading, yaw, rng: rng.uniform(-math.pi, math.pi),
        lambda heading, yaw, rng: rng.normal() * 0.1,
    ],
    ids=["identity", "constant", "in the map", "two values", "random", "noise"],
)
def test_orientations_without_information_are_no_measurements(
    reported: Reported,
) -> None:
    result = meaning(reported)
    assert result is not None
    assert not result.is_measurement
    assert result.certainty == "tested"


@pytest.mark.parametrize("std_rad", [0.01, 0.3])
def test_orientations_along_the_motion_are_measurements(std_rad: float) -> None:
    result = meaning(lambda heading, yaw, rng: heading - yaw + rng.normal() * std_rad)
    assert result is not None
    assert (result.is_measurement, result.certainty) == (True, "tested")


def test_a_swap_of_front_and_rear_keeps_the_measurement() -> None:
    result = meaning(
        lambda heading, yaw, rng: (
            heading - yaw + math.pi * rng.integers(2) + rng.normal() * 0.1
        )
    )
    assert result is not None
    assert result.is_measurement
    assert "swapped" in result.reason


def test_a_quarter_turn_is_named_and_not_used() -> None:
    result = meaning(
        lambda heading, yaw, rng: heading - yaw + 0.5 * math.pi + rng.normal() * 0.05
    )
    assert result is not None
    assert not result.is_measurement
    assert result.offset_rad == pytest.approx(0.5 * math.pi)


def test_a_compass_course_is_recognised_by_the_motion() -> None:
    result = meaning(
        lambda heading, yaw, rng: 0.5 * math.pi - heading + rng.normal() * 0.05,
        "counter-clockwise from x",
        "in map axes",
        "compass",
    )
    assert result is not None
    assert (result.convention, result.is_measurement) == ("compass", True)


def test_parked_objects_leave_varied_orientations_untested() -> None:
    result = meaning(
        lambda heading, yaw, rng: heading - yaw + rng.normal() * 0.05, moving=False
    )
    assert result is not None
    assert (result.is_measurement, result.certainty) == (True, "assumed")


def test_a_list_without_orientations_has_no_meaning() -> None:
    assert meaning(lambda heading, yaw, rng: math.nan) is None
