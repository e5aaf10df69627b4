"""Which runs are of one recording, and where a run's recording is."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from support.messages import START_NS, standing
from unit.evaluation_runs import ROUND, WEST, update, write_run

from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.core.types import DetectionList, Message
from fgtrack.evaluation.runs import (
    by_recording,
    evaluated,
    recordings_warning,
    same_recording,
)
from fgtrack.inputs.stream import write_stream
from fgtrack.pipeline.replay import replay, replay_in_memory
from fgtrack.runs import Run, load_run

MS = 1_000_000


def run_of(messages: list[Message], *settings: str) -> Run:
    return replay_in_memory(messages, read_config(None, settings))


def test_a_recording_is_the_same_whatever_the_configuration_and_the_estimator() -> None:
    one = run_of(standing(20))
    assert same_recording(
        one, run_of(standing(20), "estimator=ekf-replay", "clock.node_hz=20.0")
    )
    later = [replace(m, receipt_ns=m.receipt_ns + 5 * MS) for m in standing(20)]
    assert same_recording(one, run_of(later)), "the same with other delays"
    restamped = [
        replace(m, stamp_ns=m.stamp_ns - 5 * MS) if isinstance(m, DetectionList) else m
        for m in standing(20)
    ]
    assert same_recording(one, run_of(restamped)), "the same with other stamps"


def test_other_detections_are_another_recording_even_at_the_same_times() -> None:
    one = run_of(standing(20))
    assert not same_recording(one, run_of(standing(20, x_m=20.0 + 1e-9)))
    assert not same_recording(one, run_of(standing(20)[:-2]))
    assert not same_recording(
        one, run_of(standing(20, delay_ms=51)[:-2] + standing(20, delay_ms=51)[-2:-1])
    )


def test_without_a_common_sensor_the_ego_decides() -> None:
    lidar, radar = run_of(standing(20)), run_of(standing(20, sensor="radar"))
    assert same_recording(lidar, radar)
    assert not same_recording(lidar, run_of(standing(20, sensor="radar", ego_x_m=1.0)))


def test_runs_of_different_recordings_are_told_by_name(tmp_path: Path) -> None:
    def write(name: str, car: object) -> Path:
        rows = car.truth(range(4))  # type: ignore[attr-defined]
        meta = {"estimator": "smoother", "input": {"path": f"{name}.mcap"}}
        return (
            write_run(
                tmp_path / name, updates={0: [update()]}, truth=rows, meta=meta
            ).path
            or tmp_path
        )

    runs = evaluated([write("a", WEST), write("b", ROUND), write("c", WEST)])
    assert [[one.label[:1] for one in group] for group in by_recording(runs)] == [
        ["a", "c"],
        ["b"],
    ]
    (line,) = recordings_warning(runs)
    assert line.startswith("the runs come from 2 recordings")
    assert "c (smoother) (a.mcap)" in line
    assert "b (smoother) (b.mcap" in line
    assert recordings_warning(runs[::2]) == []


def test_the_recording_of_a_run_is_found_from_elsewhere_and_after_a_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    write_stream(Path("drive.jsonl"), standing(20))
    replay(
        lambda: standing(20),
        Config(),
        {"ekf-replay": Path("out/run")},
        origin="drive.jsonl",
        kind="stream",
    )
    monkeypatch.chdir(tmp_path)
    place = load_run("work/out/run").recording
    assert place is not None
    assert place.samefile("work/drive.jsonl")
    os.rename("work", "moved")
    moved = load_run("moved/out/run").recording
    assert moved is not None
    assert moved.samefile("moved/drive.jsonl")
    shutil.copytree("moved/out/run", "copy")
    assert load_run("copy").recording is None
    assert run_of(standing(20)).recording is None
    meta = load_run("copy").meta
    assert (meta["messages_received"], meta["first_receipt_ns"]) == (40, START_NS)
    assert meta["last_receipt_ns"] == START_NS + 380 * MS
    assert (
        meta["detections_received"],
        meta["detections_ignored"],
        meta["ego_jumps"],
    ) == (20, 0, 0)
    ignoring = run_of(standing(20), "ignore_sensors=[lidar]").meta
    assert (ignoring["detections_received"], ignoring["detections_ignored"]) == (0, 20)
