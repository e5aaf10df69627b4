"""The experiment on real recordings runs, and says what it measured."""

import csv
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scripts import EXPERIMENTS, load

from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.pipeline.shipped import read_config

sys.path.insert(0, str(EXPERIMENTS / "real_data"))

script = load("real_data")
cameras = load("real_data", "bearings")
held_out = load("real_data", "held_out")
left_out = load("real_data", "leave_one_out")
late = load("real_data", "delayed")
rules, costs = sys.modules["rules"], sys.modules["costs"]
DATA = Path(__file__).resolve().parents[2] / "../shared/data"


@pytest.mark.skipif(not (DATA / "autoferry" / "scenario4").is_dir(), reason="needs ../shared/data/autoferry")
def test_tracks_are_better_than_their_raw_detections(tmp_path: Path) -> None:
    script.main(autoferry=DATA / "autoferry", out=tmp_path, estimators="ekf-replay", scenarios="scenario4")
    with (tmp_path / "autoferry_scores.csv").open(newline="") as file:
        first, *averages = csv.DictReader(file)
    assert tuple(first) == held_out.HEADER
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
    held_out.main(DATA / "autoferry", tmp_path, estimators="ekf-replay", judge="scenario2", delays_s="0.5")
    with (tmp_path / "rules.csv").open(newline="") as file:
        without, everything = csv.DictReader(file)
    assert (without.pop("held_out"), everything.pop("held_out")) == ("scenario2", "none")
    assert without != everything
    shipped = held_out.numbers(read_config("autoferry"))
    assert {key: float(value) for key, value in everything.items()} == pytest.approx(shipped)
    with (tmp_path / "scores.csv").open(newline="") as file:
        assert float(next(csv.DictReader(file))["mota"]) > 40.0
    with (tmp_path / "0.5_s_scores.csv").open(newline="") as file:
        assert float(next(csv.DictReader(file))["mota"]) > 40.0
    with (tmp_path / "costs.csv").open(newline="") as file:
        assert [(row["delay_s"], row["estimator"]) for row in csv.DictReader(file)] == [("0.5", "ekf-replay")] * 2


KITTI = DATA / "kitti"


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti")
def test_the_score_of_one_drive_follows_from_another(tmp_path: Path) -> None:
    left_out.main(kitti=KITTI, out=tmp_path, sequences="0006,0010", estimator="ekf-replay")
    with (tmp_path / "leave_one_out.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["sequence"] for row in rows] == ["0006", "0010"]
    for row in rows:
        assert 3.0 < float(row["even"]) < 6.0
        assert float(row["mota"]) > max(float(row["mota_raw_2"]), float(row["mota_raw_3"])) - 1.0
        assert int(row["id_switches"]) <= 2


def test_the_even_score_is_where_objects_and_clutter_are_as_frequent() -> None:
    """Scores of clutter and of objects are normal with the same variance: the log ratio is a line."""
    rng = np.random.default_rng(4)
    clutter, cars = rng.normal(2.0, 1.0, 20_000), rng.normal(4.0, 1.0, 5_000)
    found = left_out.Labelled(np.concatenate([clutter, cars]), np.arange(25_000) >= 20_000)
    score = left_out.fitted([found])
    assert score.even == pytest.approx(3.0, abs=0.05)  # half way between the means
    assert score.scale == pytest.approx(0.5, abs=0.02)  # variance / difference of the means


def test_the_share_that_lasts_gives_the_differences_of_successive_errors() -> None:
    """Errors with a lasting part of 10 s and a white one, seen twice a second: the rules find both."""
    rng = np.random.default_rng(1)
    steps, sigma_m, share, time_s, period_s = 20_000, 4.0, 0.9, 10.0, 0.5
    keep = math.exp(-period_s / time_s)
    lasting = np.zeros((steps, 2))
    drawn = rng.normal(0.0, 1.0, (steps, 2))
    lasting[0] = drawn[0]
    for k in range(1, steps):
        lasting[k] = keep * lasting[k - 1] + math.sqrt(1.0 - keep**2) * drawn[k]
    errors_m = sigma_m * (math.sqrt(share) * lasting + math.sqrt(1.0 - share) * rng.normal(0.0, 1.0, (steps, 2)))
    track = [(period_s * k, error) for k, error in enumerate(errors_m)]
    found_share, found_s = rules.lasting([track[k : k + 100] for k in range(0, steps, 100)], sigma_m**2)
    assert found_share == pytest.approx(share, abs=0.02)
    assert found_s == pytest.approx(time_s, abs=5.0)


def test_every_second_list_is_of_the_second_sensor() -> None:
    lists = [DetectionList(late.LIDAR, k, k, [Detection(x_m=float(k), y_m=0.0)]) for k in range(5)]
    found = list(late.halves([EgoState(0, 0, 0.0, 0.0, 0.0, 0.0), *lists]))
    assert [one.sensor for one in found[1:]] == [late.LIDAR, late.SECOND, late.LIDAR, late.SECOND, late.LIDAR]
    assert [one.objects for one in found[1:]] == [one.objects for one in lists]


def test_costs_are_of_squares_in_pairs() -> None:
    """Two estimators over 400 stamps: the first one costs nothing, the second one 1 m."""
    ticks = np.tile([4.0, 4.0, 4.0, 9.0, 1.0], (400, 1))
    first, second = costs.rows([{"position_rmse_m": ticks[:100]}, {"position_rmse_m": ticks[100:]}], ("a", "b"))
    assert first == ["position_rmse_m", "a", "2.000", "2.000", "0.000 (0.000 to 0.000)", "1.000 (1.000 to 1.000)"]
    assert second == ["position_rmse_m", "b", "2.000", "3.000", "1.000 (1.000 to 1.000)", ""]


@pytest.mark.skipif(not KITTI.is_dir(), reason="needs ../shared/data/kitti")
def test_forgotten_positions_cost_backward_forward_more(tmp_path: Path) -> None:
    late.main(kitti=KITTI, out=tmp_path, sequences="0006", arrangements="halves")
    with (tmp_path / "costs.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["quantity"] == "position_rmse_m"]
    assert [row["estimator"] for row in rows] == list(late.ESTIMATORS)
    *others, forgets = (float(row["cost_m"].split()[0]) for row in rows)
    assert all(0.0 < other < forgets for other in others)
    with (tmp_path / "scores.csv").open(newline="") as file:
        assert all(float(row["mota_prompt"]) > 60.0 for row in csv.DictReader(file))
