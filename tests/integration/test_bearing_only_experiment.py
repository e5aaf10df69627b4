import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.messages import shared
from support.scripts import load

from fgtrack.core.types import DetectionList

observer = load("bearing_only")
cameras = load("bearing_only", "cameras")
drives = load("bearing_only", "drives")


def rows(file: Path) -> list[dict[str, str]]:
    with file.open() as lines:
        return list(csv.DictReader(lines))


def test_the_observer_writes_table_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    observer.main(tmp_path, runs=2, share=0.2, cases="ekf-replay;smoother")
    found = rows(tmp_path / "bearing_only.csv")
    assert [(row["world"], row["estimator"]) for row in found] == [
        (world, name) for world in observer.WORLDS for name in ("ekf-replay", "smoother")
    ]
    assert (tmp_path / "bearing_only.png").read_bytes().startswith(b"\x89PNG")
    assert "lost_percent" in capsys.readouterr().out


def test_every_case_has_the_same_start_and_bearings_that_fit_the_truth() -> None:
    world = observer.WORLDS["ship"]
    drawn = observer.pursuit(world, np.random.default_rng(1), world.last_s)
    errors = [
        item.model.residual(item.z, item.model.predict(state, item.pose))[0]
        for item, state in zip(drawn.measurements, drawn.truth, strict=True)
    ]
    assert np.std(errors) == pytest.approx(world.bearing_std_rad, rel=0.4)
    assert set(observer.chosen(None)) >= {"ekf-replay", "smoother"}


def test_the_observer_turns_between_its_courses() -> None:
    world = observer.WORLDS["ship"]
    places = world.observer(world.steps(world.last_s))
    steps = np.diff(places, axis=0)
    assert np.hypot(*steps.T) == pytest.approx(world.observer_mps * world.step_s)
    assert np.degrees(np.arctan2(*steps[[0, -1], ::-1].T)) == pytest.approx([-50.0, 70.0])


def test_the_cameras_write_a_table(tmp_path: Path) -> None:
    cameras.main(tmp_path, runs=2, duration_s=1.5)
    found = rows(tmp_path / "cameras.csv")
    cases = [("white", "white"), ("lasting", "white"), ("lasting", "lasting")]
    assert [(row["errors"], row["modelled_as"]) for row in found[::2]] == cases
    assert [row["estimator"] for row in found[:2]] == ["ekf-replay", "smoother"]


def test_lasting_errors_resemble_each_other_and_are_as_large() -> None:
    correlations = {}
    for errors in cameras.ERRORS:
        first: list[float] = []
        lists = cameras.drive(errors, 60.0, np.random.default_rng(3))
        still = cameras.drive(errors, 60.0, np.random.default_rng(3))
        assert lists == still
        found = {
            item.stamp_ns: item.objects for item in lists if isinstance(item, DetectionList) and item.sensor == "left"
        }
        states = {(item.stamp_ns, item.object_id): item for item in lists if hasattr(item, "object_id")}
        for k, (stamp_ns, objects) in enumerate(sorted(found.items())):
            truth = states[stamp_ns, 0]
            offset = truth.x_m - cameras.EGO_MPS * k * cameras.PERIOD_S - 1.0, truth.y_m - 0.5
            error = objects[0].bearing_rad - np.arctan2(offset[1], offset[0])
            first.append(float(np.angle(np.exp(1j * error))))
        assert np.std(first) == pytest.approx(cameras.BEARING_STD_RAD, rel=0.35)
        correlations[errors] = np.corrcoef(first[:-1], first[1:])[0, 1]
    assert abs(correlations["white"]) < 0.15
    assert 0.5 < correlations["lasting"] < 0.9


def test_errors_of_a_real_drive_are_replaced_one_property_at_a_time() -> None:
    seen = drives.sightings(shared("data/kitti"), "0006")
    car = max(seen.values(), key=len)
    places = {item.stamp_ns: item for item in car if item.sensor == drives.CAMERA}
    car = [item for item in car if item.sensor == drives.LIDAR or places[item.stamp_ns] is item]  # one box per scan

    def errors(label: str) -> np.ndarray:
        found = drives.measured(car, drives.CASES[label], np.random.default_rng(1))
        bearings = [item for _, item in found if item.model is drives.BEARING]
        return np.array([places[item.stamp_ns]._replace(z=item.z).error_rad for item in bearings])

    raw = errors("as measured")
    assert len(raw) == len(places)
    np.testing.assert_allclose(np.sort(errors("in random order")), np.sort(raw), atol=1e-12)
    assert errors("without the mean of each car").mean() == pytest.approx(0.0, abs=1e-12)
    assert np.std(errors("drawn, white")) == pytest.approx(drives.BEARING_STD_RAD, rel=0.3)
    assert not len(errors("LiDAR alone"))
    for name in ("ekf-replay", "smoother"):
        rows = drives.judged(name, car, drives.CASES["as measured"], np.random.default_rng(1))
        assert np.isfinite(np.nanmean(rows, axis=0)).all()


def test_the_cure_is_the_shipped_configuration() -> None:
    found = drives.cures(drives.read_config("kitti"))
    assert found["both (kitti.yaml)"] == drives.read_config("kitti")
    assert [name for name, config in found.items() if config.sensors[drives.LIDAR].correlation is None] == [
        "neither",
        "std from the box",
    ]
    assert drives.CAMERA not in found["no camera"].sensors
    assert replace(found["correlation"].input.kitti, box_std=0.06) == found["both (kitti.yaml)"].input.kitti
