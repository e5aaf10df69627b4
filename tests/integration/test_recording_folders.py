"""Several recordings in one command: the worst first, an error is a row, and the same bytes on cores and clusters."""

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.cli.main import run
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.folders import recordings_in
from fgtrack.inputs.stream import write_stream
from tests.support import kitti

MS = 1_000_000
FGTRACK = (sys.executable, "-c", "from fgtrack.cli.entry import main; main()")
TABLES = (
    "sweep.csv",
    "errors.csv",
    "recordings.csv",
    "over_recordings.csv",
    "differences_over_recordings.csv",
)
PATIENCE_S = 600.0
CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        pids = [str(worker.pid) for worker in cluster.workers.values()]
        print(cluster.scheduler_address, *pids, flush=True)
        sys.stdin.read()
"""


def drive(seed: int, missed: float = 0.0, noise_m: float = 0.2) -> Iterator[Message]:
    """A car ahead of an ego at rest; a share of its detections is missed."""
    rng = np.random.default_rng(seed)
    for k in range(40):
        now_ns = k * 100 * MS
        x_m = 10.0 + 0.5 * k
        yield TruthState(now_ns, now_ns, 1, x_m, 2.0, 0.0, 5.0)
        yield EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0)
        at_m = rng.normal([x_m, 2.0], noise_m).tolist()
        seen = () if rng.random() < missed else (Detection(*at_m),)
        yield DetectionList("lidar", now_ns, now_ns + MS, seen, "map")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def drives(tmp_path: Path) -> Path:
    folder = tmp_path / "drives"
    folder.mkdir()
    write_stream(folder / "good.jsonl", drive(0))
    write_stream(folder / "missed.jsonl", drive(1, missed=0.6))
    write_stream(folder / "noisy.jsonl", drive(2, noise_m=0.6))
    (folder / "broken.jsonl").write_text('{"type": "nothing"}\n')
    (folder / "README.md").write_text("Four drives.\n")
    return folder


def test_a_folder_is_listed_and_the_worst_recording_comes_first(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = ["replay", str(drives), "-o", str(out), "-e", "ekf-replay,smoother"]
    words += ["--jobs", "1"]
    assert run(words) == 1
    shown = capsys.readouterr()
    assert "1 of 4 recordings have an error or an open question" in shown.err
    assert "settings of all recordings, from good" in shown.out
    assert "broken: no result error: " in shown.out
    found = rows(out / "recordings.csv")
    assert [row["recording"] for row in found[1:]] == [
        *["missed"] * 2,
        *["noisy"] * 2,
        *["good"] * 2,
    ]
    assert found[0]["recording"] == "broken"
    assert found[0]["reason"].startswith("error: ")
    assert found[1]["reason"].endswith("% missed objects")
    assert (out / "good/smoother/tracks.csv").exists()
    # The command resumes: only the broken recording, which was repaired, is left.
    kept = (out / "good/smoother/meta.json").stat().st_mtime_ns
    write_stream(drives / "broken.jsonl", drive(3), overwrite=True)
    assert run(words) == 0
    assert "recordings: 4; to do: 1" in capsys.readouterr().out
    assert (out / "good/smoother/meta.json").stat().st_mtime_ns == kept
    [over] = [
        row
        for row in rows(out / "over_recordings.csv")
        if row["estimator"] == "smoother"
    ]
    assert over["recordings"] == "4"
    tables = fgtrack.compare(out)
    names = {Path(row["recording"]).stem for row in tables.tables["recordings"].records}
    assert names == {"broken", "good", "missed", "noisy"}
    compared = next(
        row
        for row in tables.tables["over_recordings"].records
        if row["estimator"] == "smoother"
    )
    name = "truth.overall.errors.position_m.rmse"
    assert compared[name] == pytest.approx(float(over[name]), rel=1e-12)


def test_a_run_folder_that_was_deleted_is_made_again(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (drives / "broken.jsonl").unlink()
    words = ["replay", str(drives), "-o", str(tmp_path / "out"), "--jobs", "1"]
    assert run(words) == 0
    for file in (tmp_path / "out/noisy").iterdir():
        file.unlink()
    capsys.readouterr()
    assert run(words) == 0
    assert "to do: 1" in capsys.readouterr().out
    assert (tmp_path / "out/noisy/meta.json").exists()


def many(folder: Path, number: int) -> Path:
    """Sequences in the layout of the KITTI data set, with two cars ahead of an ego at rest; one is damaged."""
    for sequence in range(number):
        rng = np.random.default_rng(sequence)
        frames = range(15)
        poses, labels = [], []
        for frame in frames:
            for car, (ahead_m, aside_m) in enumerate(((12.0, 1.0), (25.0, -3.0))):
                at_m = (ahead_m + 0.4 * frame, aside_m)
                labels.append(kitti.label(frame, car, "Car", *at_m, 0.0))
                if rng.random() < 0.9:
                    poses.append(kitti.pose(frame, *rng.normal(at_m, 0.2), 0.0))
        kitti.folder(
            folder,
            f"{sequence:04d}",
            oxts=[kitti.oxts()] * len(frames),
            label_02=labels,
            pointrcnn_car=poses,
        )
    (folder / "pointrcnn_car/0003.txt").write_text("0 nonsense\n")
    return folder


def test_the_sequences_of_a_data_set_are_recordings(tmp_path: Path) -> None:
    data = many(tmp_path / "data", 4)
    assert [path.name for path in recordings_in(data)] == [
        f"000{k}.txt" for k in range(4)
    ]
    one = data / "oxts/0002.txt"
    assert recordings_in(one) == [one]


@pytest.mark.slow
def test_twenty_recordings_give_the_same_bytes_on_cores_and_on_a_cluster_that_loses_a_worker(
    tmp_path: Path,
) -> None:
    if find_spec("distributed") is None:
        pytest.skip("distributed is not installed (extra `dask`)")
    data = many(tmp_path / "data", 20)
    call = [*FGTRACK, "replay", str(data), "-e", "ekf-replay,smoother"]
    by_jobs = tmp_path / "jobs"
    done = subprocess.run(
        [*call, "-o", str(by_jobs), "--jobs", "2"], timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 1  # one recording is damaged
    assert [row["recording"] for row in rows(by_jobs / "errors.csv")] == ["0003"] * 2
    assert rows(by_jobs / "recordings.csv")[0]["recording"] == "0003"
    assert len(rows(by_jobs / "sweep.csv")) == 2 * 19
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    on_cluster = tmp_path / "cluster"
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=pipe, stdout=pipe, text=True
    ) as cluster:
        assert cluster.stdout is not None
        address, victim, _ = cluster.stdout.readline().split()
        try:
            words = [*call, "-o", str(on_cluster), "--dask", address]
            with subprocess.Popen(words) as process:
                end = time.monotonic() + PATIENCE_S
                while not list((on_cluster / "parts").glob("*.json")):
                    assert process.poll() is None
                    assert time.monotonic() < end
                    time.sleep(0.05)
                os.kill(int(victim), signal.SIGKILL)
                assert process.wait(PATIENCE_S) == 1
        finally:
            cluster.communicate("")
    for name in TABLES:
        assert (on_cluster / name).read_bytes() == (by_jobs / name).read_bytes(), name
    for run_folder in by_jobs.glob("*/*/tracks.csv"):
        other = on_cluster / run_folder.relative_to(by_jobs)
        assert other.read_bytes() == run_folder.read_bytes()
