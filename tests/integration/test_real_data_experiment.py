"""The experiment on real recordings runs, and says what it measured."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scripts import load

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
