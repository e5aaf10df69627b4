"""The tables of the evaluation of Karle et al. 2023."""

import math
from pathlib import Path

import pytest
from evaluation_runs import WEST, run_beside, write_run

from fgtrack.evaluation.compare import compare
from fgtrack.io.run import Run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return run_beside(tmp_path / "run")


def test_residuals_of_all_sensors_stand_beside_the_precision(run: Run) -> None:
    (row,) = compare(run)["residuals"].records()
    assert row["along_mean_m"] == pytest.approx((149 * -0.3 + 2 * 1.0) / 151)
    assert row["across_mean_m"] == pytest.approx(149 * -0.1 / 151)
    assert (row["speed_mean_mps"], row["speed_std_mps"]) == (2.0, 0.0)
    assert row["yaw_mean_rad"] is None
    assert (row["precision"], row["num_confirmed"]) == (1.0, 1)


def test_residuals_are_grouped_by_time_speed_and_place(run: Run) -> None:
    rows = {str(row["of"]): row for row in compare(run)["residuals_by"].records()}
    assert {name: row["num_samples"] for name, row in rows.items()} == {
        "observed below 1 s, lidar": 49,
        "observed 1 to 2 s, lidar": 50,
        "observed 1 to 2 s, radar": 1,
        "observed 2 to 3 s, lidar": 50,
        "observed 2 to 3 s, radar": 1,
        "speed below 40 m/s, lidar": 149,
        "speed below 40 m/s, radar": 2,
        "ahead 0 to 50 m, lidar": 149,
        "ahead 0 to 50 m, radar": 2,
    }
    assert rows["ahead 0 to 50 m, radar"]["along_mean_m"] == pytest.approx(1.0)


def test_what_the_sensors_saw_is_told_by_sensor(run: Run) -> None:
    rows = {row["sensor"]: row for row in compare(run)["sensed"].records()}
    radar = rows["radar"]
    assert (radar["delay_mean_s"], radar["delay_max_s"]) == pytest.approx((0.1, 0.1))
    assert radar["moved_max_m"] == pytest.approx(3.0)
    assert (radar["num_fused"], radar["num_objects"], radar["detections_median"]) == (2, 1, 2.0)
    assert rows["lidar"]["num_objects"] == 1
    assert radar["relative_speed_median_mps"] == pytest.approx(-10.0)
    assert radar["ahead_median_m"] == pytest.approx(32.0)
    assert radar["distance_median_m"] == pytest.approx(math.hypot(32.0, 3.0))
    assert rows["lidar"]["detections_median"] == 149.0


def test_latency_is_of_the_ticks_with_detections(run: Run) -> None:
    (row,) = compare(run)["latency"].records()
    assert (row["num_ticks"], row["time_per_tick_mean_s"], row["time_per_tick_p90_s"]) == pytest.approx(
        (150, 0.002, 0.002)
    )


def test_without_truth_nothing_is_predicted(tmp_path: Path) -> None:
    assert not compare(write_run(tmp_path / "run", [[WEST.track(0, 1)]]))["predictions"].num_rows


def test_predictions_are_a_row_for_each_run_and_predictor(run: Run) -> None:
    (row,) = compare(run)["predictions"].records()
    assert (row["predictor"], row["fde_1s_m"], row["fde_5s_m"]) == ("arc", pytest.approx(2.0), None)
