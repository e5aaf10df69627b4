"""What some sensor could have seen, and that only this counts as missed."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, update

from fgtrack.core.types import (
    EgoState,
    TickReport,
    TrackReport,
    TrackState,
    TrackStatus,
    TruthState,
)
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.tables.compare import compare
from fgtrack.evaluation.truth import ego_states, true_paths, visible
from fgtrack.runs import Run, RunWriter, load_run

#: Front RADAR: 90 degrees, 100 m; LiDAR: all around, 50 m ahead, 20 m behind, mounted 2 m ahead of the frame.
CONFIG = """
sensors:
  radar: {std: {x_m: 1.0, y_m: 1.0}, view_range_m: 100.0, field_of_view_rad: 1.5707963267948966}
  lidar: {std: {x_m: 1.0, y_m: 1.0}, max_range_m: 50.0, max_range_behind_m: 20.0, mount: {x_m: 2.0}}
  camera: {std: {bearing_rad: 0.1}}
ego: {detection_origin_x_m: -1.0}
"""

#: Where the objects stand, relative to an ego that drives along +y.
AHEAD_LEFT = {
    1: (90.0, 5.0),
    2: (40.0, 30.0),
    3: (20.0, 40.0),
    4: (0.0, 60.0),
    5: (-18.5, 0.0),
    6: (-21.0, 0.0),
}
TICKS = 5


def a_run(
    folder: Path,
    sensors: Sequence[str] = ("radar", "lidar"),
    *,
    ego: bool = True,
    config_text: str = CONFIG,
) -> Run:
    """Object 1 is tracked, the others are not; the ego moves by 1 m at every tick, and they with it."""
    with RunWriter(folder, config_text) as writer:
        for tick in range(TICKS):
            now_ns = START_NS + tick * TICK_NS
            if ego:
                writer.write_ego(
                    EgoState(now_ns, now_ns, 7.0, 1.0 * tick, math.pi / 2.0, 50.0)
                )
            for object_id, (ahead_m, left_m) in AHEAD_LEFT.items():
                writer.write_truth(
                    TruthState(now_ns, now_ns, object_id, 7.0 - left_m, tick + ahead_m)
                )
            state = TrackState(
                now_ns, np.array([2.0, tick + 90.0, math.pi / 2, 50.0, 0.0]), np.eye(5)
            )
            records = tuple(update(sensor, tick=tick) for sensor in sensors)
            writer.write_tick(
                TickReport(
                    tick,
                    now_ns,
                    (TrackReport(1, TrackStatus.CONFIRMED, state, 9),),
                    records,
                ),
                1,
                1,
            )
        writer.finish({"estimator": "smoother"})
    return load_run(folder)


def seen(run: Run) -> list[int]:
    """Objects in view, which are the same at every tick."""
    paths = true_paths(run.tables["truth"])
    found = visible(run, paths, run.tables["timing"]["now_ns"])
    assert (found == found[0]).all()
    return [
        path.object_id for path, is_seen in zip(paths, found[0], strict=True) if is_seen
    ]


def test_an_object_is_in_view_of_the_sensors_that_were_heard(tmp_path: Path) -> None:
    assert seen(a_run(tmp_path / "both")) == [
        1,
        2,
        3,
        5,
    ]  # 5 is 19.5 m behind the LiDAR, 6 is 22 m
    assert seen(a_run(tmp_path / "radar", ["radar"])) == [
        1,
        2,
    ]  # 3 is 63 degrees to the left
    assert seen(a_run(tmp_path / "lidar", ["lidar"])) == [2, 3, 5]


def test_what_is_not_known_hides_nothing(tmp_path: Path) -> None:
    everything = list(AHEAD_LEFT)
    assert seen(a_run(tmp_path / "camera", ["radar", "camera"])) == everything
    assert seen(a_run(tmp_path / "old", ego=False)) == everything
    assert seen(a_run(tmp_path / "stranger", ["radar", "sonar"])) == everything
    assert seen(a_run(tmp_path / "plain", config_text="")) == everything


def test_only_objects_in_view_count_as_missed(tmp_path: Path) -> None:
    metrics = evaluate(a_run(tmp_path / "run"))
    assert metrics.multi_object is not None
    assert metrics.truth is not None
    found, overall = metrics.multi_object.gospa, metrics.truth.overall
    # c = 5: five objects are missed, three of them in view; the pair is exact
    assert found["missed_m2"] == pytest.approx(5 * 12.5)
    assert found["out_of_view_m2"] == pytest.approx(2 * 12.5)
    assert found["in_view_rms_m"] == pytest.approx(math.sqrt(3 * 12.5))
    assert found["rms_m"] == pytest.approx(math.sqrt(5 * 12.5))
    assert (
        overall.ticks_present,
        overall.ticks_in_view,
        overall.ticks_tracked_in_view,
    ) == (30, 20, 5)
    assert metrics.as_dict()["truth"]["overall"]["tracked_share_in_view"] == 0.25
    table = compare(a_run(tmp_path / "again"))["multi_object"]
    shown = [
        table[f"gospa_{name}_m"][0]
        for name in ("in_view_rms", "missed_in_view", "out_of_view", "rms")
    ]
    assert shown == pytest.approx([math.sqrt(each * 12.5) for each in (3, 3, 2, 5)])


def test_runs_of_one_recording_are_measured_by_one_sight(tmp_path: Path) -> None:
    """Objects that any of them sees count, all of them where a run does not know what its sensors see."""
    knows, plain = a_run(tmp_path / "knows"), a_run(tmp_path / "plain", config_text="")
    radar = knows.with_tables(
        updates=knows.tables["updates"].where(
            knows.tables["updates"]["sensor"] == "radar"
        )
    )
    for other, missed in ((plain, 5), (radar, 3)):
        table = compare([knows, replace(other, path=None)])["differences"]
        mine = table[table["quantity"] == "gospa_in_view_rms_m"]
        assert mine["value"].tolist() == pytest.approx([math.sqrt(missed * 12.5)] * 2)


def test_the_path_of_the_ego_is_linear_between_its_stamps_in_any_order_and_turns_the_short_way(
    tmp_path: Path,
) -> None:
    with RunWriter(tmp_path / "run") as writer:
        for stamp_ns, x_m, yaw_rad in [
            (20, 2.0, -3.1),
            (0, 0.0, 3.1),
            (10, math.nan, 0.0),
            (20, 9.0, 0.0),
        ]:
            writer.write_ego(EgoState(stamp_ns, 30, x_m, 5.0, yaw_rad, 0.0))
        writer.finish({})
    poses = ego_states(
        load_run(tmp_path / "run").tables["ego"], np.array([-5, 0, 10, 20, 99])
    )
    assert poses[:, 0].tolist() == pytest.approx([0.0, 0.0, 1.0, 2.0, 2.0])
    assert poses[2, 2] == pytest.approx(math.pi)
    assert np.isnan(
        ego_states(
            load_run(tmp_path / "run").tables["ego"].where(np.zeros(4, bool)),
            np.array([0]),
        )
    ).all()
