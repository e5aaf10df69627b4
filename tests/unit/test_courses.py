"""Speeds and courses in tables of position reports, which are tested on the motion."""

import math
from pathlib import Path

import numpy as np
import pytest

from fgtrack.core.types import Detection, DetectionList
from fgtrack.inputs.settings import CsvInput, CsvTable, Field, InputConfig
from fgtrack.inputs.source import open_input
from fgtrack.meaning.reports import report_part

KNOT_MPS = 1852.0 / 3600.0


def table(folder: Path, unit_mps: float, is_compass: bool, is_random: bool = False):
    """Reports of two ships every 10 s and of one at anchor, whose course is random; some numbers are unknown."""
    rng = np.random.default_rng(2)
    lines = ["time,mmsi,lat,lon,sog,cog"]
    for k in range(120):
        for ship, (speed_mps, yaw_deg) in enumerate(
            ((6.0, 20.0), (4.0, 100.0), (0.0, 0.0))
        ):
            travelled_m = 10.0 * k * speed_mps
            yaw_rad = math.radians(yaw_deg)
            lat = 54.0 + 0.05 * ship + travelled_m * math.sin(yaw_rad) / 111_300
            lon = 10.0 + travelled_m * math.cos(yaw_rad) / 65_400
            course_deg = 90.0 - yaw_deg if is_compass else yaw_deg
            if speed_mps == 0.0 or is_random:
                course_deg = rng.uniform(0.0, 359.9)
            course_deg %= 360.0
            speed = speed_mps / unit_mps
            if k % 10 == 0:
                speed, course_deg = 102.3, 360.0
            lines.append(
                f"{1.7e9 + 10 * k:.0f},{211_000_000 + ship},{lat:.6f},{lon:.6f},{speed:.1f},{course_deg:.1f}"
            )
    path = folder / "ships.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def columns(path: Path):
    part = report_part(path)
    assert part is not None
    assert isinstance(part.item, CsvTable)
    return part.item.columns


@pytest.mark.parametrize("unit_mps", [KNOT_MPS, 1.0, 1 / 3.6], ids=["kn", "m/s", "kmh"])
@pytest.mark.parametrize("is_compass", [True, False])
def test_the_motion_decides_on_unit_and_convention(
    tmp_path: Path, unit_mps: float, is_compass: bool
) -> None:
    read = columns(table(tmp_path, unit_mps, is_compass))
    speed = read["speed_mps"]
    course = read["yaw_rad"]
    assert isinstance(speed, Field)
    assert isinstance(course, Field)
    assert speed.scale == pytest.approx(unit_mps)
    assert speed.unknown == (102.3,)
    assert (course.scale, course.offset) == ((-1.0, 90.0) if is_compass else (1.0, 0.0))
    assert course.unknown == (360.0,)
    assert course.least["sog"] == pytest.approx(0.5 / unit_mps, rel=0.1)


def test_a_course_that_contradicts_the_motion_is_not_read(tmp_path: Path) -> None:
    read = columns(table(tmp_path, KNOT_MPS, is_compass=True, is_random=True))
    assert "speed_mps" in read
    assert "yaw_rad" not in read


def test_a_ship_at_rest_has_a_speed_and_no_course(tmp_path: Path) -> None:
    path = table(tmp_path, KNOT_MPS, is_compass=True)
    part = report_part(path)
    assert part is not None
    assert isinstance(part.item, CsvTable)
    config = InputConfig(csv=CsvInput(detections={"ais": part.item}))
    objects: dict[str, list[Detection]] = {}
    for message in open_input(path, config).messages():
        assert isinstance(message, DetectionList)
        for item in message.objects:
            objects.setdefault(item.id or "", []).append(item)
    moving = objects["211000000"]
    known = [item for item in moving if item.speed_mps is not None]
    assert len(moving) == 120
    assert len(known) == 108
    assert all(
        item.yaw_rad == pytest.approx(math.radians(20.0), abs=1e-3) for item in known
    )
    resting = objects["211000002"]
    assert all(item.yaw_rad is None for item in resting)
    assert sum(item.speed_mps == 0.0 for item in resting) == 108
