"""Exclusion areas: what they contain, and what is no file of them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.tracking import START_NS

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, Disposition
from fgtrack.models.areas import ExclusionAreas
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config, MapConfig

SQUARE = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]
HOLE = [[4.0, 4.0], [6.0, 4.0], [6.0, 6.0], [4.0, 6.0], [4.0, 4.0]]
FAR = [[100.0, 0.0], [110.0, 0.0], [105.0, 9.0]]
POINTS = np.array([[1.0, 1.0], [5.0, 5.0], [105.0, 3.0], [50.0, 5.0], [np.nan, np.nan]])


def written(folder: Path, text: object, name: str = "shore.geojson") -> Path:
    path = folder / name
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    return path


def polygon(*rings: object) -> dict[str, object]:
    return {"type": "Polygon", "coordinates": rings}


@pytest.mark.parametrize(
    "content",
    [
        {"type": "MultiPolygon", "coordinates": [[SQUARE, HOLE], [FAR]]},
        {"type": "GeometryCollection", "geometries": [polygon(SQUARE, HOLE), polygon(FAR)]},
        {
            "type": "FeatureCollection",
            "features": [{"type": "Feature", "geometry": each} for each in (polygon(SQUARE, HOLE), polygon(FAR))],
        },
    ],
)
def test_polygons_of_geojson_have_holes_and_may_be_several(tmp_path: Path, content) -> None:
    areas = ExclusionAreas.read([written(tmp_path, content)])
    assert areas.contain(POINTS).tolist() == [True, False, True, False, False]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_csv_file_has_a_corner_a_row_and_may_name_its_polygons(tmp_path: Path, delimiter: str) -> None:
    rows = [("area", "x_m", "y_m"), *(("a", *corner) for corner in SQUARE), *(("b", *corner) for corner in FAR)]
    text = "# shore\n" + "\n".join(delimiter.join(map(str, row)) for row in rows)
    areas = ExclusionAreas.read([written(tmp_path, text, "shore.csv")])
    assert areas.contain(POINTS).tolist() == [True, True, True, False, False]
    alone = written(tmp_path, "x_m,y_m\n0,0\n10,0\n10,10\n", "one.csv")
    assert ExclusionAreas.read([alone]).contain(np.array([[9.0, 1.0], [1.0, 9.0]])).tolist() == [True, False]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "neither GeoJSON nor CSV|no polygon"),
        ("{", "no GeoJSON"),
        ("[" * 100_000, "no GeoJSON"),
        ({"type": "Point", "coordinates": [1, 2]}, "'Point' is no area"),
        ({"type": "Feature", "geometry": None}, "no GeoJSON"),
        ({"type": "FeatureCollection", "features": []}, "no polygon"),
        (polygon(), "without corners"),
        (polygon(SQUARE[:2]), "2 corners"),
        (polygon([[0.0, 1.0], ["a", 2.0], [3.0, 4.0]]), "not two numbers"),
        (polygon([[0.0, 1.0], [10**400, 2.0], [3.0, 4.0]]), "not two numbers"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, NaN], [5, 5]]]}', "not finite"),
        (polygon([[0.0, 1.0], [1e12, 2.0], [3.0, 4.0]]), "beyond"),
        (polygon([[10.401, 63.43], [10.402, 63.43], [10.402, 63.431]]), "degrees"),
        (polygon([[float(k), float(k * k)] for k in range(20_001)]), "at most 20000"),
        ("lon,lat\n1,2\n", "x_m and y_m"),
        ("x_m,y_m\n1,2\n1,zwei\n", "zwei"),
        ("x_m,y_m\n1,2\n1\n3,4\n", "neither"),
    ],
)
def test_what_is_no_area_is_refused_in_one_line(tmp_path: Path, text, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(DataError, match=said) as caught:
        ExclusionAreas.read([path])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300 + len(str(path))


def test_files_that_are_too_large_missing_or_binary_are_refused(monkeypatch, tmp_path: Path) -> None:
    with pytest.raises(CallError, match="no such file"):
        ExclusionAreas.read([tmp_path / "none.geojson"])
    binary = tmp_path / "b"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="no text"):
        ExclusionAreas.read([binary])
    monkeypatch.setattr("fgtrack.models.areas._LARGEST_MB", 2e-5)
    with pytest.raises(DataError, match="larger than"):
        ExclusionAreas.read([written(tmp_path, polygon(SQUARE))])


@pytest.mark.parametrize("kind", ["counting", "published"])
def test_a_detection_in_an_exclusion_area_is_out_of_bounds_and_starts_no_track(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, polygon(SQUARE, HOLE))
    sensors = {"lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}), "camera": SensorModel(std={"bearing_rad": 0.1})}
    config = replace(Config(), sensors=sensors, map=MapConfig(excluded=(str(path),)))
    one = build_tracker(replace(config, lifecycle=replace(config.lifecycle, kind=kind)))
    seen = [Detection(x_m=x_m, y_m=y_m) for x_m, y_m in ((1.0, 1.0), (5.0, 5.0), (50.0, 5.0))]
    one.receive(DetectionList("lidar", START_NS, START_NS, seen, "map"))
    one.receive(DetectionList("camera", START_NS, START_NS, [Detection(bearing_rad=0.0)], "map"))
    report = one.tick(START_NS)
    became = {(each.sensor, each.index): (each.disposition, each.reason) for each in report.updates}
    assert became["lidar", 0] == (Disposition.OUT_OF_BOUNDS, "map.excluded")
    assert became["camera", 0][1] is None
    assert sorted(round(track.x_m) for track in report.tracks) == [5, 50]
