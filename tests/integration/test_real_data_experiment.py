"""The experiment on real recordings runs, and says what it measured."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scripts import EXPERIMENTS, load

from fgtrack.pipeline.shipped import read_config

script = load("real_data")
cameras = load("real_data", "bearings")
sys.modules["real_data"] = script  # as where the script beside it runs
held_out = load("real_data", "held_out")
DATA = Path(__file__).resolve().parents[2] / "../shared/data"


@pytest.mark.skipif(not (DATA / "autoferry" / "scenario4").is_dir(), reason="needs ../shared/data/autoferry")
def test_tracks_are_better_than_their_raw_detections(tmp_path: Path) -> None:
    script.main(autoferry=DATA / "autoferry", out=tmp_path, estimators="ekf-replay", scenarios="scenario4")
    with (tmp_path / "autoferry_scores.csv").open(newline="") as file:
        first, *averages = csv.DictReader(file)
    assert tuple(first) == script.HEADER
    assert float(first["mota"]) > float(first["mota_raw"]) + 20.0
    assert [row["recording"] for row in averages] == ["median", "mean"]
    assert averages[0]["mota"] == first["mota"]


@pytest.mark.skipif(not (DATA / "autoferry" / "scenario2").is_dir(), reason="needs ../shared/data/autoferry")
def test_bearings_of_real_cameras_err_for_seconds_and_take_part(tmp_path: Path) -> None:
    cameras.main(DATA / "autoferry", out=tmp_path, scenarios="scenario2", seconds=25.0)
    with (tmp_path / "bearings.csv").open(newline="") as file:
        errors = list(csv.DictReader(file))
    assert [row["camera"] for row in errors] == ["infrared", "daylight"]
    assert all(float(row["lasts_1_s"]) > 0.5 for row in errors)
    with (tmp_path / "gains.csv").open(newline="") as file:
        none, *used = csv.DictReader(file)
    assert (none["cameras"], none["nis_daylight"]) == ("none", "nan")
    assert [row["cameras"] for row in used] == ["white", "lasting"]
    assert all(float(row["nis_daylight"]) > 0.0 for row in used)


def test_errors_of_bearings_are_those_of_the_vessel_that_is_alone_in_that_direction() -> None:
    series = cameras.Series(np.array([0, 10**9, 2 * 10**9]), np.array([0.1, 0.1, -0.1]))
    assert cameras.product(series, series, 0.0) == (pytest.approx(0.03), 3)
    assert cameras.product(series, series, 1.0) == (pytest.approx(0.0), 2)
    assert cameras.product(series, cameras.Series(np.zeros(0, dtype=np.int64), np.zeros(0)), 0.0) == (0.0, 0)


@pytest.mark.skipif(not (DATA / "autoferry" / "scenario6").is_dir(), reason="needs ../shared/data/autoferry")
def test_the_shipped_numbers_are_those_of_the_rules_and_a_scenario_is_judged_without_its_own(tmp_path: Path) -> None:
    held_out.main(DATA / "autoferry", tmp_path, estimators="ekf-replay", judge="scenario2", delay_s=0.5)
    with (tmp_path / "rules.csv").open(newline="") as file:
        without, everything = csv.DictReader(file)
    assert (without.pop("held_out"), everything.pop("held_out")) == ("scenario2", "none")
    assert without != everything
    shipped = held_out.numbers(read_config("autoferry"))
    assert {key: float(value) for key, value in everything.items()} == pytest.approx(shipped)
    with (tmp_path / "scores.csv").open(newline="") as file:
        assert float(next(csv.DictReader(file))["mota"]) > 40.0
    assert (tmp_path / "scenario2.jsonl").is_file()


KITTI = DATA / "kitti"


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti")
def test_the_score_of_one_drive_follows_from_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXPERIMENTS / "real_data"))
    left_out = load("real_data", "leave_one_out")
    left_out.main(kitti=KITTI, out=tmp_path, sequences="0006,0010", estimator="ekf-replay")
    with (tmp_path / "leave_one_out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["sequence"] for row in rows] == ["0006", "0010"]
    for row in rows:
        assert 3.0 < float(row["even"]) < 6.0
        assert float(row["mota"]) > max(float(row["mota_raw_2"]), float(row["mota_raw_3"])) - 1.0
        assert int(row["id_switches"]) <= 2


def test_the_even_score_is_where_objects_and_clutter_are_as_frequent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores of clutter and of objects are normal with the same variance: the log ratio is a line."""
    monkeypatch.syspath_prepend(str(EXPERIMENTS / "real_data"))
    left_out = load("real_data", "leave_one_out")
    rng = np.random.default_rng(4)
    clutter, cars = rng.normal(2.0, 1.0, 20_000), rng.normal(4.0, 1.0, 5_000)
    found = left_out.Labelled(np.concatenate([clutter, cars]), np.arange(25_000) >= 20_000)
    score = left_out.fitted([found])
    assert score.even == pytest.approx(3.0, abs=0.05)  # half way between the means
    assert score.scale == pytest.approx(0.5, abs=0.02)  # variance / difference of the means


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti")
def test_a_late_lidar_costs_every_estimator_something(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    late = load("real_data", "delayed")
    late.main(kitti=KITTI, out=tmp_path, sequences="0006")
    with (tmp_path / "delayed.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["estimator"] for row in rows] == list(late.ESTIMATORS)
    assert all(int(row["samples"]) > 100 and float(row["cost_m"]) > 0.0 for row in rows)
    assert "smoother: costs less than ekf-backward-forward by" in capsys.readouterr().out
