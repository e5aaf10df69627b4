import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import ROUND, WEST, update, write_run
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fgtrack.core.types import Disposition, TrackReport
from fgtrack.evaluation.metrics import Metrics, ObjectMetrics, evaluate
from fgtrack.evaluation.scores.statistics import Moments
from fgtrack.runs import Run


@settings(deadline=None)
@given(
    hnp.arrays(np.float64, st.integers(1, 20), elements=st.floats(-1.0, 1.0)),
    st.floats(-3.0, 3.0),
)
def test_the_spread_of_angles_does_not_depend_on_where_they_point(
    angles: np.ndarray, turn: float
) -> None:
    here = Moments.of(angles)
    there = Moments.of_angles(
        np.array([math.remainder(a + turn, 2 * math.pi) for a in angles])
    )
    assert there.std == pytest.approx(here.std, abs=1e-7)
    assert math.remainder(there.mean - here.mean - turn, 2 * math.pi) == pytest.approx(
        0.0, abs=1e-9
    )


@pytest.fixture
def story(tmp_path: Path) -> Run:
    """Ten ticks. WEST: track 1, lost at 3 and 4, track 1 again at 5, track 2 from 7. ROUND: track 3, all but
    the last two ticks. Track 4 follows nothing, track 5 was measured once. Truth of ROUND ends at tick 8.
    """
    tracks = []
    for k in range(10):
        rows = []
        if k < 3 or 5 <= k < 7:
            rows.append(
                WEST.track(
                    k, 1, along_m=1.5, across_m=2.0, yaw_rad=-0.2, speed_mps=-1.0
                )
            )
        if k >= 7:
            rows.append(
                WEST.track(k, 2, along_m=-1.5, across_m=2.0, yaw_rad=0.2, speed_mps=1.0)
            )
        if k < 8:
            rows.append(ROUND.track(k, 3, along_m=1.0))
        rows.append(WEST.track(k, 4, across_m=60.0))
        if k == 4:
            rows.append(WEST.track(k, 5, num_measured=1))
        tracks.append(rows)
    truth = [*WEST.truth(range(10)), *ROUND.truth(range(9))]
    return write_run(tmp_path / "story", tracks, truth=truth)


def objects_of(metrics: Metrics) -> dict[int, ObjectMetrics]:
    assert metrics.truth is not None
    return dict(metrics.truth.objects)


def test_time_tracked_breaks_and_switches_are_counted(story: Run) -> None:
    objects = objects_of(evaluate(story))
    west, round_ = objects[7], objects[8]
    assert (west.ticks_present, west.ticks_tracked, west.breaks, west.id_switches) == (
        10,
        8,
        2,
        1,
    )
    assert (
        round_.ticks_present,
        round_.ticks_tracked,
        round_.breaks,
        round_.id_switches,
    ) == (9, 8, 0, 0)
    assert west.tracked_share == pytest.approx(0.8)


def test_false_tracks_and_precision(story: Run) -> None:
    metrics = evaluate(story)
    assert metrics.truth is not None
    assert (metrics.num_tracks, metrics.num_confirmed) == (5, 4)
    assert (metrics.truth.judged_tracks, metrics.truth.false_tracks) == (4, 1)
    assert metrics.precision == pytest.approx(2 / 4)


def test_precision_counts_every_visit_of_an_object(tmp_path: Path) -> None:
    """WEST is there for 0.2 s, and comes by again 1.8 s later."""
    again = dataclasses.replace(WEST, x_m=WEST.x_m + 40.0)
    moments = [(WEST, range(10)), (again, range(100, 110))]
    truth = [row for car, ticks in moments for row in car.truth(ticks)]
    tracks: list[list[TrackReport]] = [[] for _ in range(110)]
    for car, ticks in moments:
        for tick in ticks:
            tracks[tick] = [car.track(tick, 1)]
    metrics = evaluate(write_run(tmp_path / "run", tracks, truth=truth))
    assert metrics.truth is not None
    assert metrics.truth.tracked_visits == 2
    assert metrics.precision == 2.0  # one track for both


def test_truth_without_heading_gives_position_errors_only(tmp_path: Path) -> None:
    tracks = [[WEST.track(k, 1, along_m=0.3, across_m=0.4)] for k in range(3)]
    run = write_run(tmp_path / "run", tracks, truth=WEST.truth(range(3), pose=False))
    errors = objects_of(evaluate(run))[7].errors
    assert errors["position_m"].rmse == pytest.approx(0.5)
    assert [
        errors[name].count for name in ("along_m", "across_m", "yaw_rad", "speed_mps")
    ] == [0] * 4


@pytest.mark.parametrize(
    "start_yaw_rad", [0.3, math.pi - 0.005], ids=["anywhere", "over the jump"]
)
def test_residuals_turn_into_the_direction_of_the_track(
    tmp_path: Path, start_yaw_rad: float
) -> None:
    car = dataclasses.replace(ROUND, yaw_rad=start_yaw_rad)
    yaw_rad = car.state(0.01)[2]  # half a tick after the first
    forward = {"x_m": 2.0 * math.cos(yaw_rad), "y_m": 2.0 * math.sin(yaw_rad)}
    record = update(nis=1.5, **forward)
    between = dataclasses.replace(record, stamp_ns=record.stamp_ns + 10_000_000)
    metrics = evaluate(
        write_run(
            tmp_path / "run",
            [[car.track(k, 1)] for k in range(3)],
            updates={1: [between]},
        )
    )
    residuals = metrics.sensors["lidar"].residuals
    assert residuals["along_m"].mean == pytest.approx(2.0)
    assert residuals["across_m"].mean == pytest.approx(0.0, abs=1e-9)
    assert residuals["x_m"].mean == pytest.approx(forward["x_m"])


def test_residuals_and_nis_are_summed_by_sensor(tmp_path: Path) -> None:
    updates = {
        0: [update(disposition=Disposition.BIRTH)],
        1: [
            update(tick=1, nis=1.0, x_m=1.0, y_m=0.0, yaw_rad=math.pi - 0.1),
            update(tick=1, nis=3.0, x_m=3.0, y_m=0.0, yaw_rad=-math.pi + 0.1, index=1),
            update("radar", tick=1, nis=4.0, speed_mps=-2.0),
        ],
    }
    metrics = evaluate(write_run(tmp_path / "run", updates=updates))
    sensors, nis = metrics.sensors, metrics.consistency.nis["lidar"]
    lidar = sensors["lidar"]
    assert (lidar.residuals["x_m"].mean, lidar.residuals["x_m"].std) == (2.0, 1.0)
    assert abs(lidar.residuals["yaw_rad"].mean) == pytest.approx(math.pi)
    assert lidar.residuals["yaw_rad"].std == pytest.approx(0.1)
    assert (nis.mean, nis.dof, nis.count) == (2.0, 3.0, 2)
    assert set(sensors["radar"].residuals) == {"speed_mps"}
    assert "along_m" not in lidar.residuals  # track 1 was never published


def test_dispositions_sum_to_the_detections_received(tmp_path: Path) -> None:
    updates = {
        k: [update(index=k, disposition=name)] for k, name in enumerate(Disposition)
    }
    updates[0].append(update("radar", disposition=Disposition.GATED))
    metrics = evaluate(write_run(tmp_path / "run", updates=updates))
    assert dict(metrics.sensors["lidar"].dispositions) == {
        name.value: 1 for name in Disposition
    }
    assert metrics.sensors["lidar"].detections == len(Disposition)
    assert metrics.sensors["radar"].dispositions["gated"] == 1
    assert sum(sensor.detections for sensor in metrics.sensors.values()) == 13


def test_the_delay_of_a_message_counts_once(tmp_path: Path) -> None:
    late, soon = 200_000_000, 100_000_000
    updates = {
        0: [update(index=k, delay_ns=late) for k in range(8)],
        5: [update(tick=5, delay_ns=soon)],
    }
    delay_s = (
        evaluate(write_run(tmp_path / "run", updates=updates)).sensors["lidar"].delay_s
    )
    assert (delay_s.count, delay_s.max) == (2, 0.2)
    assert delay_s.mean == pytest.approx(0.15)
    assert delay_s.p90 == pytest.approx(0.19)


def test_metrics_are_strict_json(story: Run) -> None:
    plain = evaluate(story).as_dict()
    again = json.loads(json.dumps(plain, allow_nan=False))
    assert again == plain
    assert again["truth"]["objects"]["7"]["errors"]["position_m"][
        "rmse"
    ] == pytest.approx(2.5)
    assert again["truth"]["overall"]["tracked_share"] == pytest.approx(16 / 19)
    assert again["precision"] == 0.5
    assert list(again["truth"]["overall"]["errors"]["position_m"]) == [
        "count",
        "mean",
        "std",
        "rmse",
    ]
    assert list(again["consistency"]["position_nees"]) == [
        "count",
        "mean",
        "dof",
        "band_low",
        "band_high",
    ]
    assert list(again["consistency"]["position_nees_interval"]) == [
        "mean",
        "low",
        "high",
        "count",
    ]
