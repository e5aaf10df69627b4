"""Run folders with Parquet tables equal those with CSV tables."""

import json
import os
import pickle
import sys

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
from fgtrack.runs import COLUMNS, RunWriter, digest, load_run

pytest.importorskip("pyarrow")


def messages(rng: np.random.Generator, tick: int) -> TickReport:
    def track(track_id: int, size: int) -> TrackReport:
        square = rng.normal(size=(size, size))
        state = TrackState(990 + tick, rng.normal(size=size), square @ square.T)
        return TrackReport(track_id, TrackStatus.CONFIRMED, state, 3, score=0.5)

    tracks = (track(1, 4), track(2, 6))
    updates = (
        UpdateRecord(
            'a",b\n', 900 + tick, 950, 0, Disposition.IN_SEQUENCE, 1, 0.1, {"x_m": 0.3}
        ),
        UpdateRecord("lidar", 901 + tick, 951, 1, Disposition.INVALID),
        UpdateRecord("lidar", 902, 951, 2, Disposition.GATED, nis=float("nan")),
    )
    smoothed = (SmoothedReport(1, tracks[0].state, 0.5),)
    return TickReport(tick, 1000 + tick, tracks, updates, smoothed)


def write(folder, table_format, num_ticks=3, scored=False):
    rng = np.random.default_rng(0)
    writer = RunWriter(
        folder,
        "seed: 1\n",
        {"is_scored": scored},
        0.5,
        overwrite=True,
        table_format=table_format,
    )
    with writer:
        writer.write_truth(TruthState(900, 900, 3, 1.0, 2.0, 0.1, 4.0))
        writer.write_ego(EgoState(900, 901, 1e70, -0.0, 0.3, 4.0))
        objects = (Detection(0.1, 0.2, class_name="car"), Detection(range_m=1.0))
        writer.write_detections(DetectionList("lidar", 901, 951, objects))
        for tick in range(num_ticks):
            writer.write_tick(messages(rng, tick), process_ns=5, num_detections=3)
        return writer.finish({})


@pytest.mark.parametrize("scored", [False, True])
def test_a_parquet_run_has_the_columns_the_types_and_the_digest_of_a_csv_run(
    tmp_path, scored
):
    metas = [write(tmp_path / kind, kind, scored=scored) for kind in ("csv", "parquet")]
    runs = [load_run(tmp_path / kind) for kind in ("csv", "parquet")]
    for table in COLUMNS:
        one, other = (run.tables[table] for run in runs)
        assert other.equals(one), table
        assert [values.dtype for values in other.values()] == [
            values.dtype for values in one.values()
        ]
        assert other.num_rows == one.num_rows
    assert metas[0]["digest"] == metas[1]["digest"] == digest(tmp_path / "parquet")
    assert not list((tmp_path / "parquet").glob("*.csv"))
    assert metas[1]["tables"] == "parquet"
    assert "tables" not in metas[0]


def test_the_digest_covers_every_group_of_rows(tmp_path, monkeypatch):
    from fgtrack.runs import parquet_table

    monkeypatch.setattr(parquet_table, "_GROUP_ROWS", 4)
    monkeypatch.setattr(parquet_table, "_BLOCK_ROWS", 3)
    monkeypatch.setattr("fgtrack.runs.sink.PERIOD_S", 0.0)
    digests = {
        write(tmp_path / kind, kind, num_ticks=9)["digest"]
        for kind in ("csv", "parquet")
    }
    assert len(digests) == 1
    run = load_run(tmp_path / "parquet")
    assert run.tables["tracks"]["tick"].tolist() == sorted([*range(9)] * 2)
    assert run.tables["updates"]["sensor"].tolist() == ['a",b\n', "lidar", "lidar"] * 9
    assert run.tables["tracks"].equals(load_run(tmp_path / "csv").tables["tracks"])


def test_a_saved_run_may_change_its_format_and_keeps_its_tables(tmp_path):
    write(tmp_path / "csv", "csv")
    run = load_run(tmp_path / "csv")
    run.save(tmp_path / "parquet", table_format="parquet")
    load_run(tmp_path / "parquet").save(tmp_path / "again")
    for file in (tmp_path / "again").glob("*.csv"):
        saved = tmp_path / "saved"
        run.save(saved, overwrite=True)
        assert file.read_bytes() == (saved / file.name).read_bytes(), file.name
    assert digest(tmp_path / "parquet") == digest(tmp_path / "again")
    assert "tables" not in json.loads((tmp_path / "again/meta.json").read_text())


def test_a_run_of_another_format_leaves_no_table_of_the_older_run(tmp_path):
    for kind, other in (("csv", "parquet"), ("parquet", "csv")):
        write(tmp_path / "run", kind)
        assert list((tmp_path / "run").glob(f"*.{kind}"))
        assert not list((tmp_path / "run").glob(f"*.{other}"))


def test_columns_that_are_read_later_belong_to_the_run_that_was_loaded(tmp_path):
    write(tmp_path / "run", "parquet", num_ticks=2)
    run = load_run(tmp_path / "run")
    write(tmp_path / "run", "parquet", num_ticks=5)
    assert len(run.tables["tracks"]["x_m"]) == 4
    kept = pickle.loads(pickle.dumps(run))
    assert kept.tables["tracks"].equals(run.tables["tracks"])


def test_a_killed_parquet_run_is_refused_with_a_reason(tmp_path):
    writer = RunWriter(tmp_path / "run", table_format="parquet")
    writer.write_tick(messages(np.random.default_rng(0), 0), 5, 3)
    with pytest.raises(
        DataError, match=r"tracks\.parquet: cannot be read .*, repeat the run"
    ):
        load_run(tmp_path / "run")
    writer.close()
    assert load_run(tmp_path / "run").tables["tracks"].num_rows == 2


@pytest.mark.parametrize("damage", ["cut", "other", "missing"])
def test_a_damaged_parquet_table_is_refused(tmp_path, damage):
    write(tmp_path / "run", "parquet")
    file = tmp_path / "run/updates.parquet"
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-20])
    elif damage == "other":
        os.replace(tmp_path / "run/timing.parquet", file)
    else:
        file.unlink()
    with pytest.raises(DataError, match=r"updates\.parquet: cannot be read"):
        load_run(tmp_path / "run")


def test_without_pyarrow_the_format_is_refused_before_the_run(tmp_path, monkeypatch):
    write(tmp_path / "run", "parquet")
    monkeypatch.delitem(sys.modules, "fgtrack.runs.parquet_table")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    for refused in (
        lambda: RunWriter(tmp_path / "new", table_format="parquet"),
        lambda: load_run(tmp_path / "run"),
    ):
        with pytest.raises(CallError, match="pip install pyarrow"):
            refused()
    assert not (tmp_path / "new").exists()


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(CallError, match="'xlsx': is not a format of tables"):
        RunWriter(tmp_path / "run", table_format="xlsx")
