"""Latitude and longitude in every mapping, and tracks back."""

import json
import logging
import math
from dataclasses import replace
from types import SimpleNamespace as Message

import numpy as np
import pytest
from pymap3d import vincenty

from fgtrack.cli.main import run as command
from fgtrack.config.yaml_file import validate
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, TruthState
from fgtrack.inputs.formats.fields import objects_by_fields
from fgtrack.inputs.geodetic import LocalPlane, latitudes_longitudes_deg
from fgtrack.inputs.recording import write_recording
from fgtrack.inputs.settings import InputConfig, Origin
from fgtrack.inputs.source import open_input
from fgtrack.pipeline.public import replay
from fgtrack.runs import load_run

HERE = Origin(41.3, 2.08)
FLIGHT = [(41.3, 2.08), (41.31, 2.08), (41.31, 2.09)]


@pytest.mark.parametrize(
    ("north_deg", "east_deg"), [(0.3, 0.0), (0.0, 0.4), (-0.2, 0.3), (0.0, 0.0)]
)
def test_a_position_is_as_far_and_in_the_direction_that_the_geodesic_has(
    north_deg, east_deg
):
    latitude, longitude = HERE.latitude_deg + north_deg, HERE.longitude_deg + east_deg
    x_m, y_m = LocalPlane(HERE).position_m(latitude, longitude)
    distance_m, azimuth_deg = map(
        float,
        vincenty.vdist(HERE.latitude_deg, HERE.longitude_deg, latitude, longitude),
    )
    assert math.hypot(x_m, y_m) == pytest.approx(distance_m, rel=1e-4)
    assert x_m == pytest.approx(
        distance_m * math.sin(math.radians(azimuth_deg)), abs=1e-4 * distance_m
    )


def test_positions_come_back_to_a_micrometre_even_at_300_km():
    plane, rng = LocalPlane(HERE), np.random.default_rng(1)
    given = np.array([HERE.latitude_deg, HERE.longitude_deg]) + rng.uniform(
        -2.7, 2.7, (50, 2)
    )
    placed = np.array([plane.position_m(*row) for row in given.tolist()])
    latitude, longitude = latitudes_longitudes_deg(plane.origin_deg, *placed.T)
    assert np.abs(np.stack([latitude, longitude], axis=-1) - given).max() * 1.1e5 < 1e-6


def test_the_first_position_is_the_origin_and_what_is_not_on_earth_is_not_a_number():
    plane = LocalPlane()
    assert math.isnan(
        plane.position_m(91.0, 181.0)[0]
    )  # as AIS reports an unknown position
    assert plane.origin is None
    assert plane.position_m(*FLIGHT[0]) == (0.0, 0.0)
    assert plane.origin_deg == FLIGHT[0]
    assert math.isnan(plane.position_m(-41.3, -177.0)[0])  # the other side
    assert plane.in_plane(
        {"latitude_deg": None, "longitude_deg": 2.0, "score": 1.0}
    ) == {
        "x_m": None,
        "y_m": None,
        "score": 1.0,
    }


def test_far_positions_warn_once(caplog):
    here = replace(HERE, latitude_deg=41.2)  # of no other test
    plane, opened_again = LocalPlane(here), LocalPlane(here)
    with caplog.at_level(logging.WARNING):
        for _ in range(20):
            plane.position_m(here.latitude_deg + 0.85, here.longitude_deg)
        assert not caplog.records
        for k in range(12):
            # The distance of later positions does not matter.
            at_deg = here.latitude_deg + 1.0 + 0.01 * max(k - 9, 0)
            plane.position_m(at_deg, here.longitude_deg)
            opened_again.position_m(at_deg, here.longitude_deg)
    assert [record.message for record in caplog.records] == [
        "positions are 111 km from the origin 41.2000, 2.0800: set `input.origin` within 100 km of the positions"
    ]


def test_outlying_positions_give_no_advice_to_move_the_origin(caplog):
    here = replace(HERE, latitude_deg=41.3)
    plane = LocalPlane(here)
    with caplog.at_level(logging.WARNING):
        for k in range(1000):
            is_outlier = k % 50 == 0
            plane.position_m(here.latitude_deg + 3.0 * is_outlier, here.longitude_deg)
    assert not caplog.records


def table(folder, name="flight.csv"):
    lines = [
        f"{10 + k}.0,{10 + k}.5,{a},{b},900,4CA911" for k, (a, b) in enumerate(FLIGHT)
    ]
    (folder / name).write_text("\n".join(["t,seen,lat,lon,alt,hex", *lines]) + "\n")
    return folder / name


COLUMNS = {
    "stamp": "t",
    "receipt": "seen",
    "latitude_deg": "lat",
    "longitude_deg": "lon",
    "z_m": "alt",
    "id": "hex",
}


def test_a_table_gives_positions_in_the_map_and_keeps_altitude_and_id(tmp_path):
    config = validate(
        InputConfig, {"csv": {"detections": {"adsb": {"columns": COLUMNS}}}}, "test"
    )
    lists = list(open_input(table(tmp_path), config).messages())
    assert {(each.frame, each.origin_deg) for each in lists} == {("map", FLIGHT[0])}
    east, north = lists[2].objects[0].x_m, lists[1].objects[0].y_m
    assert (east, north) == (
        pytest.approx(837.0, abs=1.0),
        pytest.approx(1110.7, abs=1.0),
    )
    assert {(each.objects[0].z_m, each.objects[0].id) for each in lists} == {
        (900.0, "4CA911")
    }


def test_a_configured_origin_shifts_the_plane(tmp_path):
    settings = {"origin": {"latitude_deg": 41.31, "longitude_deg": 2.09}}
    config = validate(
        InputConfig,
        {"csv": {"detections": {"adsb": {"columns": COLUMNS}}}, **settings},
        "test",
    )
    last = list(open_input(table(tmp_path), config).messages())[-1]
    assert (last.objects[0].x_m, last.objects[0].y_m) == pytest.approx(
        (0.0, 0.0), abs=1e-6
    )


def test_truth_and_the_ego_may_be_on_earth(tmp_path):
    (tmp_path / "ego.csv").write_text("t,lat,lon,yaw,v\n1,41.3,2.08,0,5\n")
    (tmp_path / "cars.csv").write_text("t,id,lat,lon\n1,7,41.31,2.08\n")
    position = {"stamp": "t", "latitude_deg": "lat", "longitude_deg": "lon"}
    ego = {
        "file": "ego.csv",
        "columns": {**position, "yaw_rad": "yaw", "speed_mps": "v"},
    }
    truth = {"file": "cars.csv", "columns": {**position, "object_id": "id"}}
    config = validate(InputConfig, {"csv": {"ego": ego, "truth": truth}}, "test")
    state, other = sorted(
        open_input(tmp_path, config).messages(), key=lambda message: message.y_m
    )
    assert isinstance(state, EgoState)
    assert isinstance(other, TruthState)
    assert other.y_m - state.y_m == pytest.approx(1110.7, abs=1.0)


def test_fields_of_a_message_may_be_on_earth():
    item = Message(position=Message(latitude=41.31, longitude=2.08, altitude=12.0))
    fields = {
        "latitude_deg": "position.latitude",
        "longitude_deg": "position.longitude",
        "z_m": "position.altitude",
    }
    listed = objects_by_fields(item, fields, LocalPlane(HERE))
    assert listed.frame == "map"
    assert (listed.objects[0].y_m, listed.objects[0].z_m) == (
        pytest.approx(1110.7, abs=1.0),
        12.0,
    )


def stream(folder, **changed):
    item = {"latitude_deg": 41.31, "longitude_deg": 2.08, "id": "4CA911", **changed}
    records = [
        {"type": "header", "format": "fgtrack-stream/1"},
        {
            "type": "truth",
            "stamp_ns": 0,
            "receipt_ns": 0,
            "object_id": 1,
            "latitude_deg": 41.3,
            "longitude_deg": 2.08,
        },
        {
            "type": "detections",
            "sensor": "adsb",
            "stamp_ns": 0,
            "receipt_ns": 1,
            "objects": [item, item],
        },
    ]
    path = folder / "given.jsonl"
    path.write_text("".join(json.dumps(record) + "\n" for record in records))
    return path


def test_a_stream_may_be_on_earth(tmp_path):
    first, second = open_input(stream(tmp_path)).messages()
    assert (first.x_m, first.y_m) == (0.0, 0.0)
    assert second.frame == "map"
    assert second.objects[1].y_m == pytest.approx(1110.7, abs=1.0)
    with pytest.raises(DataError, match="longitude_deg: a number expected, not 'east'"):
        list(open_input(stream(tmp_path, longitude_deg="east")).messages())


@pytest.mark.parametrize("name", ["out.jsonl", "out"])
def test_origin_and_ids_survive_a_conversion(tmp_path, name):
    given = [
        DetectionList(
            "a", 0, 1, (Detection(1.0, 2.0, id="4CA911"),), "map", origin_deg=FLIGHT[0]
        )
    ]
    write_recording(tmp_path / name, given)
    assert list(open_input(tmp_path / name).messages()) == given


def test_tracks_go_back_to_earth(tmp_path, capsys):
    lines = [f"{k},{41.3 + 1e-4 * k},2.08,4CA911" for k in range(30)]
    (tmp_path / "flight.csv").write_text("\n".join(["t,lat,lon,hex", *lines]) + "\n")
    columns = {"stamp": "t", "latitude_deg": "lat", "longitude_deg": "lon", "id": "hex"}
    settings = {"input.csv.detections": {"adsb": {"columns": columns}}}
    replay(tmp_path / "flight.csv", set=settings, out=tmp_path / "run")
    run = load_run(tmp_path / "run")
    assert run.meta["origin"] == {"latitude_deg": 41.3, "longitude_deg": 2.08}
    assert run.tables["objects"]["id"].tolist() == ["4CA911"]
    assert (
        command(
            [
                "export",
                str(tmp_path / "run"),
                "--geojson",
                "-o",
                str(tmp_path / "a.geojson"),
            ]
        )
        == 0
    )
    (feature,) = json.loads((tmp_path / "a.geojson").read_text())["features"]
    assert feature["properties"]["id"] == "4CA911"
    assert feature["geometry"]["coordinates"][-1] == pytest.approx(
        [2.08, 41.3029], abs=2e-5
    )
    assert (
        command(
            [
                "export",
                str(tmp_path / "run"),
                "--geojson",
                "-o",
                str(tmp_path / "a.csv"),
            ]
        )
        == 0
    )
    rows = (tmp_path / "a.csv").read_text().splitlines()
    assert rows[0].endswith("latitude_deg,longitude_deg")
    assert float(rows[-1].split(",")[-2]) == pytest.approx(41.3029, abs=2e-5)


def test_a_run_without_an_origin_has_no_map(tmp_path, capsys):
    lists = [
        DetectionList("a", k * 10**8, k * 10**8, (Detection(float(k), 0.0),), "map")
        for k in range(20)
    ]
    replay(lists, out=tmp_path / "run")
    assert (
        command(
            [
                "export",
                str(tmp_path / "run"),
                "--geojson",
                "-o",
                str(tmp_path / "a.geojson"),
            ]
        )
        == 2
    )
    assert (
        "the map has no latitude and longitude; set `input.origin`"
        in capsys.readouterr().err
    )


def test_map_panels_get_fixes(tmp_path):
    pytest.importorskip(
        "foxglove", reason="foxglove-sdk is not installed (extra `foxglove`)"
    )
    from fgtrack.show.foxglove import values
    from fgtrack.show.shapes import ViewerMessage

    message = ViewerMessage(0, 0, "/tracks", (Detection(0.0, 1110.7),))
    assert [topic for topic, _ in values(message)] == ["/tracks/poses"]
    topics = dict(values(message, FLIGHT[0]))
    assert "latitude: 41.3100" in repr(topics["/tracks/fixes"]) or "41.3" in repr(
        topics["/tracks/fixes"]
    )


def of_origin(latitude_deg: float, longitude_deg: float) -> InputConfig:
    origin = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
    return validate(InputConfig, {"origin": origin}, "c.yaml")


@pytest.mark.parametrize(
    "wrong", [(-90.1, 0.0), (90.1, 0.0), (0.0, -180.1), (0.0, 180.1)]
)
def test_an_origin_lies_on_earth(wrong: tuple[float, float]) -> None:
    assert of_origin(-90.0, 180.0).origin == Origin(-90.0, 180.0)
    assert of_origin(90.0, -180.0).origin == Origin(90.0, -180.0)
    with pytest.raises(CallError, match="itude_deg"):
        of_origin(*wrong)
