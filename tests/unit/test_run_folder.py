import csv
import dataclasses
import hashlib
import json
import math
import os
from contextlib import suppress

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
from fgtrack.evaluation.tables import Table
from fgtrack.runs import (
    COLUMNS,
    NO_TRACK,
    MemoryRun,
    RunWriter,
    digest,
    load_run,
    sink,
    write_metrics,
)


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
            UpdateRecord(
                "lidar",
                900,
                950,
                0,
                Disposition.IN_SEQUENCE,
                1,
                0.1,
                {"x_m": 0.3, "y_m": -0.1},
            ),
            UpdateRecord('a",b', 901, 951, 1, Disposition.INVALID),
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
    tracks = load_run(tmp_path / "run").tables["tracks"]
    state = track(2, size).state
    names = ["x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2"]
    assert [tracks[name][1] for name in names[:size]] == state.mean.tolist()
    assert all(np.isnan(tracks[name][1]) for name in names[size:])
    short = ["x", "y", "yaw", "speed", "yaw_rate"]
    for i, a in enumerate(short):
        for j, b in enumerate(short[i:], i):
            value = tracks[f"p_{a}_{b}"][1]
            assert np.isnan(value) if j >= size else value == state.covariance[i, j]


def test_the_ego_is_in_the_files_with_the_next_tick_and_not_in_the_digest(tmp_path):
    path = tmp_path / "run"
    with RunWriter(path) as writer:
        writer.write_ego(EgoState(1, 2, 0.1, 0.2, 0.3, 0.4))
        assert not path.exists() or not (path / "ego.csv").exists()
        writer.write_tick(report(), 5, 2)
        assert load_run(path).tables["ego"]["receipt_ns"].tolist() == [2]
        writer.write_ego(
            EgoState(3, 4, 1.1, 0.2, 0.3, 0.4, yaw_rate_radps=0.5, accel_mps2=0.6)
        )
        finished = writer.finish({})
    ego = load_run(path).tables["ego"]
    assert ego["stamp_ns"].tolist() == [1, 3]
    assert ego["x_m"].tolist() == [0.1, 1.1]
    assert ego["accel_mps2"].tolist() == [0.0, 0.6]
    write(tmp_path / "without", report())
    assert finished["digest"] == digest(tmp_path / "without")
    assert (
        load_run(tmp_path / "without").tables["ego"].num_rows == 0
    )  # as a run folder of an older version


def test_what_the_sensors_said_comes_back_and_is_not_in_the_digest(tmp_path):
    path = tmp_path / "run"
    box = Detection(
        x_m=np.float32(0.1), y_m=-2, covariance=(1.0, 0.0, 0.0, 1.0), object_id=7
    )
    with RunWriter(path) as writer:
        writer.write_detections(
            DetectionList(
                'a",b', 5, 9, [box, Detection(bearing_rad=0.3, stamp_ns=6)], "sensor"
            )
        )
        writer.write_tick(report(), 5, 2)
        writer.write_detections(
            DetectionList("radar", 7, 10, [Detection(x_m=math.nan, y_m=1.0)], "map")
        )
        writer.write_detections(DetectionList("radar", 8, 11, []))
        finished = writer.finish({})
    found = load_run(path).tables["detections"]
    assert found["sensor"].tolist() == ['a",b', 'a",b', "radar"]
    assert found["frame"].tolist() == ["sensor", "sensor", "map"]
    assert found["stamp_ns"].tolist() == [5, 6, 7]
    assert found["receipt_ns"].tolist() == [9, 9, 10]
    assert found["index"].tolist() == [0, 1, 0]
    np.testing.assert_array_equal(
        found["x_m"], [float(np.float32(0.1)), math.nan, math.nan]
    )
    np.testing.assert_array_equal(found["y_m"], [-2.0, math.nan, 1.0])
    np.testing.assert_array_equal(found["bearing_rad"], [math.nan, 0.3, math.nan])
    write(tmp_path / "without", report())
    assert finished["digest"] == digest(tmp_path / "without")


FORMULAS = (
    '=HYPERLINK("//a","b")',
    "@SUM(1)",
    "+1+2",
    "-2+3",
    "\tx",
    "'=x",
    "'",
)
"""Names from a recording that a spreadsheet could run."""


def test_no_name_from_a_recording_is_a_formula_in_a_spreadsheet(tmp_path):
    """The names come back; numbers and other names stay as they are in the file."""
    path, names = tmp_path / "run", [*FORMULAS, "-3", "+1e5", "a=b", "it's"]
    seen = [Detection(x_m=1.0, y_m=2.0, class_name=name, id=name) for name in names]
    with RunWriter(path) as writer:
        writer.write_detections(DetectionList("=1+1", 5, 9, seen, "map"))
        writer.write_tick(report(), 5, 2)
        writer.finish({})
    run = load_run(path)
    run.save(tmp_path / "again")
    for folder in (path, tmp_path / "again"):
        found = load_run(folder).tables["detections"]
        assert found["sensor"].tolist() == ["=1+1"] * len(names)
        assert found["class_name"].tolist() == found["id"].tolist() == names
        with (folder / "detections.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        cells = [row["class_name"] for row in rows]
        assert cells == [*(f"'{name}" for name in FORMULAS[:-1]), *names[6:]]
    table = Table("found", [{"run": FORMULAS[0], "number": -1.5}], ())
    assert table.to_csv().splitlines()[1].startswith("\"'=HYPERLINK")
    assert table.to_csv().endswith(",-1.5\n")


def test_names_with_ends_of_lines_come_back(tmp_path):
    """A carriage return alone ends a line, too, for a reader of CSV."""
    names = ["a\rb", "\r", "a\r\nb", '"\r\n"', "a\nb", "plain", "ends\r"]
    seen = [Detection(x_m=1.0, y_m=2.0, class_name=name, id=name) for name in names]
    with RunWriter(tmp_path / "run") as writer:
        writer.write_detections(DetectionList("lidar\r1", 5, 9, seen, "map"))
        writer.write_tick(report(), 5, 2)
        writer.finish({})
    load_run(tmp_path / "run").save(tmp_path / "again")
    for folder in (tmp_path / "run", tmp_path / "again"):
        found = load_run(folder).tables["detections"]
        assert found["class_name"].tolist() == found["id"].tolist() == names
        assert found["sensor"].tolist() == ["lidar\r1"] * len(names)


def test_updates_truth_smoothed_and_timing_come_back(tmp_path):
    with RunWriter(tmp_path / "run", config_text="seed: 1\n") as writer:
        writer.write_tick(report(), 5, 2)
        writer.write_tick(
            TickReport(1, 2000, (), (), (SmoothedReport(4, track().state),)), 6, 0
        )
        writer.write_truth(TruthState(3, 3, -1, 1.0, 2.0, speed_mps=0.1))
        writer.finish({})
    run = load_run(tmp_path / "run")
    assert run.config_text == "seed: 1\n"
    assert run.tables["updates"]["sensor"].tolist() == ["lidar", 'a",b']
    assert run.tables["updates"]["track_id"].tolist() == [1, NO_TRACK]
    assert run.tables["updates"]["disposition"].tolist() == ["in_sequence", "invalid"]
    assert run.tables["updates"]["nis"][0] == 0.1
    assert np.isnan(run.tables["updates"]["nis"][1])
    assert run.tables["updates"]["res_y_m"][0] == -0.1
    assert np.isnan(run.tables["updates"]["res_yaw_rad"][0])
    assert run.tables["truth"]["speed_mps"].tolist() == [0.1]
    assert np.isnan(run.tables["truth"]["yaw_rad"][0])
    assert run.tables["smoothed"]["kind"].tolist() == ["final"]
    assert run.tables["timing"]["process_ns"].tolist() == [5, 6]
    assert run.tables["timing"]["num_tracks"].tolist() == [2, 0]
    assert (
        run.tables["tracks"].where(run.tables["tracks"]["track_id"] == 2).num_rows == 1
    )


@pytest.mark.parametrize("size", [4, 5, 6])
def test_lagged_states_of_every_lag_come_back_to_the_bit(tmp_path, size):
    lags_s = (0.3, 0.1, 2 / 3)
    states = [track(5 + index, size, stamp_ns=100 + index).state for index in range(3)]
    smoothed = tuple(
        SmoothedReport(2, state, lag_s)
        for state, lag_s in zip(states, lags_s, strict=True)
    )
    with RunWriter(tmp_path / "run", smoothed_lag_s=0.3) as writer:
        writer.write_tick(
            TickReport(7, 1007, report(size=size).tracks, (), smoothed), 5, 0
        )
        writer.finish({})
    lagged = load_run(tmp_path / "run").tables["lagged"]
    assert lagged["lag_s"].tolist() == list(lags_s)
    assert lagged["tick"].tolist() == [7, 7, 7]
    assert lagged["now_ns"].tolist() == [1007, 1007, 1007]
    assert lagged["track_id"].tolist() == [2, 2, 2]
    assert lagged["stamp_ns"].tolist() == [100, 101, 102]
    names = ["x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2"]
    assert [[lagged[name][k] for name in names[:size]] for k in range(3)] == [
        state.mean.tolist() for state in states
    ]
    assert lagged["p_x_y"].tolist() == [state.covariance[0, 1] for state in states]
    assert np.isnan(lagged["accel_mps2"]).all() == (size < 6)


def test_the_meta_file_counts_every_disposition_and_carries_the_digest(tmp_path):
    path = tmp_path / "run"
    meta = write(path, report(0), report(1))
    assert meta == json.loads((path / "meta.json").read_text())
    assert meta["complete"] is True
    assert meta["estimator"] == "test"
    assert meta["counts"]["lidar"]["in_sequence"] == 2
    assert set(meta["counts"]['a",b']) == set(Disposition)
    assert sum(map(sum, (counts.values() for counts in meta["counts"].values()))) == 4
    tables = (path / "tracks.csv").read_bytes() + (path / "updates.csv").read_bytes()
    assert meta["digest"] == hashlib.sha256(tables).hexdigest()


def test_there_is_no_smoothed_lagged_or_truth_file_without_a_row(tmp_path):
    write(tmp_path / "run", report())
    assert not (tmp_path / "run/smoothed.csv").exists()
    assert not (tmp_path / "run/lagged.csv").exists()
    run = load_run(tmp_path / "run")
    assert (
        run.tables["smoothed"].num_rows
        == run.tables["lagged"].num_rows
        == run.tables["truth"].num_rows
        == 0
    )
    assert run.tables["truth"]["object_id"].dtype == np.int64


def test_a_killed_run_is_readable_up_to_its_last_whole_row(tmp_path, monkeypatch):
    path = tmp_path / "run"
    writer = RunWriter(path)
    for tick in range(4):
        monkeypatch.setattr(sink, "monotonic", lambda now_s=5.0 + 0.1 * tick: now_s)
        writer.write_tick(
            report(tick), 5, 2
        )  # the last one within 0.2 s of the one before it
    data = (path / "tracks.csv").read_bytes()
    (path / "tracks.csv").write_bytes(data[:-30])
    run = load_run(path)
    assert run.meta["complete"] is False
    assert run.tables["tracks"].num_rows == 5
    assert run.tables["timing"].num_rows == 3
    writer.close()


def test_ticks_that_do_not_increase_are_refused(tmp_path):
    write(tmp_path / "run", report())
    with (tmp_path / "run/timing.csv").open("a") as file:
        file.write("0,1000,1,1,1\n")
    with pytest.raises(
        DataError, match=r"timing\.csv: its ticks do not increase, repeat the run"
    ):
        load_run(tmp_path / "run")


def test_the_configuration_of_a_run_is_a_mapping(tmp_path):
    write(tmp_path / "run", report())
    run = load_run(tmp_path / "run")
    assert run.config == {"seed": 1}
    assert dataclasses.replace(run, config_text="").config == {}
    for text in ("- 1", "a: [", "1", f"x: {'[' * 5000}"):
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
        (path / file).write_text(
            damage if isinstance(damage, str) else damage(text),
            errors="surrogateescape",
        )
    with pytest.raises(DataError) as caught:
        load_run(path)
    assert file in str(caught.value)
    assert "\n" not in str(caught.value)


def test_numbers_beyond_all_that_a_run_writes_are_none(tmp_path):
    write(tmp_path / "run", report())
    file = tmp_path / "run/tracks.csv"
    header, row, *_ = file.read_text().splitlines()
    place = header.split(",").index("x_m")
    for number in ("inf", "-1e300", "1e61"):
        cells = row.split(",")
        cells[place] = number
        file.write_text(f"{header}\n{','.join(cells)}\n")
        assert np.isnan(load_run(tmp_path / "run").tables["tracks"]["x_m"]).all()


def test_tables_are_data_frames_with_typed_columns(tmp_path):
    write(tmp_path / "run", report(), report(1))
    run = load_run(tmp_path / "run")
    for table, names in COLUMNS.items():
        assert list(getattr(run, table).columns) == list(names)
    tracks = run.tracks
    assert tracks.dtypes.astype(str)[
        ["tick", "stamp_ns", "x_m", "status"]
    ].tolist() == [
        "int64",
        "int64",
        "float64",
        "str",
    ]
    second = tracks[tracks["track_id"] == 2]
    assert second["x_m"].tolist() == [track(2).state.mean[0]] * 2
    assert tracks["x_m"][:3].tolist() == run.tables["tracks"]["x_m"][:3].tolist()
    assert run.updates["track_id"].tolist() == [1, NO_TRACK, 1, NO_TRACK]
    assert run.tracks is tracks
    with pytest.raises(ValueError, match="read-only"):
        run.tables["tracks"]["stamp_ns"][0] = 1


def test_a_run_in_memory_or_of_a_folder_is_saved_as_it_is(tmp_path):
    write(tmp_path / "run", report(), report(1))
    memory = MemoryRun("seed: 1\n")
    for item in (report(), report(1)):
        memory.write_tick(item, process_ns=5, num_detections=2)
    memory.finish({"estimator": "test"})
    for name, run in (("a", load_run(tmp_path / "run")), ("b", memory.run)):
        run.save(tmp_path / name)
        for file in (tmp_path / "run").iterdir():
            assert (tmp_path / name / file.name).read_text() == file.read_text(), (
                file.name
            )
        with pytest.raises(CallError, match="already exists"):
            run.save(tmp_path / name)
    assert (memory.run.estimator, memory.run.path) == ("test", None)


def test_existence_probabilities_are_a_column_of_runs_that_have_them_and_of_no_others(
    tmp_path,
):
    tracks = tuple(dataclasses.replace(each, score=0.75) for each in report().tracks)
    scored = dataclasses.replace(report(), tracks=tracks)
    for name, item in (("scored", scored), ("counted", report())):
        with RunWriter(tmp_path / name, meta={"is_scored": name == "scored"}) as writer:
            writer.write_tick(item, process_ns=5, num_detections=2)
            writer.finish({})
        load_run(tmp_path / name).save(tmp_path / "copy", overwrite=True)
        text = (tmp_path / name / "tracks.csv").read_text()
        assert (tmp_path / "copy/tracks.csv").read_text() == text
        assert ("score" in text) == (name == "scored")
    assert load_run(tmp_path / "scored").tracks["score"].tolist() == [0.75, 0.75]
    assert load_run(tmp_path / "counted").tracks["score"].isna().all()


def test_smoothed_holds_final_states_and_those_of_the_first_lag_of_tracks_that_are_there(
    tmp_path,
):
    lags_s = (None, 0.1, 0.3)
    smoothed = tuple(
        SmoothedReport(number, track(number).state, lag_s)
        for number in (1, 9)
        for lag_s in lags_s
    )
    with RunWriter(tmp_path / "run", smoothed_lag_s=0.3) as writer:
        writer.write_tick(TickReport(0, 1000, (track(1),), (), smoothed), 5, 0)
        finished = writer.finish({})
    run = load_run(tmp_path / "run")
    assert run.lagged["lag_s"].tolist() == [0.1, 0.3]
    rows = zip(run.smoothed["track_id"], run.smoothed["kind"], strict=True)
    assert list(rows) == [(1, "final"), (1, "lagged"), (9, "final")]
    assert (
        finished["digest"]
        == write(tmp_path / "plain", TickReport(0, 1000, (track(1),), ()))["digest"]
    )


def test_an_older_run_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "run"
    with RunWriter(path, meta={"estimator": "old"}) as writer:
        writer.write_truth(TruthState(1, 1, -1, 0.0, 0.0))
        writer.write_tick(report(), 1, 0)
        writer.finish({})
    write_metrics(path, {})
    (path / "notes.txt").write_text("mine")
    older = {file.name: file.read_bytes() for file in path.iterdir()}
    with pytest.raises(CallError, match="replace it with --overwrite"):
        RunWriter(path)
    with suppress(ZeroDivisionError), RunWriter(path, overwrite=True) as writer:
        writer.write_tick(report(), 5, 2)
        raise ZeroDivisionError  # as on a full disk
    assert {file.name: file.read_bytes() for file in path.iterdir()} == older
    writer = RunWriter(path, overwrite=True)
    writer.write_tick(report(), 5, 2)
    with pytest.raises(CallError, match="another command is writing there"):
        RunWriter(path, overwrite=True)
    writer.close()  # killed
    assert load_run(path).estimator == "old"
    assert load_run(path / "new.part").meta["complete"] is False
    with RunWriter(path, meta={"estimator": "new"}, overwrite=True) as writer:
        writer.write_tick(report(), 5, 2)
        writer.finish({})
    assert load_run(path).estimator == "new"
    assert {file.name for file in path.iterdir()} == {
        *(
            "meta.json",
            "config.yaml",
            "tracks.csv",
            "updates.csv",
            "timing.csv",
            "notes.txt",
        )
    }


def test_a_kill_while_an_older_run_is_replaced_leaves_what_overwrite_replaces(
    tmp_path, monkeypatch
):
    write(tmp_path / "run", report())
    moved = []

    def killed(source, target, replace=os.replace):
        moved.append(target)
        if len(moved) == 6:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr(os, "replace", killed)
    with (
        suppress(KeyboardInterrupt),
        RunWriter(tmp_path / "run", overwrite=True) as writer,
    ):
        writer.write_tick(report(), 5, 2)
        writer.finish({})
    monkeypatch.undo()
    with pytest.raises(DataError, match=r"meta\.json: cannot be read"):
        load_run(tmp_path / "run")
    with RunWriter(tmp_path / "run", overwrite=True) as writer:
        writer.write_tick(report(), 5, 2)
        writer.finish({})
    assert load_run(tmp_path / "run").meta["complete"]
    assert not list((tmp_path / "run").glob("*.part"))


def test_a_folder_with_something_else_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    for overwrite in (False, True):
        with pytest.raises(CallError, match="exists and is not a run folder"):
            RunWriter(tmp_path, overwrite=overwrite)
    assert [file.name for file in tmp_path.iterdir()] == ["letter.txt"]
    with pytest.raises(CallError, match="cannot be made a folder"):
        RunWriter(tmp_path / "letter.txt")


def test_a_table_that_a_kill_left_without_its_header_has_no_rows(tmp_path):
    with suppress(ZeroDivisionError), RunWriter(tmp_path / "run") as writer:
        writer.write_tick(report(), 5, 2)
        raise ZeroDivisionError
    for text in ("", "stamp_ns,receipt"):
        (tmp_path / "run/ego.csv").write_text(text)
        assert len(load_run(tmp_path / "run").ego) == 0
