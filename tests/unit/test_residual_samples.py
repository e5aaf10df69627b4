"""Innovations in local coordinates, with where and when each object was."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, WEST, Car, update, write_run

from fgtrack.core.types import Disposition, EgoState, TickReport
from fgtrack.evaluation.innovations import residual_samples
from fgtrack.evaluation.metrics import evaluate
from fgtrack.io.run import Run, RunWriter, load_run
from fgtrack.models.oval import make_oval


def test_samples_are_local_and_of_confirmed_tracks_by_time_of_the_detection(tmp_path: Path) -> None:
    tracks = [[WEST.track(k, 1), WEST.track(k, 2, across_m=50.0, num_measured=2)] for k in range(6)]
    updates = {
        0: [update(tick=0, disposition=Disposition.BIRTH)],
        3: [update("radar", tick=3, x_m=-0.5, y_m=0.25, speed_mps=2.0)],
        4: [update(tick=1, x_m=1.0, y_m=2.0), update(tick=4, index=1, track_id=2, x_m=9.0, y_m=9.0)],
    }
    found = residual_samples(write_run(tmp_path / "run", tracks, updates=updates))
    assert found.sensors.tolist() == ["lidar", "radar"]  # by stamp; not the birth, not track 2
    np.testing.assert_allclose(found.values["along_m"], [-1.0, 0.5], atol=1e-9)  # WEST drives along -x
    np.testing.assert_allclose(found.values["across_m"], [-2.0, -0.25], atol=1e-9)
    np.testing.assert_allclose(found.values["speed_mps"], [np.nan, 2.0])
    assert np.isnan(found.values["yaw_rad"]).all()  # neither measured nor on a map
    np.testing.assert_allclose(found.observed_s, [0.02, 0.06])
    np.testing.assert_allclose(found.object_speed_mps, 20.0)
    assert np.isnan(found.ahead_m).all()  # no ego
    assert found.moments(found.sensors == "radar")["speed_mps"].mean == 2.0
    again = evaluate(write_run(tmp_path / "again", tracks, updates=updates)).residuals
    assert str(again) == str(found.moments())  # NaN equals no NaN


@pytest.fixture
def on_the_oval(tmp_path: Path) -> Run:
    """An object on the line of the oval, headed 0.1 rad left of it; the ego is 30 m behind and 4 m right."""
    road = make_oval()
    x_m, y_m = road.position(np.array([100.0]), np.array([0.0]))[0]
    heading = float(road.heading(np.array([[x_m, y_m]]))[0])
    car = Car(1, x_m, y_m, heading + 0.1, 50.0)
    c, s = math.cos(heading), math.sin(heading)
    ego = (x_m - 30.0 * c + 4.0 * s, y_m - 30.0 * s - 4.0 * c, heading, 60.0, 0.0, 0.0)
    with RunWriter(tmp_path / "run", json.dumps({"map": {"track": "oval"}})) as writer:
        writer.write_ego(EgoState(START_NS, START_NS, *ego))
        for tick in range(3):
            records = (update(tick=0, x_m=0.0, y_m=0.0), update(tick=0, index=1, x_m=0.0, y_m=0.0, yaw_rad=0.3))
            report = TickReport(tick, START_NS + tick * TICK_NS, (car.track(tick, 1),), records if tick == 2 else ())
            writer.write_tick(report, 1, 2)
        writer.finish({})
    return load_run(tmp_path / "run")


def test_where_no_yaw_is_measured_the_map_stands_in_for_one(on_the_oval: Run) -> None:
    assert residual_samples(on_the_oval).values["yaw_rad"] == pytest.approx([-0.1, 0.3])


def test_an_object_is_ahead_and_left_of_the_ego_and_slower(on_the_oval: Run) -> None:
    found = residual_samples(on_the_oval)
    assert found.ahead_m == pytest.approx([30.0, 30.0])
    assert found.left_m == pytest.approx([4.0, 4.0])
    assert found.distance_m == pytest.approx(2 * [math.hypot(30.0, 4.0)])
    assert found.relative_speed_mps == pytest.approx([-10.0, -10.0])
