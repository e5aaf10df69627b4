import csv
import math
from pathlib import Path

import pytest
from support.scripts import load

from fgtrack.core.types import Detection, DetectionList


def test_every_rival_is_compared_on_the_same_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A few seconds of one seed, in which the map's curvature is in force."""
    rivals = load("rivals")
    scenes = "default, fitted noise;default, LiDAR worse with distance"
    rivals.main(tmp_path, scenes, seeds=1, duration_s=4.0)
    assert (tmp_path / "tables.md").read_text() + "\n" == capsys.readouterr().out
    with (tmp_path / "runs.csv").open(newline="") as file:
        found = {(row["scene"], row["contestant"]): row for row in csv.DictReader(file)}
    assert set(found) == {(scene, name) for scene in scenes.split(";") for name in rivals.SCENES[scene].contestants}
    yaw_deg = [float(found["default, fitted noise", name]["yaw_deg"]) for name in ("EKF", "EKF, curvature 0.001")]
    assert yaw_deg[1] < yaw_deg[0]


def test_ranges_and_bearings_become_points() -> None:
    polar = DetectionList("lidar_cluster", 1, 2, [Detection(range_m=10.0, bearing_rad=math.pi / 6.0)], frame="sensor")
    other = DetectionList("radar", 1, 2, [Detection(range_m=10.0, bearing_rad=0.1)], frame="sensor")
    points, same = load("rivals").in_points([polar, other], "lidar_cluster")
    [point] = points.objects
    assert (point.x_m, point.y_m, point.range_m) == (pytest.approx(10.0 * math.sqrt(0.75)), pytest.approx(5.0), None)
    assert same is other
