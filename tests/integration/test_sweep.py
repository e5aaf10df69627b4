"""Sweeps end to end: the same bytes however they come about, and nothing lost when something goes wrong."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

import fgtrack
from fgtrack.cli.main import run
from fgtrack.config.yaml_file import load
from fgtrack.core.errors import DataError
from fgtrack.inputs.stream import write_stream
from fgtrack.pipeline.scored_sweep import score
from fgtrack.pipeline.sweep import Sweep
from fgtrack.pipeline.sweep_plan import load_plan
from fgtrack.runs import Run
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate

CONFIGS = Path(__file__).parents[2] / "configs"
FGTRACK = (sys.executable, "-c", "from fgtrack.cli.entry import main; main()")
PATIENCE_S = 120.0
POINT = ("lidar_delay_s", "association.gate_m", "seed")

CLUSTER = """
import sys
from distributed import LocalCluster

if __name__ == "__main__":
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
        done = {entry[0] for entry in cluster.scheduler.transition_log if entry[2] == "memory"}
        print(sum("run_job" in key for key in done), flush=True)
"""


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def parts(out: Path) -> list[Path]:
    return sorted((out / "parts").glob("*.json"))


def write_sweep(folder: Path, text: str, name: str = "sweep.yaml") -> Path:
    """A sweep of the clean scenario with one car."""
    path = folder / name
    head = f"scenario: {CONFIGS}/scenarios/single_opponent.yaml\nconfig: {CONFIGS}/karle2023.yaml\n"
    path.write_text(f"format: fgtrack-sweep/1\n{head}{text}")
    return path


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The committed smoke sweep with more seeds, so that there is time to stop it."""
    text = (
        (CONFIGS / "sweeps/smoke.yaml")
        .read_text()
        .replace("../", f"{CONFIGS}/")
        .replace("seeds: 2", "seeds: 3")
    )
    path = tmp_path_factory.mktemp("smoke") / "smoke.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def done(smoke: Path) -> Path:
    """Folder of that sweep, done by one process."""
    out = smoke.parent / "one"
    assert run(["sweep", str(smoke), "-o", str(out), "--jobs", "1"]) == 0
    return out


# --- the table


def test_the_committed_smoke_sweep_has_a_row_for_every_cell(done: Path) -> None:
    table = rows(done / "sweep.csv")
    cells = [
        (row["lidar_delay_s"], row["association.gate_m"], row["seed"], row["estimator"])
        for row in table
    ]
    names = ("smoother", "ekf-backward-forward")
    expected = [
        (delay, gate, str(seed), name)
        for delay in ("0.05", "0.15")
        for gate in ("5.0", "3.0")
        for seed in range(3)
        for name in names
    ]
    assert cells == expected
    assert rows(done / "errors.csv") == []
    assert all(float(row["replay_s"]) > 0.0 for row in rows(done / "timing.csv"))
    assert all(
        0.0 < float(row["truth.overall.errors.position_m.rmse"]) < 3.0 for row in table
    )


def test_it_ends_with_means_and_standard_errors(
    smoke: Path, done: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metric = "truth.overall.errors.position_m.rmse"
    summary = rows(done / "summary.csv")
    assert len(summary) == 8  # four points and two estimators
    first = [
        float(row[metric])
        for row in rows(done / "sweep.csv")
        if row["estimator"] == "smoother"
    ][:3]
    assert float(summary[0][metric]) == pytest.approx(np.mean(first))
    assert float(summary[0][f"{metric}.standard_error"]) == pytest.approx(
        np.std(first, ddof=1) / math.sqrt(3)
    )
    assert run(["sweep", str(smoke), "-o", str(done)]) == 0
    shown = capsys.readouterr().out
    assert (
        shown.index("worse")
        < shown.index("Summary")
        < shown.index("all metrics: --all")
    )
    assert run(["sweep", str(smoke), "-o", str(done), "--format", "md"]) == 0
    assert capsys.readouterr().out.startswith("### Summary")


def test_the_numbers_are_those_of_simulate_replay_and_compare(
    done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, stream, folder = (
        CONFIGS / "scenarios/single_opponent.yaml",
        tmp_path / "s.jsonl",
        tmp_path / "runs",
    )
    assert (
        run(
            [
                "simulate",
                str(scenario),
                "-o",
                str(stream),
                "--seed",
                "2",
                "--duration",
                "2",
            ]
        )
        == 0
    )
    names = ["smoother", "ekf-backward-forward"]
    call = [
        "replay",
        str(stream),
        "-c",
        str(CONFIGS / "smoother.yaml"),
        "-e",
        ",".join(names),
        "-o",
        str(folder),
    ]
    assert run([*call, "--map", "oval"]) == 0
    capsys.readouterr()
    assert run(["compare", str(folder), "--json"]) == 0
    runs = json.loads(capsys.readouterr().out)["runs"]
    wanted = ("0.15", "5.0", "2")
    table = [
        row
        for row in rows(done / "sweep.csv")
        if tuple(row[name] for name in POINT) == wanted
    ]
    assert [row["estimator"] for row in table] == names
    for row in table:
        metrics = runs[row["estimator"]]
        error = metrics["truth"]["overall"]["errors"]["position_m"]["rmse"]
        assert row["truth.overall.errors.position_m.rmse"] == repr(error)
        assert row["consistency.nis.radar.mean"] == repr(
            metrics["consistency"]["nis"]["radar"]["mean"]
        )
        received = metrics["sensors"]["lidar_cluster"]["detections"]
        assert row["sensors.lidar_cluster.detections"] == str(received)


# --- the same bytes


def wait_for_parts(out: Path, process: subprocess.Popen[str]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not parts(out):
        assert process.poll() is None, "the sweep ended before it was to be stopped"
        assert time.monotonic() < end, "no job was finished in time"
        time.sleep(0.02)


def children(pid: int) -> list[int]:
    """Processes started by the process `pid`."""
    asked = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)],
        capture_output=True,
        text=True,
        check=True,
    )
    return [int(line) for line in asked.stdout.split()]


def runs(pid: int) -> bool:
    """Whether the process `pid` exists and is more than an entry that waits for its parent to ask for it."""
    asked = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(pid)],
        capture_output=True,
        text=True,
        check=False,
    )
    return bool(asked.stdout.strip()) and not asked.stdout.startswith("Z")


@pytest.mark.slow
def test_a_killed_sweep_goes_on_where_it_was_and_gives_the_same_bytes(
    smoke: Path, done: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "killed"
    with subprocess.Popen(
        [*FGTRACK, "sweep", str(smoke), "-o", str(out), "--jobs", "2"], text=True
    ) as process:
        wait_for_parts(out, process)
        orphans = children(process.pid)
        process.kill()
    end = time.monotonic() + PATIENCE_S
    while any(map(runs, orphans)) and time.monotonic() < end:
        time.sleep(0.1)
    assert len(orphans) >= 2
    assert not any(map(runs, orphans)), "processes outlive their sweep"
    kept = {path: path.stat().st_mtime_ns for path in parts(out)}
    total = len(parts(done))
    assert 0 < len(kept) < total
    assert not (out / "sweep.csv").exists()
    capsys.readouterr()
    assert run(["sweep", str(smoke), "-o", str(out), "--jobs", "1"]) == 0
    assert (
        f"jobs: {total} with 2 estimators each; to do: {total - len(kept)}"
        in capsys.readouterr().out
    )
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert (out / "sweep.csv").read_bytes() == (done / "sweep.csv").read_bytes()
    assert [path.name for path in parts(out)] == [path.name for path in parts(done)]


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_ctrl_c_is_one_line_and_what_is_done_stays(
    smoke: Path, tmp_path: Path, jobs: int
) -> None:
    out = tmp_path / "interrupted"
    call = [*FGTRACK, "sweep", str(smoke), "-o", str(out), "--jobs", str(jobs)]
    # Whatever started the tests may ignore SIGINT, and a child inherits that.
    here = signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        call, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        signal.signal(signal.SIGINT, here)
        wait_for_parts(out, process)
        os.killpg(
            process.pid, signal.SIGINT
        )  # a terminal tells every process of the group
        assert process.stderr is not None
        *before, last = process.stderr.read().splitlines()
    assert process.returncode == 130
    assert (
        last == "fgtrack: error: interrupted; finished results are in the output folder"
    )
    assert all(
        line.startswith("fgtrack: sweep, ") for line in before
    )  # of a machine that has other work as well
    assert len(rows(out / "sweep.csv")) == 2 * len(parts(out))


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_bytes(
    smoke: Path, done: Path, tmp_path: Path
) -> None:
    if find_spec("distributed") is None:
        pytest.skip("distributed is not installed (extra `dask`)")
    script, out = tmp_path / "cluster.py", tmp_path / "out"
    script.write_text(CLUSTER)
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=pipe, stdout=pipe, text=True
    ) as cluster:
        assert cluster.stdout is not None
        call = [
            *FGTRACK,
            "sweep",
            str(smoke),
            "-o",
            str(out),
            "--dask",
            cluster.stdout.readline().strip(),
        ]
        try:
            subprocess.run(call, check=True, timeout=PATIENCE_S)
        finally:
            count, _ = cluster.communicate("")
    assert int(count) == len(parts(done))  # the workers did it, not this machine
    assert (out / "sweep.csv").read_bytes() == (done / "sweep.csv").read_bytes()


# --- what goes wrong


def test_bad_cells_are_reported_and_the_rest_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One point that does not fit, one whose map is missing, and one that only one estimator cannot do."""
    sweep = write_sweep(
        tmp_path,
        """
duration_s: 1.0
estimators: [ekf-replay, smoother]
metrics: [truth.overall.errors.position_m.rmse]
vary:
  what:
    label: [good, negative gate, no map, good again]
    association.gate_m: [5.0, -1.0, 5.0, 4.0]
    scenario.map: [oval, oval, missing.csv, oval]
""",
    )
    assert run(["sweep", str(sweep), "-o", str(tmp_path / "out"), "--jobs", "1"]) == 1
    good = [(row["what"], row["estimator"]) for row in rows(tmp_path / "out/sweep.csv")]
    bad = {
        (row["what"], row["estimator"]): row["error"]
        for row in rows(tmp_path / "out/errors.csv")
    }
    assert sorted([*good, *bad]) == sorted(
        (what, name)
        for what in ("good", "negative gate", "no map", "good again")
        for name in ("ekf-replay", "smoother")
    )
    assert set(bad) == {
        (what, name)
        for what in ("negative gate", "no map")
        for name in ("ekf-replay", "smoother")
    }
    assert "gate_m: Input should be greater than 0" in bad["negative gate", "smoother"]
    assert "missing.csv" in bad["no map", "ekf-replay"]
    said = [
        line
        for line in capsys.readouterr().err.splitlines()
        if not line.startswith("fgtrack: sweep, ")
    ]
    counts = [
        line.partition(", about")[0] for line in said[:-1]
    ]  # time left: the clock
    assert counts == [f"fgtrack: sweep: {done} of 3" for done in (1, 2, 3)]
    first = "what=negative gate, .*association.gate_m: "
    assert re.match(
        rf"fgtrack: error: .*errors\.csv: 4 cells failed, the first: {first}", said[-1]
    )


def deadly(run: Run) -> tuple[dict, dict]:
    """Dies of the backward-forward EKF with a gate of 3 m."""
    scores = score(run)
    if (
        run.meta["estimator"] == "ekf-backward-forward"
        and scores[0]["options.gate_m"] == 3.0
    ):
        os.kill(os.getpid(), signal.SIGKILL)
    return scores


@pytest.mark.slow
def test_a_process_that_dies_ends_the_sweep_in_a_line_and_what_is_done_stays(
    tmp_path: Path,
) -> None:
    sweep = write_sweep(
        tmp_path,
        """
duration_s: 0.5
estimators: [ekf-replay, ekf-backward-forward]
vary: {evaluation.gate_m: [5.0, 3.0, 4.0]}
""",
    )
    plan, out = load_plan(sweep), tmp_path / "out"
    with pytest.raises(DataError, match="the workers failed, perhaps out of memory"):
        Sweep.open(plan, out).run(deadly, jobs=2)
    assert len(rows(out / "sweep.csv")) == 2 * len(Sweep.open(plan, out).done)


# --- going on


def test_a_changed_sweep_reuses_what_it_can(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "duration_s: 0.5\nestimators: [ekf-replay]\nseeds: 2\nvary: {association.gate_m: [5.0, 3.0]}\n"
    out = tmp_path / "out"
    call = ["sweep", str(write_sweep(tmp_path, text)), "-o", str(out), "--jobs", "1"]
    assert run(call) == 0
    write_sweep(tmp_path, text.replace("seeds: 2", "seeds: 3").replace("3.0", "2.0"))
    assert run(call) == 0
    assert "jobs: 6 with 1 estimators each; to do: 4" in capsys.readouterr().out
    assert [row["association.gate_m"] for row in rows(out / "sweep.csv")] == [
        "5.0"
    ] * 3 + ["2.0"] * 3


def test_a_recording_is_swept_over_delays(tmp_path: Path) -> None:
    scenario = load(Scenario, CONFIGS / "scenarios/single_opponent.yaml")
    messages = simulate(scenario, np.random.default_rng(0))
    start_ns = messages[0].receipt_ns
    write_stream(
        tmp_path / "drive.jsonl",
        [m for m in messages if m.receipt_ns < start_ns + 2_000_000_000],
    )
    sweep = tmp_path / "sweep.yaml"
    sweep.write_text(
        """
format: fgtrack-sweep/1
input: drive.jsonl
seeds: [3, 4]
estimators: [ekf-replay]
vary:
  delays.radar.delay: [{kind: constant, delay_s: 0.1}, {kind: uniform, min_s: 0.1, max_s: 0.2}]
"""
    )
    assert run(["sweep", str(sweep), "-o", str(tmp_path / "out"), "--jobs", "1"]) == 0
    means = [
        float(row["sensors.radar.delay_s.mean"])
        for row in rows(tmp_path / "out/sweep.csv")
    ]
    assert means[:2] == pytest.approx([0.1, 0.1], abs=1e-9)
    assert all(0.12 < mean < 0.18 for mean in means[2:])
    assert means[2] != means[3]  # the seed draws the delays


def test_a_changed_file_that_the_sweep_names_is_read_again(tmp_path: Path) -> None:
    drive = tmp_path / "drive"
    drive.mkdir()
    columns = "{stamp: t, x_m: x, y_m: y}"

    def write(name: str, offset_m: float) -> None:
        rows = [
            f"{0.05 * k:.2f},{20.0 + 0.5 * k},{offset_m if k > 20 else 0.0}"
            for k in range(40)
        ]
        (drive / name).write_text("\n".join(["t,x,y", *rows, ""]))

    for name in ("near.csv", "far.csv"):
        write(name, 0.5)
    sensors = "{radar: {std: {x_m: 1.0, y_m: 1.0}}}"
    table = f"{{file: near.csv, frame: map, columns: {columns}}}"
    (tmp_path / "csv.yaml").write_text(
        f"input: {{csv: {{detections: {{radar: {table}}}}}}}\nsensors: {sensors}\n"
    )
    head = "format: fgtrack-sweep/1\ninput: drive\nconfig: csv.yaml\nestimators: [ekf-replay]\n"
    key = "input.csv.detections.radar.file"
    metric = "consistency.nis.radar.mean"
    for name, more in (
        ("vary", f"vary: {{{key}: [near.csv, far.csv]}}"),
        ("set", f"set: {{{key}: far.csv}}"),
    ):
        (tmp_path / f"{name}.yaml").write_text(f"{head}{more}\n")
        write("far.csv", 0.5)
        found = []
        for out, offset_m in (("kept", 0.5), ("kept", 1.5), ("new", 1.5)):
            write("far.csv", offset_m)
            call = [
                "sweep",
                str(tmp_path / f"{name}.yaml"),
                "-o",
                str(tmp_path / f"{out}_{name}"),
                "--jobs",
                "1",
            ]
            assert run(call) == 0
            found.append(
                [row[metric] for row in rows(tmp_path / f"{out}_{name}/sweep.csv")]
            )
        assert found[1] == found[2]
        assert found[0][-1] != found[1][-1]


def test_a_sweep_in_python_runs_the_first_seeds_and_then_those_that_are_left(
    tmp_path: Path,
) -> None:
    sweep = write_sweep(
        tmp_path,
        "duration_s: 0.5\nestimators: [ekf-replay]\nseeds: 2\nvary: {association.gate_m: [5.0, 3.0]}\n",
    )
    first = fgtrack.sweep(sweep, tmp_path / "out", num_seeds=1, jobs=1)
    assert first["association.gate_m"].tolist() == [5.0, 3.0]
    assert first["seed"].tolist() == [0, 0]
    metric = "truth.overall.errors.position_m.rmse"
    every = fgtrack.sweep(sweep, tmp_path / "out", jobs=1)
    assert sorted(every["seed"]) == [0, 0, 1, 1]
    again = every[every["seed"] == 0]
    assert again[metric].tolist() == first[metric].tolist()


def test_the_first_seeds_of_a_list_are_counted_and_not_compared(tmp_path: Path) -> None:
    sweep = write_sweep(
        tmp_path, "duration_s: 0.5\nestimators: [ekf-replay]\nseeds: [7, 3, 5]\n"
    )
    first = fgtrack.sweep(sweep, tmp_path / "out", num_seeds=2, jobs=1)
    assert sorted(first["seed"]) == [3, 7]
