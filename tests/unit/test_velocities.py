"""What a reported velocity means is found from the successive positions of the same objects."""

import math

import numpy as np
import pytest

from fgtrack.core.types import FloatArray
from fgtrack.meaning.motions import Motions, Scans, motions, straight_paths
from fgtrack.meaning.velocities import VelocityMeaning, by_name, meaning_of

EGO_MPS = 12.0
EGO_RADPS = 0.08
#: x, y, direction and speed of each object at the start, in the map.
OBJECTS = (
    (25.0, 2.0, 0.0, 15.0),
    (60.0, 30.0, -1.6, 9.0),
    (-20.0, -4.0, 0.1, 17.0),
    (70.0, 8.0, 3.1, 11.0),
)


def recorded(
    kind: str,
    *,
    factor: float = 1.0,
    ego_mps: float = EGO_MPS,
    ego_radps: float = EGO_RADPS,
    position_std_m: float = 0.3,
    value_std: float = 0.15,
    clutter: int = 1,
    seed: int = 0,
    hz: float = 10.0,
) -> Scans:
    """Lists for 20 s of a turning ego; the raw values are `factor` times the velocity of this `kind`."""
    rng = np.random.default_rng(seed)
    stamps_s = np.arange(0.0, 20.0, 1.0 / hz)
    yaw_rad = ego_radps * stamps_s
    half_rad = 0.5 * yaw_rad
    chord = ego_mps * stamps_s * np.sinc(half_rad / math.pi)
    poses = np.column_stack(
        [chord * np.cos(half_rad), chord * np.sin(half_rad), yaw_rad]
    )
    positions = []
    values = []
    for t, (x, y, yaw) in zip(stamps_s, poses, strict=True):
        points = []
        reported = []
        for x0, y0, direction, speed in OBJECTS:
            if rng.random() < 0.1:
                continue
            c, s = math.cos(yaw), math.sin(yaw)
            to_frame = np.array([[c, s], [-s, c]])
            velocity = speed * np.array([math.cos(direction), math.sin(direction)])
            at = np.array([x0, y0]) + velocity * t
            local = to_frame @ (at - [x, y])
            relative = to_frame @ velocity - [ego_mps, 0.0]
            sight = local / np.hypot(*local)
            value = {
                "absolute": to_frame @ velocity,
                "in map axes": velocity,
                "relative": relative,
                "apparent": relative - ego_radps * np.array([-local[1], local[0]]),
                "radial vector": sight * (sight @ relative),
                "speed": [np.hypot(*velocity)],
                "range rate": [sight @ relative],
                "closing": [-sight @ relative],
                "compensated": [sight @ to_frame @ velocity],
                "relative speed": [np.hypot(*relative)],
                "along x": [relative[0]],
                "nothing": rng.normal(size=2) * 5.0,
            }[kind]
            points.append(local + rng.normal(size=2) * position_std_m)
            reported.append(factor * (np.array(value) + rng.normal() * value_std))
        width = len(reported[0]) if reported else 1
        for _ in range(rng.poisson(clutter)):
            points.append(rng.uniform(-80.0, 80.0, 2))
            reported.append(rng.normal(size=width) * 5.0)
        positions.append(np.array(points).reshape(-1, 2))
        values.append(np.array(reported).reshape(-1, width))
    return Scans(stamps_s, positions, values, poses)


def meaning(scans: Scans, *names: str, unit: str | None = None) -> VelocityMeaning:
    measured: Motions = motions(scans, straight_paths(scans))
    return meaning_of(measured, by_name([name.split("_") for name in names]), unit)


@pytest.mark.parametrize(
    ("kind", "names", "expected"),
    [
        ("absolute", ("vx", "vy"), "absolute"),
        ("in map axes", ("vx", "vy"), "absolute"),
        ("relative", ("vx", "vy"), "relative"),
        ("relative", ("relative_velocity_x", "relative_velocity_y"), "relative"),
        ("apparent", ("vx", "vy"), "relative"),
        ("absolute", ("relative_velocity_x", "relative_velocity_y"), "absolute"),
        ("radial vector", ("vx", "vy"), "radial"),
        ("speed", ("speed",), "absolute"),
        ("range rate", ("speed",), "radial"),
        ("range rate", ("doppler_velocity",), "radial"),
        ("compensated", ("doppler_velocity",), "radial over ground"),
        ("relative speed", ("rel_speed",), "relative speed"),
        ("along x", ("vrel_long",), "relative along x"),
    ],
)
def test_the_kind_that_agrees_with_the_positions_wins_over_the_name(
    kind: str, names: tuple[str, ...], expected: str
) -> None:
    result = meaning(recorded(kind), *names)
    assert (result.kind, result.unit, result.certainty) == (expected, "m/s", "tested")


@pytest.mark.parametrize("unit", ["km/h", "knots", "mph", "cm/s"])
@pytest.mark.parametrize("kind", ["speed", "relative"])
def test_a_unit_is_found_without_its_name(kind: str, unit: str) -> None:
    per_mps = {"km/h": 3.6, "knots": 1.943846, "mph": 2.236936, "cm/s": 100.0}[unit]
    result = meaning(
        recorded(kind, factor=per_mps), *(("v",) if kind == "speed" else ("vx", "vy"))
    )
    assert result.unit == unit


def test_a_closing_speed_is_a_range_rate_with_the_other_sign() -> None:
    result = meaning(recorded("closing"), "closing_speed")
    assert (result.kind, result.scale) == ("radial", -1.0)


def test_a_velocity_that_agrees_with_nothing_stays_open() -> None:
    result = meaning(recorded("nothing"), "vx", "vy")
    assert result.kind is None
    assert result.certainty == "open"


def test_with_a_standing_ego_the_name_decides_and_this_is_said() -> None:
    scans = recorded("relative", ego_mps=0.0, ego_radps=0.0)
    assert meaning(scans, "vx", "vy").kind == "absolute"
    result = meaning(scans, "vrel_x", "vrel_y")
    assert (result.kind, result.certainty) == ("relative", "assumed")


def test_a_few_detections_leave_the_kind_to_the_name() -> None:
    scans = recorded("relative")
    few = Scans(
        scans.stamps_s[:6], scans.positions_m[:6], scans.values[:6], scans.poses[:6]
    )
    result = meaning(few, "speed_x", "speed_y")
    assert (result.kind, result.certainty) == ("absolute", "assumed")


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("hz", [2.0, 13.0, 25.0])
def test_other_rates_and_noisy_positions_give_the_same_kind(
    hz: float, seed: int
) -> None:
    scans = recorded("relative", hz=hz, position_std_m=0.6, clutter=4, seed=seed)
    assert meaning(scans, "vx", "vy").kind == "relative"


def test_a_tracklet_has_the_velocity_of_its_object() -> None:
    found = straight_paths(recorded("speed", position_std_m=0.01, clutter=0))
    truth: FloatArray = np.array(
        [[v * math.cos(a), v * math.sin(a)] for _, _, a, v in OBJECTS]
    )
    off = [np.hypot(*(truth - one.velocity_mps).T).min() for one in found]
    assert len(found) > 50
    assert max(off) < 0.1
