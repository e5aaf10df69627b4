"""Tests whether the orientations of detections are measurements, against the directions in which objects move."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.core.geometry import circular_mean, wrap_angle
from fgtrack.core.types import FloatArray
from fgtrack.meaning.decision import Certainty
from fgtrack.meaning.motions import Scans, StraightPath

__all__ = ["YawMeaning", "yaw_meaning"]

Convention = Literal["counter-clockwise from x", "compass", "in map axes"]
#: Fewest orientations, and fewest moving objects, for a judgement.
_FEWEST = 10
_FEWEST_MOVING = 8
#: Most different values of orientations that are defaults, and their resolution.
_DEFAULTS = 2
_RESOLUTION_RAD = 1e-6
#: Lowest speed that gives a direction, and its smallest ratio to the standard deviation.
_SLOWEST_MPS = 1.5
_SIGMAS = 5.0
#: Mean cosine of the difference from the direction of motion: of a random angle 0, of an error of 0.5 rad 0.88.
_AGREES = 0.7
#: Mean cosine of twice the difference, for orientations whose front and rear may be swapped.
_AXIS_AGREES = 0.4


@dataclass(frozen=True)
class YawMeaning:
    """Meaning of the orientations of a sensor's detections."""

    is_measurement: bool
    """False for constant or random orientations, and for orientations at an angle to the motion."""
    convention: Convention
    offset_rad: float
    """Constant angle from the direction of motion to the orientation, a multiple of a quarter turn."""
    certainty: Certainty
    reason: str
    """Result of the test in words."""


def yaw_meaning(
    scans: Scans,
    paths: Sequence[StraightPath],
    conventions: Sequence[Convention] = ("counter-clockwise from x",),
) -> YawMeaning | None:
    """Return the meaning of the orientations in `scans`, whose raw values are angles in rad.

    None if no orientation is finite. `paths` are the straight paths of the objects.
    `conventions` are tested in their order.
    """
    values = np.concatenate([each[:, 0] for each in scans.values] or [np.zeros(0)])
    values = values[np.isfinite(values)]
    first = conventions[0]
    if not len(values):
        return None
    if len(values) >= _FEWEST and (num := _num_different(scans)) <= _DEFAULTS:
        words = "equal" if num == 1 else f"one of {num} values"
        text = (
            f"all {len(values)} orientations are {words}, so they are no measurements"
        )
        return YawMeaning(False, first, 0.0, "tested", text)
    moving = [
        one
        for one in paths
        if (speed := float(np.hypot(*one.velocity_mps))) > _SLOWEST_MPS
        and speed > _SIGMAS * one.velocity_std_mps
    ]
    fits = [
        (convention, differences)
        for convention in conventions
        if len(differences := np.array(list(_differences(scans, moving, convention))))
        >= _FEWEST_MOVING
    ]
    if not fits:
        text = (
            f"{len(moving)} moving objects are too few for a test of the orientations"
        )
        return YawMeaning(True, first, 0.0, "assumed", text)
    convention, rest = max(fits, key=lambda fit: _concentration(fit[1]))
    offset_rad = 0.5 * math.pi * round(circular_mean(rest) / (0.5 * math.pi))
    agreement = float(np.cos(rest - offset_rad).mean())
    axis = float(np.cos(2.0 * rest).mean())
    if agreement >= _AGREES:
        off_rad = float(np.median(np.abs(_from(rest, offset_rad))))
        text = (
            f"{convention}: orientations of {len(rest)} moving stretches differ from "
            f"the direction of motion by {math.degrees(off_rad):.2g} degrees in the median"
        )
        if offset_rad:
            text += (
                f" from an offset of {math.degrees(wrap_angle(offset_rad)):.0f} degrees"
            )
        return YawMeaning(
            not offset_rad, convention, wrap_angle(offset_rad), "tested", text
        )
    if axis >= _AXIS_AGREES:
        text = (
            f"the axes of {len(rest)} moving stretches agree with their motion (mean cosine of twice the "
            f"angle {axis:.2g}), but front and rear are swapped in some"
        )
        return YawMeaning(True, convention, 0.0, "tested", text)
    text = (
        f"orientations of {len(rest)} moving stretches do not agree with the direction of motion "
        f"(mean cosine {agreement:.2g}), so they are no measurements"
    )
    return YawMeaning(False, first, 0.0, "tested", text)


def _from(angles_rad: FloatArray, centre_rad: float) -> FloatArray:
    """Return the differences of `angles_rad`, shape (n,), from `centre_rad`, in (-pi, pi]."""
    return np.asarray(
        np.arctan2(np.sin(angles_rad - centre_rad), np.cos(angles_rad - centre_rad))
    )


def _num_different(scans: Scans) -> int:
    """Return the number of different orientations, in the frame of the lists or in the map; the smaller number
    counts.
    """
    counts = []
    for in_map in (False, True):
        angles = np.concatenate(
            [
                each[:, 0] + (pose[2] if in_map else 0.0)
                for each, pose in zip(scans.values, scans.poses, strict=True)
            ]
        )
        angles = angles[np.isfinite(angles)]
        points = np.column_stack([np.cos(angles), np.sin(angles)])
        counts.append(len(np.unique(np.round(points / _RESOLUTION_RAD), axis=0)))
    return min(counts)


def _concentration(angles_rad: FloatArray) -> float:
    return float(np.hypot(np.cos(angles_rad).mean(), np.sin(angles_rad).mean()))


def _differences(
    scans: Scans, moving: Sequence[StraightPath], convention: Convention
) -> Iterator[float]:
    """Yield the angle from the direction of motion to the mean orientation of each moving path."""
    for one in moving:
        pairs = zip(one.lists.tolist(), one.rows.tolist(), strict=True)
        angles = np.array([scans.values[k][row, 0] for k, row in pairs])
        yaws_rad = scans.poses[one.lists, 2]
        if convention == "compass":
            in_map = 0.5 * math.pi - angles
        elif convention == "in map axes":
            in_map = angles
        else:
            in_map = angles + yaws_rad
        in_map = in_map[np.isfinite(in_map)]
        if len(in_map):
            course_rad = math.atan2(one.velocity_mps[1], one.velocity_mps[0])
            yield wrap_angle(circular_mean(in_map) - course_rad)
