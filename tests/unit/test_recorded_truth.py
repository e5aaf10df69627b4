"""The truth of a run may stay in its recording, and idle ticks may be left out."""

import gzip
import json
import math
import pickle
from dataclasses import replace

import pytest

import fgtrack
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, TruthState
from fgtrack.inputs.stream import write_stream
from fgtrack.pipeline.clock import busy_ticks, clock_ticks

MS = 1_000_000
CONFIG = {"sensors": {"lidar": {"std": {"x_m": 0.3, "y_m": 0.3}}}}


def messages(num=20):
    for k in range(num):
        now_ns = k * 100 * MS
        yield TruthState(now_ns, now_ns, 7, 10.0 + k, 2.0, 0.1, 10.0)
        yield TruthState(now_ns, now_ns, 8, 0.1 * k, -7.0)
        yield TruthState(now_ns, now_ns, -1, 0.0, 0.0, ignored=True)
        yield EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 1.0)
        item = Detection(10.0 + k, 2.0, id="truth")
        yield DetectionList("lidar", now_ns, now_ns + MS, (item,), "map")


def replayed(recording, out, truth=None, **more):
    return fgtrack.replay(recording, CONFIG, out=out, truth=truth, **more)


@pytest.fixture
def stream(tmp_path):
    write_stream(tmp_path / "drive.jsonl", messages())
    return tmp_path / "drive.jsonl"


@pytest.mark.parametrize("name", ["drive.jsonl", "drive.jsonl.gz"])
def test_a_run_reads_its_truth_from_the_recording(tmp_path, name):
    write_stream(tmp_path / name, messages())
    kept = replayed(tmp_path / name, tmp_path / "kept")
    read = replayed(tmp_path / name, tmp_path / "read", "recording")
    assert not (tmp_path / "read/truth.csv").exists()
    assert read.tables["truth"].num_rows == kept.tables["truth"].num_rows == 40
    assert read.tables["truth"].equals(kept.tables["truth"])
    assert read.tables["ignored"].equals(kept.tables["ignored"])
    assert pickle.loads(pickle.dumps(read)).truth.equals(kept.truth)
    assert read.meta["digest"] == kept.meta["digest"]
    one, other = (fgtrack.evaluate(run).as_dict()["truth"] for run in (kept, read))
    assert one is not None
    assert json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


def test_a_run_moves_together_with_its_recording(tmp_path, stream):
    (tmp_path / "a").mkdir()
    moved = stream.rename(tmp_path / "a/drive.jsonl")
    replayed(moved, tmp_path / "a/run", "recording")
    (tmp_path / "a").rename(tmp_path / "b")
    assert len(fgtrack.load_run(tmp_path / "b/run").truth) == 40


def test_runs_of_a_recording_share_its_truth(tmp_path, stream):
    runs = [replayed(stream, tmp_path / name, "recording") for name in "ab"]
    assert runs[0].tables["truth"]["x_m"] is runs[1].tables["truth"]["x_m"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda file: file.unlink(), r"drive\.jsonl, which is missing: restore"),
        (
            lambda file: file.write_text(file.read_text().replace("-7.0", "-7.5")),
            "has changed since the replay: restore",
        ),
        (
            lambda file: file.write_text(file.read_text().splitlines()[0] + "\n"),
            "has changed since the replay: restore",
        ),
    ],
)
def test_a_run_that_loses_its_recording_reports_it_in_one_line(
    tmp_path, stream, change, reason
):
    replayed(stream, tmp_path / "run", "recording")
    change(stream)
    run = fgtrack.load_run(tmp_path / "run")
    assert len(run.tracks)
    with pytest.raises(DataError, match=reason) as raised:
        fgtrack.evaluate(run)
    assert "\n" not in str(raised.value)


def test_records_after_the_replay_and_of_other_types_do_not_matter(tmp_path, stream):
    replayed(stream, tmp_path / "run", "recording")
    with stream.open("a") as file:
        file.write('{"type": "truth", "stamp_ns": 9, "object_id": 1}\n{"type": ')
    assert len(fgtrack.load_run(tmp_path / "run").truth) == 40


def test_a_truth_in_latitude_and_longitude_is_converted_as_in_the_replay(tmp_path):
    lines = [json.dumps({"type": "header", "format": "fgtrack-stream/1"})]
    for k in range(5):
        head = {"stamp_ns": k * MS, "receipt_ns": k * MS}
        at = {"latitude_deg": 50.0 + 1e-5 * k, "longitude_deg": 8.0}
        lines.append(
            json.dumps(
                {"type": "detections", "sensor": "lidar", **head, "objects": [at]}
            )
        )
        lines.append(
            json.dumps(
                {"type": "truth", **head, "object_id": 1, **at, "speed_mps": 1, "k": k}
            )
        )
    with gzip.open(tmp_path / "sea.jsonl.gz", "wt") as file:
        file.write("\n".join(lines) + "\n")
    for settings in ({}, {"input.origin": {"latitude_deg": 49.9, "longitude_deg": 8}}):
        found = [
            replayed(
                tmp_path / "sea.jsonl.gz",
                tmp_path / "run",
                truth,
                set=settings,
                overwrite=True,
            ).tables["truth"]
            for truth in ("copy", "recording")
        ]
        assert found[0].equals(found[1])
        assert math.isfinite(found[1]["x_m"].sum())


def test_a_saved_run_has_a_copy_of_the_truth(tmp_path, stream):
    replayed(stream, tmp_path / "run", "recording").save(tmp_path / "saved")
    stream.unlink()
    saved = fgtrack.load_run(tmp_path / "saved")
    assert len(saved.truth) == 40
    assert "truth" not in saved.meta


def test_only_a_stream_keeps_the_truth_of_a_run(tmp_path, stream):
    with pytest.raises(CallError, match="can stay only in an fgtrack stream"):
        replayed(list(messages()), tmp_path / "run", "recording")
    with pytest.raises(CallError, match="give copy or recording, not 'nowhere'"):
        replayed(stream, tmp_path / "run", "nowhere")
    assert not (tmp_path / "run").exists()


def test_parquet_runs_of_a_stream_leave_the_truth_there(tmp_path, stream):
    pytest.importorskip("pyarrow")
    for truth, has_copy in ((None, False), ("copy", True), ("recording", False)):
        run = replayed(
            stream, tmp_path / "run", truth, overwrite=True, table_format="parquet"
        )
        assert (tmp_path / "run/truth.parquet").exists() == has_copy
        assert len(run.truth) == 40
    replayed(list(messages()), tmp_path / "other", table_format="parquet")
    assert (tmp_path / "other/truth.parquet").exists()


def test_without_idle_ticks_every_tick_has_a_list_and_all_messages_are_delivered():
    received = [
        EgoState(0, 5 * MS, 0.0, 0.0, 0.0, 1.0),
        DetectionList("lidar", 0, 7 * MS, ()),
        *(EgoState(0, k * 10 * MS, 0.0, 0.0, 0.0, 1.0) for k in range(1, 9)),
        DetectionList("lidar", 0, 81 * MS, ()),
        EgoState(0, 150 * MS, 0.0, 0.0, 0.0, 1.0),
    ]
    every = list(clock_ticks(received, 50.0))
    busy = list(busy_ticks(every))
    assert [tick.now_ns for tick in busy] == [20 * MS, 100 * MS, 160 * MS]
    assert [one for tick in busy for one in tick.messages] == received
    assert len(every) == 8


def test_a_run_without_idle_ticks_has_the_states_of_the_other_ticks(tmp_path):
    def rows(run):
        tracks = run.tables["tracks"]
        return {
            (now_ns, track_id): x_m
            for now_ns, track_id, x_m in zip(
                *(tracks[name].tolist() for name in ("now_ns", "track_id", "x_m")),
                strict=True,
            )
        }

    every = fgtrack.replay(list(messages()), CONFIG)
    busy = fgtrack.replay(list(messages()), CONFIG, set={"clock.idle_ticks": False})
    assert len(every.timing) > 4 * len(busy.timing)
    assert rows(busy).items() <= rows(every).items()
    assert busy.updates["disposition"].tolist() == every.updates["disposition"].tolist()


def test_a_truth_beyond_the_last_list_stays_part_of_the_run(tmp_path):
    late = [*messages(), replace(next(iter(messages())), stamp_ns=5000 * MS)]
    write_stream(tmp_path / "late.jsonl", late)
    assert (
        len(replayed(tmp_path / "late.jsonl", tmp_path / "a", "recording").truth) == 41
    )


def test_the_truth_of_a_recording_has_no_other_columns(tmp_path, stream):
    truth = replayed(stream, tmp_path / "run", "recording").tables["truth"]
    for table in (truth, truth.where(truth["object_id"] >= 0)):
        assert "x_m" in table
        assert "p_x_x" not in table
        with pytest.raises(KeyError):
            table["p_x_x"]
