"""Innovations in local coordinates, and the evaluation of Karle et al. 2023 with them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, WEST, Car, run_beside, update, write_run
from support.scripts import load

from fgtrack.core.types import Disposition, EgoState, TickReport
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.runs import evaluated
from fgtrack.evaluation.scores.innovations import local_innovations
from fgtrack.models.oval import make_oval
from fgtrack.runs import Run, RunWriter, load_run

paper = load("karle2023_table", "paper_tables")


def test_innovations_are_local_and_of_confirmed_tracks(tmp_path: Path) -> None:
    tracks = [
        [WEST.track(k, 1), WEST.track(k, 2, across_m=50.0, num_measured=2)]
        for k in range(6)
    ]
    updates = {
        0: [update(tick=0, disposition=Disposition.BIRTH)],
        3: [update("radar", tick=3, x_m=-0.5, y_m=0.25, speed_mps=2.0)],
        4: [
            update(tick=1, x_m=1.0, y_m=2.0),
            update(tick=4, index=1, track_id=2, x_m=9.0, y_m=9.0),
        ],
    }
    run = write_run(tmp_path / "run", tracks, updates=updates)
    rows, values, states = local_innovations(run)
    assert run.tables["updates"]["sensor"][rows].tolist() == [
        "radar",
        "lidar",
    ]  # not the birth, not track 2
    np.testing.assert_allclose(
        values["along_m"], [0.5, -1.0], atol=1e-9
    )  # WEST drives along -x
    np.testing.assert_allclose(values["across_m"], [-0.25, -2.0], atol=1e-9)
    np.testing.assert_allclose(values["speed_mps"], [2.0, np.nan])
    assert np.isnan(values["yaw_rad"]).all()  # neither measured nor on a map
    np.testing.assert_allclose(states[:, 3], 20.0)
    assert evaluate(run).residuals["speed_mps"].mean == 2.0
    samples = paper.ResidualSamples.of(run)
    assert samples.sensors.tolist() == ["lidar", "radar"]  # by stamp
    np.testing.assert_allclose(samples.observed_s, [0.02, 0.06])
    assert np.isnan(samples.ahead_m).all()  # no ego


@pytest.fixture
def on_the_oval(tmp_path: Path) -> Run:
    """An object on the line of the oval, headed 0.1 rad left of it; the ego is 30 m behind and 4 m right."""
    road = make_oval()
    x_m, y_m = road.position(np.array([100.0]), np.array([0.0]))[0]
    heading = float(road.view(np.array([[x_m, y_m]]), 0.0, 0.0).yaw_rad[0])
    car = Car(1, x_m, y_m, heading + 0.1, 50.0)
    c, s = math.cos(heading), math.sin(heading)
    ego = (x_m - 30.0 * c + 4.0 * s, y_m - 30.0 * s - 4.0 * c, heading, 60.0, 0.0, 0.0)
    with RunWriter(tmp_path / "run", json.dumps({"map": {"track": "oval"}})) as writer:
        writer.write_ego(EgoState(START_NS, START_NS, *ego))
        for tick in range(3):
            records = (
                update(tick=0, x_m=0.0, y_m=0.0),
                update(tick=0, index=1, x_m=0.0, y_m=0.0, yaw_rad=0.3),
            )
            report = TickReport(
                tick,
                START_NS + tick * TICK_NS,
                (car.track(tick, 1),),
                records if tick == 2 else (),
            )
            writer.write_tick(report, 1, 2)
        writer.finish({})
    return load_run(tmp_path / "run")


def test_without_a_measured_yaw_it_is_that_of_the_map(on_the_oval: Run) -> None:
    assert local_innovations(on_the_oval)[1]["yaw_rad"] == pytest.approx([-0.1, 0.3])


def test_an_object_is_ahead_and_left_of_the_ego_and_slower(on_the_oval: Run) -> None:
    found = paper.ResidualSamples.of(on_the_oval)
    assert found.ahead_m == pytest.approx([30.0, 30.0])
    assert found.left_m == pytest.approx([4.0, 4.0])
    assert found.distance_m == pytest.approx(2 * [math.hypot(30.0, 4.0)])
    assert found.relative_speed_mps == pytest.approx([-10.0, -10.0])


def test_the_tables_of_the_paper(tmp_path: Path) -> None:
    run = run_beside(tmp_path / "run")
    tables = paper.evaluation(evaluated(run))
    (row,) = tables.tables["residuals"].plain()
    assert row["along_mean_m"] == pytest.approx((149 * -0.3 + 2 * 1.0) / 151)
    assert (row["speed_mean_mps"], row["speed_std_mps"], row["yaw_mean_rad"]) == (
        2.0,
        0.0,
        None,
    )
    assert (row["precision"], row["num_confirmed"]) == (1.0, 1)
    groups = tables["residuals_by"].set_index("of")
    assert groups["num_samples"].to_dict() == {
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
    assert groups["along_mean_m"]["ahead 0 to 50 m, radar"] == pytest.approx(1.0)
    sensors = tables["sensors"].set_index("sensor")
    radar = sensors.loc["radar"]
    assert (radar["delay_mean_s"], radar["moved_max_m"]) == pytest.approx((0.1, 3.0))
    assert (radar["num_fused"], radar["num_objects"], radar["detections_median"]) == (
        2,
        1,
        2.0,
    )
    assert (
        radar["relative_speed_median_mps"],
        radar["ahead_median_m"],
    ) == pytest.approx((-10.0, 32.0))
    assert radar["distance_median_m"] == pytest.approx(math.hypot(32.0, 3.0))
    assert sensors["detections_median"]["lidar"] == 149.0
    assert tables["latency"][["num_ticks", "time_per_tick_mean_s"]].values.tolist() == [
        [150, pytest.approx(0.002)]
    ]
