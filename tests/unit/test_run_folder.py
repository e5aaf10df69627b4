import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Mapping
from contextlib import suppress
from io import FileIO

import numpy as np
import pytest

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    SmoothedReport,
    TickReport,
    TrackReport,
    TrackState,
    TrackStatus,
    TruthState,
    UpdateRecord,
)
from fgtrack.io.run import COLUMNS, NO_TRACK, RunWriter, Table, digest, load_run


def track(track_id: int = 1, size: int = 5, stamp_ns: int = 990) -> TrackReport:
    rng = np.random.default_rng(track_id)
    state = TrackState(stamp_ns, rng.normal(size=size), rng.normal(size=(size, size)))
    return TrackReport(track_id, TrackStatus.CONFIRMED, state, 3)


def report(tick: int = 0, size: int = 5) -> TickReport:
    return TickReport(
        tick,
        1000 + tick,
        (track(1, size), track(2, size)),
        (
            UpdateRecord("lidar", 900, 950, 0, Disposition.IN_SEQUENCE, 1, 0.1, {"x_m": 0.3, "y_m": -0.1}),
            UpdateRecord("a,b", 901, 951, 1, Disposition.INVALID),
        ),
    )


def write(path, *reports: TickReport) -> dict[str, object]:
    with RunWriter(path, config_text="seed: 1\n") as writer:
        for item in reports:
            writer.write_tick(item, process_ns=5, num_detections=2)
        return writer.finish({"estimator": "test"})


@pytest.mark.parametrize("size", [4, 5, 6])
def test_states_come_back_to_the_bit_and_missing_ones_are_nan(tmp_path, size):
    write(tmp_path / "run", report(size=size))
    tracks = load_run(tmp_path / "run").tracks
    state = track(2, size).state
    names = ["x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2"]
    assert [tracks[name][1] for name in names[:size]] == state.mean.tolist()
    assert all(np.isnan(tracks[name][1]) for name in names[size:])
    short = ["x", "y", "yaw", "speed", "yaw_rate"]
    for i, a in enumerate(short):
        for j, b in enumerate(short[i:], i):
            value = tracks[f"p_{a}_{b}"][1]
            assert np.isnan(value) if j >= size else value == state.covariance[i, j]


def test_the_header_lines_are_those_of_the_contract(tmp_path):
    path = tmp_path / "run"
    with RunWriter(path) as writer:
        writer.write_truth(TruthState(1, 1, -1, 0.0, 0.0))
        writer.write_truth(TruthState(1, 1, 8, 0.0, 0.0, ignored=True))
        writer.write_ego(EgoState(1, 2, 0.0, 0.0, 0.0, 0.0))
        writer.write_detections(DetectionList("lidar", 1, 2, [Detection(x_m=1.0, y_m=2.0)]))
        writer.write_tick(TickReport(0, 1, (track(),), (), (SmoothedReport(1, track().state, 0.3),)), 1, 0)
        writer.write_smoothed([SmoothedReport(1, track().state)])
    header = {file.stem: file.read_text().splitlines()[0] for file in path.glob("*.csv")}
    covariance = (
        "p_x_x,p_x_y,p_x_yaw,p_x_speed,p_x_yaw_rate,p_y_y,p_y_yaw,p_y_speed,p_y_yaw_rate,"
        "p_yaw_yaw,p_yaw_speed,p_yaw_yaw_rate,p_speed_speed,p_speed_yaw_rate,p_yaw_rate_yaw_rate"
    )
    state = "x_m,y_m,yaw_rad,speed_mps,yaw_rate_radps,accel_mps2"
    assert header == {
        "tracks": f"tick,now_ns,stamp_ns,track_id,status,{state},num_measured,{covariance}",
        "updates": "tick,sensor,stamp_ns,receipt_ns,index,disposition,track_id,nis,res_x_m,res_y_m,"
        "res_yaw_rad,res_speed_mps,res_range_m,res_bearing_rad,res_range_rate_mps",
        "smoothed": f"track_id,stamp_ns,kind,{state},{covariance}",
        "lagged": f"tick,now_ns,lag_s,track_id,stamp_ns,{state},{covariance}",
        "timing": "tick,now_ns,process_ns,num_tracks,num_detections",
        "truth": f"stamp_ns,object_id,{state}",
        "ego": f"stamp_ns,receipt_ns,{state}",
        "detections": "sensor,stamp_ns,receipt_ns,index,frame,"
        "x_m,y_m,yaw_rad,speed_mps,range_m,bearing_rad,range_rate_mps,"
        "z_m,length_m,width_m,height_m,score,class_name",
        "ignored": "stamp_ns,object_id,x_m,y_m,outline_m",
    }


def test_the_ego_is_in_the_files_with_the_next_tick_and_not_in_the_digest(tmp_path):
    path = tmp_path / "run"
    with RunWriter(path) as writer:
        writer.write_ego(EgoState(1, 2, 0.1, 0.2, 0.3, 0.4))
        assert not path.exists() or not (path / "ego.csv").exists()
        writer.write_tick(report(), 5, 2)
        assert load_run(path).ego["receipt_ns"].tolist() == [2]
        writer.write_ego(EgoState(3, 4, 1.1, 0.2, 0.3, 0.4, yaw_rate_radps=0.5, accel_mps2=0.6))
        finished = writer.finish({})
    ego = load_run(path).ego
    assert ego["stamp_ns"].tolist() == [1, 3]
    assert ego["x_m"].tolist() == [0.1, 1.1]
    assert ego["accel_mps2"].tolist() == [0.0, 0.6]
    write(tmp_path / "without", report())
    assert finished["digest"] == digest(tmp_path / "without")
    assert load_run(tmp_path / "without").ego.num_rows == 0  # as a run folder of an older version


def test_what_the_sensors_said_comes_back_and_is_not_in_the_digest(tmp_path):
    path = tmp_path / "run"
    box = Detection(x_m=np.float32(0.1), y_m=-2, covariance=(1.0, 0.0, 0.0, 1.0), object_id=7)
    with RunWriter(path) as writer:
        writer.write_detections(DetectionList("a,b", 5, 9, [box, Detection(bearing_rad=0.3, stamp_ns=6)], "sensor"))
        writer.write_tick(report(), 5, 2)
        writer.write_detections(DetectionList("radar", 7, 10, [Detection(x_m=math.nan, y_m=1.0)], "map"))
        writer.write_detections(DetectionList("radar", 8, 11, []))
        finished = writer.finish({})
    found = load_run(path).detections
    assert found["sensor"].tolist() == ["a,b", "a,b", "radar"]
    assert found["frame"].tolist() == ["sensor", "sensor", "map"]
    assert found["stamp_ns"].tolist() == [5, 6, 7]
    assert found["receipt_ns"].tolist() == [9, 9, 10]
    assert found["index"].tolist() == [0, 1, 0]
    np.testing.assert_array_equal(found["x_m"], [float(np.float32(0.1)), math.nan, math.nan])
    np.testing.assert_array_equal(found["y_m"], [-2.0, math.nan, 1.0])
    np.testing.assert_array_equal(found["bearing_rad"], [math.nan, 0.3, math.nan])
    write(tmp_path / "without", report())
    assert finished["digest"] == digest(tmp_path / "without")


def test_updates_truth_smoothed_and_timing_come_back(tmp_path):
    with RunWriter(tmp_path / "run", config_text="seed: 1\n") as writer:
        writer.write_tick(report(), 5, 2)
        writer.write_tick(TickReport(1, 2000, (), (), (SmoothedReport(4, track().state),)), 6, 0)
        writer.write_truth(TruthState(3, 3, -1, 1.0, 2.0, speed_mps=0.1))
        writer.finish({})
    run = load_run(tmp_path / "run")
    assert run.config_text == "seed: 1\n"
    assert run.updates["sensor"].tolist() == ["lidar", "a,b"]
    assert run.updates["track_id"].tolist() == [1, NO_TRACK]
    assert run.updates["disposition"].tolist() == ["in_sequence", "invalid"]
    assert run.updates["nis"][0] == 0.1
    assert np.isnan(run.updates["nis"][1])
    assert run.updates["res_y_m"][0] == -0.1
    assert np.isnan(run.updates["res_yaw_rad"][0])
    assert run.truth["speed_mps"].tolist() == [0.1]
    assert np.isnan(run.truth["yaw_rad"][0])
    assert run.smoothed["kind"].tolist() == ["final"]
    assert run.timing["process_ns"].tolist() == [5, 6]
    assert run.timing["num_tracks"].tolist() == [2, 0]
    assert run.tracks.where(run.tracks["track_id"] == 2).num_rows == 1


@pytest.mark.parametrize("size", [4, 5, 6])
def test_lagged_states_of_every_lag_come_back_to_the_bit(tmp_path, size):
    lags_s = (0.3, 0.1, 2 / 3)
    states = [track(5 + index, size, stamp_ns=100 + index).state for index in range(3)]
    smoothed = tuple(SmoothedReport(2, state, lag_s) for state, lag_s in zip(states, lags_s, strict=True))
    with RunWriter(tmp_path / "run", smoothed_lag_s=0.3) as writer:
        writer.write_tick(TickReport(7, 1007, report(size=size).tracks, (), smoothed), 5, 0)
        writer.finish({})
    lagged = load_run(tmp_path / "run").lagged
    assert lagged["lag_s"].tolist() == list(lags_s)
    assert lagged["tick"].tolist() == [7, 7, 7]
    assert lagged["now_ns"].tolist() == [1007, 1007, 1007]
    assert lagged["track_id"].tolist() == [2, 2, 2]
    assert lagged["stamp_ns"].tolist() == [100, 101, 102]
    names = ["x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2"]
    assert [[lagged[name][k] for name in names[:size]] for k in range(3)] == [state.mean.tolist() for state in states]
    assert lagged["p_x_y"].tolist() == [state.covariance[0, 1] for state in states]
    assert np.isnan(lagged["accel_mps2"]).all() == (size < 6)


def test_of_the_lagged_states_the_first_lag_alone_stands_beside_the_final_ones(tmp_path):
    smoothed = tuple(SmoothedReport(1, track(index).state, lag_s) for index, lag_s in enumerate((None, 0.1, 0.3, 0.5)))
    for lag_s, expected in [(0.3, ["final", "lagged"]), (None, ["final"])]:
        with RunWriter(tmp_path / "run", smoothed_lag_s=lag_s, overwrite=True) as writer:
            writer.write_tick(TickReport(0, 1000, (track(1),), (), smoothed), 5, 0)
        run = load_run(tmp_path / "run")
        assert run.smoothed["kind"].tolist() == expected
        assert run.lagged["lag_s"].tolist() == [0.1, 0.3, 0.5]
        if lag_s is not None:
            assert run.smoothed["x_m"][1] == track(2).state.mean[0]


def test_a_removed_track_has_final_states_but_no_lagged_ones(tmp_path):
    smoothed = tuple(SmoothedReport(track_id, track().state, lag_s) for track_id in (1, 9) for lag_s in (None, 0.3))
    with RunWriter(tmp_path / "run", smoothed_lag_s=0.3) as writer:
        writer.write_tick(TickReport(0, 1000, (track(1),), (), smoothed), 5, 0)
    run = load_run(tmp_path / "run")
    assert run.lagged["track_id"].tolist() == [1]
    rows = zip(run.smoothed["track_id"].tolist(), run.smoothed["kind"].tolist(), strict=True)
    assert list(rows) == [(1, "final"), (1, "lagged"), (9, "final")]


def test_smoothed_states_do_not_change_the_digest(tmp_path):
    plain = write(tmp_path / "plain", report())
    smoothed = (SmoothedReport(1, track().state, 0.3), SmoothedReport(2, track().state))
    with_them = write(tmp_path / "smoothed", dataclasses.replace(report(), smoothed=smoothed))
    assert (tmp_path / "smoothed/lagged.csv").exists()
    assert with_them["digest"] == plain["digest"]


def test_the_meta_file_counts_every_disposition_and_carries_the_digest(tmp_path):
    path = tmp_path / "run"
    meta = write(path, report(0), report(1))
    assert meta == json.loads((path / "meta.json").read_text())
    assert meta["complete"] is True
    assert meta["estimator"] == "test"
    assert meta["counts"]["lidar"]["in_sequence"] == 2
    assert set(meta["counts"]["a,b"]) == set(Disposition)
    assert sum(map(sum, (counts.values() for counts in meta["counts"].values()))) == 4
    tables = (path / "tracks.csv").read_bytes() + (path / "updates.csv").read_bytes()
    assert meta["digest"] == hashlib.sha256(tables).hexdigest()


def test_there_is_no_smoothed_lagged_or_truth_file_without_a_row(tmp_path):
    write(tmp_path / "run", report())
    assert not (tmp_path / "run/smoothed.csv").exists()
    assert not (tmp_path / "run/lagged.csv").exists()
    run = load_run(tmp_path / "run")
    assert run.smoothed.num_rows == run.lagged.num_rows == run.truth.num_rows == 0
    assert run.truth["object_id"].dtype == np.int64


def test_a_killed_run_is_readable_up_to_its_last_whole_row(tmp_path):
    path = tmp_path / "run"
    writer = RunWriter(path)
    for tick in range(3):
        writer.write_tick(report(tick), 5, 2)
    data = (path / "tracks.csv").read_bytes()
    (path / "tracks.csv").write_bytes(data[:-30])
    run = load_run(path)
    assert run.meta["complete"] is False
    assert run.tracks.num_rows == 5
    assert run.timing.num_rows == 3
    writer.close()


def test_a_disk_that_takes_only_a_part_at_a_time_gets_all(tmp_path, monkeypatch):
    """As one that is nearly full does: what it did not take must not be lost without a word."""

    class Grudging(FileIO):
        def write(self, data):
            return super().write(bytes(data)[:7])

    write(tmp_path / "right", report())
    monkeypatch.setattr("fgtrack.io.run.writer.FileIO", Grudging)
    write(tmp_path / "run", report())
    for name in ("tracks.csv", "updates.csv", "timing.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "right" / name).read_bytes()


def test_a_run_without_meta_says_that_it_was_killed_at_its_beginning(tmp_path):
    write(tmp_path / "run", report())
    (tmp_path / "run/meta.json").unlink()
    with pytest.raises(DataError, match=r"run: has no meta\.json, what wrote it was killed at its beginning: repeat"):
        load_run(tmp_path / "run")


def test_ticks_that_do_not_increase_are_refused(tmp_path):
    write(tmp_path / "run", report())
    with (tmp_path / "run/timing.csv").open("a") as file:
        file.write("0,1000,1,1,1\n")
    with pytest.raises(DataError, match=r"timing\.csv: its ticks do not increase, repeat the run"):
        load_run(tmp_path / "run")


def test_one_long_cell_does_not_widen_a_column_to_gigabytes(tmp_path):
    write(tmp_path / "run", report())
    rows = ["1,2,3.0,4.0,\n"] * 5000
    (tmp_path / "run/ignored.csv").write_text("".join([",".join(COLUMNS["ignored"]), "\n", *rows]))
    assert load_run(tmp_path / "run").ignored.num_rows == 5000
    rows[4999] = f"1,2,3.0,4.0,{'1.5 ' * 10_000}\n"  # as a column 800 MB
    (tmp_path / "run/ignored.csv").write_text("".join([",".join(COLUMNS["ignored"]), "\n", *rows]))
    with pytest.raises(DataError, match=r"ignored\.csv: outline_m of 40000 characters, repeat the run"):
        load_run(tmp_path / "run")


def test_a_line_without_end_is_not_read_to_its_end(tmp_path):
    write(tmp_path / "run", report())
    with (tmp_path / "run/tracks.csv").open("a") as file:
        file.write("1" * 1_000_001)
    with pytest.raises(DataError, match=r"tracks\.csv: a line of 1000000 characters"):
        load_run(tmp_path / "run")


def test_a_meta_that_is_too_large_is_not_read(tmp_path):
    write(tmp_path / "run", report())
    (tmp_path / "run/meta.json").write_text('{"format": "fgtrack-run/1"' + " " * 17_000_000 + "}")
    with pytest.raises(DataError, match=r"meta\.json: is larger than 16 MB"):
        load_run(tmp_path / "run")


@pytest.mark.parametrize("name", ["config.yaml.0123456789ab.part", "meta.json.ba9876543210.part"])
def test_what_a_kill_within_the_first_files_leaves_is_replaced_with_overwrite(tmp_path, name):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).write_text("{")
    with pytest.raises(CallError, match="replace it with --overwrite"):
        RunWriter(tmp_path / "run")
    RunWriter(tmp_path / "run", overwrite=True).close()


@pytest.mark.parametrize("name", ["notes.txt.0123456789ab.part", "meta.json.part", "meta.json.0123456789ab"])
def test_a_part_of_something_else_is_nothing_to_replace(tmp_path, name):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).write_text("{")
    with pytest.raises(CallError, match="is not a run folder"):
        RunWriter(tmp_path / "run", overwrite=True)


def test_an_exception_leaves_the_run_marked_as_incomplete(tmp_path):
    with suppress(ZeroDivisionError), RunWriter(tmp_path / "run") as writer:
        writer.write_tick(report(), 5, 2)
        raise ZeroDivisionError
    assert load_run(tmp_path / "run").meta["complete"] is False


@pytest.mark.parametrize("text", ["", "stamp_ns,receipt", "stamp_ns,receipt_ns\n"])
def test_a_table_that_a_kill_left_without_its_header_has_no_rows(tmp_path, text):
    with suppress(ZeroDivisionError), RunWriter(tmp_path / "run") as writer:
        writer.write_tick(report(), 5, 2)
        raise ZeroDivisionError
    (tmp_path / "run/ego.csv").write_text(text)
    if text.endswith("\n"):
        with pytest.raises(DataError, match="the header must be"):
            load_run(tmp_path / "run")
    else:
        assert load_run(tmp_path / "run").ego.num_rows == 0


def test_an_older_run_is_replaced_and_nothing_of_it_is_left(tmp_path):
    path = tmp_path / "run"
    with RunWriter(path) as writer:
        writer.write_truth(TruthState(1, 1, -1, 0.0, 0.0))
        writer.write_ego(EgoState(1, 2, 0.0, 0.0, 0.0, 0.0))
        writer.write_tick(TickReport(0, 1, (track(),), (), (SmoothedReport(1, track().state, 0.3),)), 1, 0)
        writer.finish({})
    (path / "metrics.json").write_text("{}")
    with RunWriter(path, overwrite=True) as writer:
        writer.write_tick(report(), 5, 2)
    assert {file.name for file in path.iterdir()} == {
        *("meta.json", "config.yaml", "tracks.csv", "updates.csv", "timing.csv"),
    }


def test_a_folder_with_something_else_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(CallError, match="exists and is not a run folder"):
        RunWriter(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["letter.txt"]
    with pytest.raises(CallError, match="cannot be made a folder"):
        RunWriter(tmp_path / "letter.txt")


def test_a_table_is_a_data_frame(tmp_path):
    pandas = pytest.importorskip("pandas")
    write(tmp_path / "run", report())
    run = load_run(tmp_path / "run")
    for table in (run.tracks, run.updates, run.truth):
        frame = pandas.DataFrame(table)
        assert list(frame.columns) == list(table)
        assert frame.shape == (table.num_rows, len(table))
        for name, values in table.items():
            assert frame[name].to_numpy(values.dtype.type if values.dtype.kind != "U" else object).tolist() == (
                pytest.approx(values.tolist(), nan_ok=True) if values.dtype.kind == "f" else values.tolist()
            )


def test_a_table_is_a_mapping_of_columns_that_cannot_be_changed(tmp_path):
    write(tmp_path / "run", report())
    run = load_run(tmp_path / "run")
    table = run.updates
    assert isinstance(table, Mapping)
    assert (len(table), table.num_rows, dict(table)["tick"].tolist()) == (len(list(table)), 2, [0, 0])
    assert repr(table).startswith("<Table of 2 rows: tick, sensor, stamp_ns, ")
    for part in (table, table.where(table["tick"] == 0)):
        with pytest.raises(ValueError, match="read-only"):
            part["stamp_ns"][0] = 1
    mine = np.arange(2)
    Table({"mine": mine})
    mine[0] = 5  # what it was made from is not its own
    assert table == load_run(tmp_path / "run").updates
    assert table != table.where(table["index"] == 0)
    assert table != run.tracks


def test_the_configuration_of_a_run_is_a_mapping(tmp_path):
    write(tmp_path / "run", report())
    run = load_run(tmp_path / "run")
    assert run.config == {"seed": 1}
    assert dataclasses.replace(run, config_text="").config == {}
    for text in ("- 1", "a: [", "1"):
        with pytest.raises(DataError, match=r"run/config\.yaml: "):
            _ = dataclasses.replace(run, config_text=text).config
    assert dataclasses.replace(run, path=None).path is None


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        ("meta.json", "{"),
        ("meta.json", "{}"),
        ("tracks.csv", "a,b\n"),
        ("tracks.csv", ""),
        ("updates.csv", None),
        ("config.yaml", None),
        ("tracks.csv", lambda text: text[:-1]),
        ("tracks.csv", lambda text: text.replace("confirmed", "confirmed,1", 1)),
        ("tracks.csv", lambda text: text + "\n"),
        ("timing.csv", lambda text: text.replace("1000", "soon")),
        ("timing.csv", lambda text: text + "\udcff,1,1,1,1\n"),
        ("meta.json", 100_000 * "["),
    ],
)
def test_a_missing_or_damaged_file_is_one_line_that_names_it(tmp_path, file, damage):
    path = tmp_path / "run"
    write(path, report())
    text = (path / file).read_text()
    (path / file).unlink()
    if damage is not None:
        (path / file).write_text(damage if isinstance(damage, str) else damage(text), errors="surrogateescape")
    with pytest.raises(DataError) as caught:
        load_run(path)
    assert file in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_track_row_is_written_in_tens_of_microseconds(tmp_path):
    tracks = tuple(track(index, 6) for index in range(50))
    with RunWriter(tmp_path / "run") as writer:
        best_s = float("inf")
        for tick in range(20):
            start_s = time.perf_counter()
            writer.write_tick(TickReport(tick, tick, tracks, ()), 1, 0)
            best_s = min(best_s, time.perf_counter() - start_s)
    assert best_s / 50 < 60e-6  # 9 us on the machine where it was written


def test_a_table_of_several_parts_comes_back_whole(tmp_path):
    write(tmp_path / "run", report())
    rows = [f"{k},{k},1,1,{k % 7}\n" for k in range(1, 10_000)]
    with (tmp_path / "run/timing.csv").open("a") as file:
        file.writelines(rows)
    timing = load_run(tmp_path / "run").timing
    assert timing["tick"].tolist() == list(range(10_000))
    assert timing["num_detections"].tolist()[1:] == [k % 7 for k in range(1, 10_000)]
    with (tmp_path / "run/timing.csv").open("a") as file:
        file.write("10000,1\n10001,1,1,1,1\n")
    with pytest.raises(DataError, match=r"timing\.csv:10002: 2 cells instead of 5"):
        load_run(tmp_path / "run")


@pytest.mark.parametrize(
    "change",
    [
        {"versions": "x"},
        {"input": []},
        {"counts": {"radar": 3}},
        {"counts": {"radar": {"birth": "x"}}},
        {"complete": 1},
        {"effective": 3},
        {"effective": {"lag_key": "smoother.lag_s"}},
    ],
)
def test_a_meta_file_that_says_something_else_is_one_line(tmp_path, change):
    write(tmp_path / "run", report())
    file = tmp_path / "run/meta.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(DataError, match=rf"meta\.json: {next(iter(change))}\S* is not what a run writes there"):
        load_run(tmp_path / "run")


@pytest.mark.parametrize(
    ("section", "text"),
    [
        ("sensors", "sensors: {radar: {mount: {x_m: ../x}}}"),
        ("sensors", "sensors: {radar: {mount: {y_m: [1.0]}}}"),
        ("sensors", "sensors: {radar: {mount: {yaw_rad: .inf}}}"),
        ("sensors", "sensors: {radar: {max_delay_s: soon}}"),
        ("sensors", "sensors: 3"),
        ("clock", "clock: 7"),
        ("birth", "birth: []"),
        ("smoother", "smoother: 1.5"),
        ("smoother", "smoother: {lag_s: [1.0]}"),
        ("smoother", "smoother: {lag_s: .nan}"),
        ("map", "map: {excluded: 3}"),
        ("ego", "ego: {detection_origin_x_m: null}"),
    ],
)
def test_a_configuration_of_another_kind_is_one_line(tmp_path, section, text):
    write(tmp_path / "run", report())
    (tmp_path / "run/config.yaml").write_text(text)
    run = load_run(tmp_path / "run")
    with pytest.raises(DataError, match=rf"config\.yaml: {section}\S* is not what a run writes there"):
        assert run.config


def test_numbers_beyond_all_that_a_run_writes_are_none(tmp_path):
    write(tmp_path / "run", report())
    file = tmp_path / "run/tracks.csv"
    header, row, *_ = file.read_text().splitlines()
    place = header.split(",").index("x_m")
    for number in ("inf", "-1e300", "1e61"):
        cells = row.split(",")
        cells[place] = number
        file.write_text(f"{header}\n{','.join(cells)}\n")
        assert np.isnan(load_run(tmp_path / "run").tracks["x_m"]).all()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "a0: &m0 {x: 1}\n" + "".join(f"a{k}: &m{k} {{<<: [*m{k - 1}, *m{k - 1}]}}\n" for k in range(1, 40)),
            "is not YAML",
        ),
        ("x: " + "[" * 5000, "is not YAML"),
        ("x: &a [*a]\n", "is nested without end"),
        (f"x: {'a' * 2_000_000}", "is not YAML"),
    ],
    ids=["merges of merges", "deep", "in itself", "long"],
)
def test_a_configuration_that_would_take_for_ever_is_refused(tmp_path, text, said):
    write(tmp_path / "run", report())
    (tmp_path / "run/config.yaml").write_text(text)
    with pytest.raises(DataError, match=said):
        _ = load_run(tmp_path / "run").config
