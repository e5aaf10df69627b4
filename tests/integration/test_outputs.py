"""What a command did not make it neither removes nor replaces."""

import errno
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from support import kitti
from support.paper import paper

from fgtrack.cli import demo
from fgtrack.cli.main import COMMANDS, _command, run
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TickReport
from fgtrack.io import output
from fgtrack.io.output import claimed, new_file, write_file
from fgtrack.io.ros.bag_writer import write_bag
from fgtrack.io.run import RunWriter, digest, load_run
from fgtrack.io.run.schema import COLUMNS
from fgtrack.io.source import open_input
from fgtrack.io.stream import STREAM, read_stream, write_stream
from fgtrack.models.oval import make_oval
from fgtrack.pipeline.load import dump
from fgtrack.pipeline.replay import replay_each
from fgtrack.pipeline.shipped import read_scenario, shipped_folder
from fgtrack.pipeline.sweep_plan import load_plan
from fgtrack.plotting.late_detection import close_up_of
from fgtrack.plotting.slow_motion import Arrival
from fgtrack.plotting.style import DRAWN, save

MS = 1_000_000
START_NS = 1_600_000_000_000_000_000
SWEEP = "format: fgtrack-sweep/1\nscenario: default\nestimators: [ekf-replay]\nseeds: 1\n"

SCENARIOS = shipped_folder() / "scenarios"

Call = Callable[..., tuple[int, str]]

#: Files of other programs whose beginnings look alike.
OTHERS = {
    ".png": b"\x89PNG\r\n\x1a\n years of work",
    ".pdf": b"%PDF-1.7 years of work",
    ".html": b"<!DOCTYPE html><html>years of work",
    ".mcap": b"\x89MCAP0\r\n years of work",
    ".yaml": b"estimator: smoother\n",
    ".csv": b"seed,yield_kg\n1,2\n",
    ".jsonl": b'{"type": "header", "format": "years of work"}\n',
}


def drive(count: int = 30) -> list[Message]:
    """An ego at rest and one car ahead of it, seen by a lidar."""
    messages: list[Message] = []
    for k in range(count):
        now_ns = START_NS + k * 20 * MS
        messages.append(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        messages.append(DetectionList("lidar", now_ns - 50 * MS, now_ns, (Detection(x_m=20.0, y_m=1.0, yaw_rad=0.0),)))
    return messages


def noisy(count: int = 120) -> list[Message]:
    """The same without yaws, with noise that can be fitted."""
    rng, messages = np.random.default_rng(1), list[Message]()
    for k in range(count):
        now_ns, (x_m, y_m) = START_NS + k * 50 * MS, rng.normal((20.0, 1.0), 0.5)
        messages.append(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        messages.append(DetectionList("lidar", now_ns, now_ns, (Detection(x_m=x_m, y_m=y_m),)))
    return messages


def content(path: Path) -> dict[str, bytes | None]:
    """Every file below `path` with its bytes, and every folder."""
    below = [path, *sorted(path.rglob("*"))]
    return {str(item): item.read_bytes() if item.is_file() else None for item in below if os.path.lexists(item)}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings, runs, and what every command makes of them."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(demo, "simulate", lambda scenario, rng: drive())
        write_stream("drive.jsonl", drive())
        write_stream("noisy.jsonl", noisy())
        write_stream("other.jsonl", drive(10))
        write_bag("bag", drive(10))
        seen = [kitti.pose(frame, 20.0, 3.0, 0.0) for frame in range(30)]
        kitti.folder(folder / "kitti", oxts=[kitti.oxts(speed_mps=10.0)] * 30, pointrcnn_car=seen)
        Path("sweep.yaml").write_text(SWEEP)
        for words in (
            ("replay", "other.jsonl", "-o", "run"),
            ("replay", "kitti/oxts/0001.txt", "-o", "kitti_run"),
            ("demo", "-o", "demo"),
            *(words for words, _ in WRITERS if words[0] in ("figure", "report", "export", "tune", "advise", "info")),
        ):
            assert run(list(words)) == 0
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, a copy of that one; figures are copied, not drawn."""
    folder = shutil.copytree(made, tmp_path / "here")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(demo, "simulate", lambda scenario, rng: drive())

    def redraw(named: object, folder: Path, form: str) -> list[Path]:
        return [Path(shutil.copy(picture, folder)) for picture in sorted((made / "figures").iterdir())]

    monkeypatch.setattr("fgtrack.cli.figure.save_named", redraw)
    monkeypatch.setattr(
        "fgtrack.cli.figure.save_pages", lambda figures, file: file.write((made / "figures.pdf").read_bytes())
    )
    return folder


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Iterator[Call]:
    """Runs a command; gives its exit code and the line on stderr."""
    monkeypatch.setattr("fgtrack.cli.show.LINE_PERIOD_S", math.inf)  # a busy machine would make it tell its progress

    def called(*words: str) -> tuple[int, str]:
        capfd.readouterr()
        code = run(list(words))
        lines = capfd.readouterr().err.splitlines()
        assert len(lines) == (code != 0), lines
        return code, "".join(lines)

    return called


#: Commands with an output, and what they write of it: the path at which something else may be.
WRITERS = [
    (("simulate", "default", "--duration", "1", "-o", "other.jsonl"), "other.jsonl"),
    (("simulate", "default", "--duration", "1", "-o", "bag"), "bag"),
    (("convert", "drive.jsonl", "other.jsonl"), "other.jsonl"),
    (("convert", "drive.jsonl", "bag"), "bag"),
    (("convert", "drive.jsonl", "bag", "--storage", "sqlite3"), "bag"),
    (("replay", "drive.jsonl", "-o", "run"), "run"),
    (("replay", "drive.jsonl", "-o", "demo/runs", "-e", "ekf-replay,smoother"), "demo/runs/smoother"),
    (("demo", "-o", "demo"), "demo/recording"),
    (("study", "drive.jsonl", "-o", "demo"), "demo/settings.yaml"),
    (("figure", "run", "-o", "figures"), "figures/arrivals.png"),
    (("figure", "run", "-o", "figures.pdf"), "figures.pdf"),
    (("report", "run", "-o", "report.html"), "report.html"),
    (("export", "run", "-o", "run.mcap"), "run.mcap"),
    (("export", "run", "-o", "ros2.mcap", "--ros2"), "ros2.mcap"),
    (("export", "run", "-o", "ros2", "--ros2"), "ros2"),
    (("export", "kitti_run", "-o", "0001.txt", "--kitti", "kitti/oxts/0001.txt"), "0001.txt"),
    (("tune", "noisy.jsonl", "-o", "tuned.yaml"), "tuned.yaml"),
    (("advise", "drive.jsonl", "-o", "advised.yaml"), "advised.yaml"),
    (("info", "drive.jsonl", "--write", "my.yaml"), "my.yaml"),
]
#: A sweep goes on where it was, and makes its tables anew.
ONGOING = [
    (("sweep", "sweep.yaml", "-o", "swept"), f"swept/{table}")
    for table in ("sweep.csv", "timing.csv", "errors.csv", "paired.csv", "summary.csv")
]


def test_every_command_with_an_output_is_in_the_table() -> None:
    tried: dict[str, set[str]] = {}
    for words, _ in (*WRITERS, *ONGOING):
        tried.setdefault(words[0], set()).update(words)
    for name in COMMANDS:
        parameters = _command(name).params
        writes = {"out", "output", "overwrite"} & {each.name for each in parameters}
        writes |= {"-o", "--out", "--output"} & {option for each in parameters for option in each.opts}
        assert bool(writes) == (name in tried), name
        kinds = [each for each in parameters if (getattr(each, "help", None) or "").startswith("Write ")]
        assert not [each for each in kinds if not set(each.opts) & tried.get(name, set())], name


@pytest.mark.parametrize(("words", "place"), WRITERS, ids=str)
def test_what_exists_is_refused_at_once_and_replaced_with_overwrite(
    here: Path, call: Call, words: tuple[str, ...], place: str
) -> None:
    flag = {"-o", "--write"}.intersection(words)
    out = words[words.index(*flag) + 1] if flag else words[2]
    own = here / place
    if own.is_dir():
        own = min(file for file in own.iterdir() if file.is_file())
    if own.exists():
        own.write_bytes(own.read_bytes() + b"\n")  # so that the same is not made again
    before = content(here)
    code, error = call(*words)
    assert code == 2
    assert f"{out}" in error
    assert "--overwrite" in error
    assert content(here) == before
    assert call(*words, "--overwrite")[0] == 0
    after = content(here)
    assert after.get(str(own)) != before.get(str(own), b"")
    assert {name: data for name, data in after.items() if not name.startswith(str(here / out))} == {
        name: data for name, data in before.items() if not name.startswith(str(here / out))
    }
    assert not [name for name in after if "part" in name]


@pytest.mark.parametrize("more", [(), ("--overwrite",)], ids=["new", "overwrite"])
@pytest.mark.parametrize(("words", "place"), [*WRITERS, *ONGOING], ids=str)
def test_what_another_program_wrote_is_never_replaced(
    here: Path, call: Call, words: tuple[str, ...], place: str, more: tuple[str, ...]
) -> None:
    theirs = here / place
    if theirs.exists():
        theirs.rename(here / "old")
    for thesis in (
        (theirs,) if theirs.suffix == ".pdf" else (theirs, theirs / "thesis")
    ):  # a folder x.pdf takes pictures
        thesis.parent.mkdir(parents=True, exist_ok=True)
        thesis.write_bytes(OTHERS.get(theirs.suffix, b"years of work"))
        before = content(here)
        code, error = call(*words, *more)
        assert code == 2
        assert place in error or not more
        assert content(here) == before
        thesis.unlink()


@pytest.mark.parametrize("name", ["notes.txt", "more/notes.txt"])
def test_a_recording_with_something_else_in_its_folder_is_not_replaced(here: Path, call: Call, name: str) -> None:
    (here / "bag" / name).parent.mkdir(exist_ok=True)
    (here / "bag" / name).write_text("why")
    before = content(here)
    assert call("convert", "drive.jsonl", "bag", "--overwrite")[0] == 2
    assert content(here) == before


def test_a_folder_of_recordings_by_themselves_is_no_recording_to_replace(here: Path, call: Call) -> None:
    """Only what a metadata.yaml lists belongs together."""
    for folder in ("mine", "more", "damaged"):
        shutil.copytree("bag", folder)
    (storage,) = Path("bag").glob("*.mcap")
    Path("mine/metadata.yaml").unlink()
    shutil.copy(storage, "mine/monday.mcap")
    shutil.copy(storage, "more/monday.mcap")
    Path("damaged/metadata.yaml").write_text("rosbag2_bagfile_information: [")
    before = content(here)
    for folder in ("mine", "more", "damaged"):
        for words in (("convert", "drive.jsonl", folder), ("simulate", "default", "--duration", "1", "-o", folder)):
            code, error = call(*words, "--overwrite")
            assert code == 2
            assert f"{folder}: exists and is not a rosbag2 folder" in error
    assert content(here) == before


#: Tables of a recording that have the names of tables of a run.
TABLES = {"ego.csv": "t,x,y\n", "truth.csv": "t,id,x,y\n", "detections.csv": "t,x,y\n", "config.yaml": "input: {}\n"}


def test_a_recording_of_tables_is_no_run_to_replace(here: Path, call: Call) -> None:
    """Nor is one with the header of a table that a run has too."""
    header = Path("run/ego.csv").read_text().partition("\n")[0]
    for folder, text in (("tables", TABLES["ego.csv"]), ("copied", f"{header}\n")):
        Path(folder).mkdir()
        for name, other in TABLES.items():
            Path(folder, name).write_text(text if name == "ego.csv" else other)
    shutil.copytree("copied", "all_copied")
    for name in ("truth.csv", "detections.csv"):
        Path("all_copied", name).write_text(",".join(COLUMNS[name.removesuffix(".csv")]) + "\n")
    before = content(here)
    for folder in ("tables", "copied", "all_copied"):
        code, error = call("replay", "drive.jsonl", "-o", folder, "--overwrite")
        assert code == 2
        assert f"{folder}: exists and is not a run folder" in error
    assert content(here) == before


def test_a_table_of_somebody_in_a_run_folder_is_not_removed(here: Path, call: Call) -> None:
    Path("run/ego.csv").write_text(TABLES["ego.csv"])
    before = content(here)
    code, error = call("replay", "drive.jsonl", "-o", "run", "--overwrite")
    assert code == 2
    assert "run/ego.csv: is not what a run has there, move it away" in error
    assert content(here) == before


def test_what_cannot_be_replaced_leaves_the_old_run_whole(here: Path, call: Call) -> None:
    Path("run/lagged.csv").unlink(missing_ok=True)
    Path("run/lagged.csv").mkdir()
    before = content(here)
    assert call("replay", "drive.jsonl", "-o", "run", "--overwrite")[0] == 2
    assert content(here) == before
    Path("run/lagged.csv").rmdir()
    with RunWriter("run", overwrite=True) as writer:
        Path("run/lagged.csv").mkdir()  # in the last moment
        with pytest.raises(CallError, match=r"run/lagged\.csv: cannot be written"):
            writer.write_tick(TickReport(0, 1, (), ()), 1, 0)
    assert content(here) == before


def test_a_disk_that_is_full_when_a_run_begins_leaves_the_old_run_whole(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, rename = content(here), os.rename

    def full(source: Path, target: Path) -> None:
        if Path(source).parent.name == "new" and Path(source).name == "config.yaml":
            raise OSError(errno.ENOSPC, "No space left on device")
        rename(source, target)

    monkeypatch.setattr(os, "rename", full)
    with RunWriter("run", overwrite=True) as writer, pytest.raises(DataError, match="free some space"):
        writer.write_tick(TickReport(0, 1, (), ()), 1, 0)
    assert content(here) == before


#: Files of somebody that hold the words by which an output is known, but not where that has them.
LOOKALIKES = {
    "figures.pdf": [b"notes on fgtrack figure\n", b"%PDF-1.7\n(fgtrack figure)\nstartxref\n9\n%%EOF\n", b"%PDF-1.7"],
    "figures/arrivals.png": [b"fgtrack figure", b"\x89PNG\r\n\x1a\n tEXtComment\0fgtrack figure"],
    "report.html": [b'see <meta name="generator" content="fgtrack 1">', b"<!DOCTYPE html>" + b" " * 2000 + b"fgtrack "],
    "ros2.mcap": [b"fgtrack export", b"\x89MCAP0\r\n made_by: fgtrack export"],
    "run.mcap": [b"\x89MCAP0\r\n fgtrack"],
    "0001.txt": [
        b"\nmy notes\n",
        b"0 0 Car 0 0 -1.570000 1 1 1 1 1 1 1 1 1 1 1 1\n",
        b"0 1 Car -1 -1 0.1 1.0 1.0 1.0 1.0 1.0 1.0 1.0 1.0 1.0 1.0 1.0 1.0\n",
        b"0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17\n",
    ],
}


@pytest.mark.parametrize(("words", "place"), [one for one in WRITERS if one[1] in LOOKALIKES], ids=str)
def test_an_output_is_known_by_its_form_not_by_a_word_in_it(
    here: Path, call: Call, words: tuple[str, ...], place: str
) -> None:
    for text in LOOKALIKES[place]:
        Path(place).write_bytes(text)
        before = content(here)
        assert call(*words, "--overwrite")[0] == 2, text
        assert content(here) == before


@pytest.mark.parametrize(("words", "place"), [one for one in WRITERS if one[1] in LOOKALIKES], ids=str)
def test_a_large_file_in_place_of_an_output_is_not_read(
    here: Path, call: Call, words: tuple[str, ...], place: str
) -> None:
    Path(place).unlink()
    with Path(place).open("wb") as file:
        file.write(OTHERS.get(Path(place).suffix, b"0 "))
        file.truncate(100_000_000)
    tracemalloc.start()
    try:
        assert call(*words)[0] == 2
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("form", ["png", "svg", "pdf"])
def test_figures_of_every_form_are_known_again(tmp_path: Path, form: str) -> None:
    figure = Figure()
    figure.subplots().plot([0.0, 1.0])
    assert DRAWN.recognises(save(figure, tmp_path / f"x.{form}"))


def test_what_was_private_stays_private(here: Path, call: Call) -> None:
    """Permissions are those of what is replaced."""
    Path("empty").mkdir(mode=0o700)
    modes = {"empty": 0o700, "bag": 0o750, "other.jsonl": 0o600, "run/tracks.csv": 0o600, "run/metrics.json": 0o640}
    assert call("compare", "run")[0] == 0
    (storage,) = Path("bag").glob("*.mcap")
    modes |= {str(storage): 0o600, "report.html": 0o600, "figures/arrivals.png": 0o600}
    for name, mode in modes.items():
        Path(name).chmod(mode)
    for words in (
        ("convert", "drive.jsonl", "empty"),
        ("convert", "drive.jsonl", "bag", "--overwrite"),
        ("convert", "drive.jsonl", "other.jsonl", "--overwrite"),
        ("compare", "run"),
        ("replay", "drive.jsonl", "-o", "run", "--overwrite"),
        ("report", "run", "-o", "report.html", "--overwrite"),
        ("figure", "run", "-o", "figures", "--overwrite"),
    ):
        assert call(*words)[0] == 0
        if words[0] == "compare":
            assert Path("run/metrics.json").stat().st_mode & 0o777 == modes.pop("run/metrics.json")
    assert {name: oct(Path(name).stat().st_mode & 0o777) for name in modes} == {
        name: oct(mode) for name, mode in modes.items()
    }


def test_other_files_beside_a_run_stay(here: Path, call: Call) -> None:
    (here / "run/notes.txt").write_text("why")
    assert call("replay", "drive.jsonl", "-o", "run", "--overwrite")[0] == 0
    assert (here / "run/notes.txt").read_text() == "why"
    assert load_run("run").meta["input"] == {"path": "drive.jsonl", "kind": "stream", "path_from_run": "../drive.jsonl"}


HEADER = '{"type": "header", "format": "fgtrack-stream/1"}\n'
TRUTH = '{"type": "truth", "stamp_ns": 1, "receipt_ns": 1, "object_id": 1, "x_m": 0, "y_m": 0}\n'


@pytest.mark.parametrize("text", ['{"type": "ego"}\n', "", HEADER + '{"ty', HEADER + TRUTH, HEADER + TRUTH + "{}\n"])
def test_an_input_that_gives_nothing_leaves_the_old_run(here: Path, call: Call, text: str) -> None:
    Path("bad.jsonl").write_text(text)
    before = content(here / "run")
    code, error = call("replay", "bad.jsonl", "-o", "run", "--overwrite")
    assert code == 1
    assert "bad.jsonl" in error
    assert content(here / "run") == before
    assert call("replay", "bad.jsonl", "-o", "new/run")[0] == 1
    assert not (here / "new").exists()


def test_a_run_that_fails_before_its_first_tick_leaves_the_old_one(here: Path, call: Call) -> None:
    write_stream("sonar.jsonl", [DetectionList("sonar", START_NS, START_NS, (Detection(x_m=1.0, y_m=2.0),))])
    before = content(here / "run")
    assert call("replay", "sonar.jsonl", "-c", "smoother", "-o", "run", "--overwrite")[0] == 1
    assert content(here / "run") == before


def test_nothing_is_replayed_where_one_of_several_folders_is_in_use(here: Path, call: Call) -> None:
    Path("runs/smoother").mkdir(parents=True)
    Path("runs/smoother/thesis").write_text("x")
    assert call("replay", "drive.jsonl", "-o", "runs", "-e", "ekf-replay,smoother")[0] == 2
    assert os.listdir("runs") == ["smoother"]


def test_two_runs_into_one_folder_do_not_mix(here: Path, call: Call) -> None:
    with RunWriter("run", overwrite=True) as first:
        before = content(here / "run")
        code, error = call("replay", "drive.jsonl", "-o", "run", "--overwrite")
        assert (code, content(here / "run")) == (2, before)
        assert "another command is writing there" in error
    assert call("replay", "drive.jsonl", "-o", str(first.path), "--overwrite")[0] == 0  # it has let go


def test_what_appears_in_the_folder_of_a_new_run_is_not_replaced(here: Path) -> None:
    with RunWriter("new") as writer:
        Path("new/tracks.csv").symlink_to(here / "drive.jsonl")
        before = content(here)
        with pytest.raises(CallError, match=r"new/tracks\.csv: cannot be written"):
            writer.write_tick(TickReport(0, 1, (), ()), 1, 0)
    assert {name: data for name, data in content(here).items() if name in before} == before


def test_a_replay_that_is_under_way_holds_all_its_folders(here: Path) -> None:
    folders = {name: Path("runs") / name for name in ("ekf-replay", "smoother")}

    def messages() -> Iterator[Message]:
        yield from drive(5)
        for folder in folders.values():
            with pytest.raises(CallError, match="another command is writing there"):
                RunWriter(folder, overwrite=True)
        yield from drive(10)[10:]

    assert len(replay_each(messages, paper(), folders)) == 2


def test_a_sweep_does_not_share_its_folder(here: Path, call: Call) -> None:
    Path("sweep.yaml").write_text(SWEEP)
    with claimed(Path("swept")):
        assert "another command is writing there" in call("sweep", "sweep.yaml", "-o", "swept")[1]


#: Commands whose output is an input, holds one or lies in one, and which.
TANGLED = [
    (("convert", "drive.jsonl", "./drive.jsonl"), "drive.jsonl"),
    (("convert", "drive.jsonl", "same"), "drive.jsonl"),
    (("convert", "bag", "bag"), "bag"),
    (("convert", "bag/bag.mcap", "bag"), "bag/bag.mcap"),
    (("convert", "bag", "bag/new.jsonl"), "bag"),
    (("convert", "drive.jsonl", "other.jsonl", "--delays", "other.jsonl"), "other.jsonl"),
    (("simulate", "more/scenario.yaml", "-o", "more"), "more/scenario.yaml"),
    (("simulate", "more/scenario.yaml", "-o", "more/scenario.yaml"), "more/scenario.yaml"),
    (("replay", "run/drive.jsonl", "-o", "run"), "run/drive.jsonl"),
    (("replay", "drive.jsonl", "-c", "run/config.yaml", "-o", "run"), "run/config.yaml"),
    (("replay", "bag", "-o", "bag/run"), "bag"),
    (("replay", "drive.jsonl", "--map", "run/map.csv", "-o", "run"), "run/map.csv"),
    (("replay", "drive.jsonl", "-e", "ekf-replay,smoother", "-o", "bag", "-c", "bag/smoother/x.yaml"), "bag/smoother"),
    (("replay", "tables/lidar.csv", "-c", "tables.yaml", "-o", "run"), "run/ego.csv"),
    (("figure", "run", "-o", "run"), "run"),
    (("figure", "run", "-o", "run/figures"), "run"),
    (("figure", "run", "-o", "run/figures.pdf"), "run"),
    (("report", "run", "-o", "run/report.html"), "run"),
    (("study", "bag", "-o", "bag"), "bag"),
    (("study", "demo/recording", "-c", "demo/settings.yaml", "-o", "demo"), "demo/settings.yaml"),
    (("report", "demo/runs", "-o", "demo/runs/smoother/report.html"), "demo/runs/smoother"),
    (("export", "run", "-o", "run/run.mcap"), "run"),
    (("export", "run", "-o", "run/ros2", "--ros2"), "run"),
    (("export", "kitti_run", "-o", "kitti/oxts/0001.txt", "--kitti", "kitti/oxts/0001.txt"), "kitti/oxts/0001.txt"),
    (("export", "kitti_run", "-o", "kitti_run/0001.txt", "--kitti", "kitti/oxts/0001.txt"), "kitti_run"),
    (("tune", "noisy.jsonl", "bag", "-o", "bag/tuned.yaml"), "bag"),
    (("tune", "noisy.jsonl", "-c", "tuned.yaml", "-o", "tuned.yaml"), "tuned.yaml"),
    (("advise", "bag", "-o", "bag/advised.yaml"), "bag"),
    (("advise", "drive.jsonl", "-c", "advised.yaml", "-o", "advised.yaml"), "advised.yaml"),
    (("info", "bag", "--write", "bag/my.yaml"), "bag"),
    (("sweep", "sweep.yaml", "--input", "bag", "-o", "bag"), "bag"),
    (("sweep", "sweep.yaml", "--input", "bag", "-o", "bag/swept"), "bag"),
    (("sweep", "swept/parts/sweep.yaml", "-o", "swept"), "swept/parts/sweep.yaml"),
]


@pytest.mark.parametrize(("words", "which"), TANGLED, ids=str)
def test_an_input_is_never_the_output(here: Path, call: Call, words: tuple[str, ...], which: str) -> None:
    Path("same").symlink_to("drive.jsonl")
    for folder in ("more", "swept/parts", "bag/smoother", "tables"):
        Path(folder).mkdir(parents=True)
    shutil.copy(SCENARIOS / "single_opponent.yaml", "more/scenario.yaml")
    shutil.copy("drive.jsonl", "run/drive.jsonl")
    shutil.copy("sweep.yaml", "swept/parts/sweep.yaml")
    Path("bag/smoother/x.yaml").write_text("")
    make_oval().write(Path("run/map.csv"))
    Path("tables/lidar.csv").write_text("t,x,y\n1,2,3\n")
    columns = {"stamp_ns": "t", "x_m": "x", "y_m": "y"}
    csv = {"detections": {"lidar": {"columns": columns}}, "ego": {"file": "../run/ego.csv", "columns": columns}}
    Path("tables.yaml").write_text(json.dumps({"input": {"csv": csv}}))
    if which.startswith("bag/smoother"):
        shutil.rmtree("demo")
    elif words[0] != "sweep" and "bag" in words:
        shutil.rmtree("bag/smoother")  # which belongs to no recording
    before = content(here)
    code, error = call(*words, *(() if words[0] == "sweep" else ("--overwrite",)))
    assert code == 2
    assert "is the input or holds it" in error or "lies in the input" in error
    assert which in error
    assert content(here) == before


def test_every_command_with_an_input_and_an_output_is_in_that_table() -> None:
    without = {"demo"}  # reads what it has written
    assert {words[0] for words, _ in TANGLED} == {words[0] for words, _ in (*WRITERS, *ONGOING)} - without


def test_a_folder_of_runs_may_hold_what_is_made_of_them(here: Path, call: Call) -> None:
    """What else is in a shared folder stays, so pictures and tables may lie beside what they are made of."""
    assert call("report", "demo/runs", "-o", "demo/runs/report.html")[0] == 0
    assert call("figure", "run", "-o", ".")[0] == 0
    Path("swept").mkdir()
    shutil.copy("sweep.yaml", "swept")
    assert call("sweep", "swept/sweep.yaml", "--input", "drive.jsonl", "-o", "swept", "--jobs", "1")[0] == 0


@pytest.mark.parametrize("command", ["replay", "tune", "advise"])
def test_a_pit_lane_without_a_track_is_a_bad_call(here: Path, call: Call, command: str) -> None:
    out = {"replay": "new", "tune": "new.yaml", "advise": "new.yaml"}[command]
    before = content(here)
    for pit in ("nope.csv", "oval"):
        code, error = call(command, "noisy.jsonl", "--pit-map", pit, "-o", out)
        assert code == 2
        assert f"{pit}: a pit lane (map.pit) needs the map of its track" in error
    assert content(here) == before


def test_links_are_not_followed(here: Path, call: Call) -> None:
    Path("precious").write_text("years of work")
    Path("link.jsonl").symlink_to("precious")
    Path("link").symlink_to("bag")
    for words in (("link.jsonl",), ("link",)):
        assert call("convert", "drive.jsonl", *words, "--overwrite")[0] == 2
    (here / "run/tracks.csv").unlink()
    (here / "run/tracks.csv").symlink_to(here / "precious")
    (here / "run/meta.json.part").symlink_to(here / "precious")
    assert call("replay", "drive.jsonl", "-o", "run", "--overwrite")[0] == 0
    assert Path("precious").read_text() == "years of work"
    assert load_run("run").tracks["tick"].size


def test_part_files_of_others_stay(here: Path, call: Call) -> None:
    for name in ("new.jsonl.part", "newbag.part", "run/meta.json.part", "run/metrics.json.part"):
        Path(name).write_text("mine")
    assert call("convert", "drive.jsonl", "new.jsonl")[0] == 0
    assert call("convert", "drive.jsonl", "newbag")[0] == 0
    assert call("replay", "drive.jsonl", "-o", "run", "--overwrite")[0] == 0
    assert call("compare", "run")[0] == 0
    for name in ("new.jsonl.part", "newbag.part", "run/meta.json.part", "run/metrics.json.part"):
        assert Path(name).read_text() == "mine"


@pytest.mark.parametrize("overwrite", [False, True])
def test_what_appears_while_a_recording_is_written_is_not_replaced(here: Path, overwrite: bool) -> None:
    def messages(file: Path) -> Iterator[Message]:
        yield from drive(5)
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")

    with pytest.raises(CallError, match=r"new\.jsonl"):
        write_stream("new.jsonl", messages(Path("new.jsonl")), overwrite=overwrite)
    assert Path("new.jsonl").read_text() == "mine"
    with pytest.raises(CallError, match="newbag"):
        write_bag("newbag", messages(Path("newbag/mine")), overwrite=overwrite)
    assert os.listdir("newbag") == ["mine"]
    assert not list(here.glob("*.part"))


@pytest.mark.parametrize(("write", "out"), [(write_stream, "other.jsonl"), (write_bag, "bag")])
def test_no_message_is_read_for_an_output_that_is_refused(here: Path, write: Callable[..., int], out: str) -> None:
    messages = iter(drive(5))
    with pytest.raises(CallError, match=f"{out}: already exists"):
        write(out, messages)
    assert len(list(messages)) == 10


def test_what_appears_at_the_last_moment_is_not_replaced(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(output, "check_output", lambda *_: None)
    before = content(here)
    with pytest.raises(CallError, match=r"other\.jsonl: cannot be written"):
        write_stream("other.jsonl", drive(5))
    with pytest.raises(CallError, match="bag: cannot be written"):
        write_bag("bag", drive(5))
    assert content(here) == before


def test_an_error_while_writing_keeps_the_old_recording(here: Path) -> None:
    def failing() -> Iterator[Message]:
        yield from drive(5)
        raise RuntimeError("broken")

    before = content(here)
    with pytest.raises(RuntimeError, match="broken"):
        write_stream("other.jsonl", failing(), overwrite=True)
    with pytest.raises(DataError, match="broken"):
        write_bag("bag", failing(), overwrite=True)
    assert content(here) == before


def test_an_input_that_breaks_at_once_keeps_the_old_recording(here: Path) -> None:
    def failing() -> Iterator[Message]:
        raise DataError("broken")
        yield

    before = content(here)
    for write, out in ((write_stream, "other.jsonl"), (write_bag, "bag")):
        with pytest.raises(DataError, match="broken"):
            write(out, failing(), overwrite=True)
    assert content(here) == before


def test_of_an_input_that_breaks_off_what_came_before_is_written(here: Path) -> None:
    def failing() -> Iterator[Message]:
        yield from drive(5)
        raise DataError("broken")

    for write, out in ((write_stream, "new.jsonl"), (write_bag, "new")):
        with pytest.raises(DataError, match=r"broken$"):
            write(out, failing(), overwrite=True)
        assert list(open_input(here / out).messages()) == drive(5)


def test_a_file_has_the_usual_permissions(here: Path) -> None:
    Path("plain").write_text("")
    write_file(Path("written"), "x")
    assert [oct(Path(name).stat().st_mode) for name in ("written", "drive.jsonl")] == [
        oct(Path("plain").stat().st_mode)
    ] * 2


def test_figures_are_replaced_all_or_none(here: Path, call: Call) -> None:
    figures = sorted(Path("figures").iterdir())
    assert call("figure", "run", "-o", "figures")[0] == 0  # they would be the same
    figures[-1].write_bytes(figures[-1].read_bytes() + b"x")
    figures[0].unlink()
    before = content(Path("figures"))
    code, error = call("figure", "run", "-o", "figures")
    assert code == 2
    assert f"{figures[-1]}: already exists" in error
    assert content(Path("figures")) == before
    assert call("figure", "run", "-o", "figures", "--overwrite")[0] == 0
    assert sorted(Path("figures").iterdir()) == figures
    figures[0].write_text("my own drawing")
    assert call("figure", "run", "-o", "figures", "--overwrite")[0] == 2
    assert figures[0].read_text() == "my own drawing"


def test_an_output_that_cannot_be_written_is_a_bad_call_everywhere(here: Path, call: Call) -> None:
    Path("file").write_text("")
    Path("sweep.yaml").write_text(SWEEP)
    for words in (
        ("simulate", "default", "--duration", "1", "-o", "file/x.jsonl"),
        ("simulate", "default", "--duration", "1", "-o", "file/x"),
        ("convert", "drive.jsonl", "file/x.jsonl"),
        ("replay", "drive.jsonl", "-o", "file/x"),
        ("figure", "run", "-o", "file/x"),
        ("figure", "run", "-o", "file/x.pdf"),
        ("report", "run", "-o", "file/x.html"),
        ("export", "run", "-o", "file/x.mcap"),
        ("export", "run", "-o", "file/x", "--ros2"),
        ("tune", "drive.jsonl", "-o", "file/x.yaml"),
        ("advise", "drive.jsonl", "-o", "file/x.yaml"),
        ("sweep", "sweep.yaml", "-o", "file/x"),
        ("demo", "-o", "file/x"),
        ("study", "drive.jsonl", "-o", "file/x"),
    ):
        code, error = call(*words)
        assert code == 2, words
        assert "file/x" in error


def test_two_replays_at_once_into_one_folder_are_one_run_and_one_refusal(here: Path) -> None:
    write_stream("long.jsonl", drive(1500))
    words = [sys.executable, "-m", "fgtrack", "replay", "long.jsonl", "-o", "both", "--overwrite"]
    both = [subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) for _ in range(2)]
    errors = [one.communicate(timeout=120)[1] for one in both]
    refused = [error for one, error in zip(both, errors, strict=True) if one.returncode == 2]
    assert all("another command is writing there" in error for error in refused)
    assert sorted(one.returncode for one in both) in ([0, 2], [0, 0])  # where the second began after the first
    run = load_run("both")
    assert run.meta["complete"] is True
    assert digest(Path("both")) == run.meta["digest"]
    assert run.updates.num_rows == 1500


def test_a_folder_of_parts_of_another_program_is_no_sweep(here: Path, call: Call) -> None:
    Path("sweep.yaml").write_text(SWEEP)
    Path("swept/parts").mkdir(parents=True)
    Path("swept/parts/wheel.json").write_text('{"format": "parts of a car"}')
    Path("swept/sweep.csv").write_text("mine")
    before = content(Path("swept"))
    code, error = call("sweep", "sweep.yaml", "-o", "swept")
    assert code == 2
    assert "swept/sweep.csv: exists and is not a table of a sweep" in error
    assert content(Path("swept")) == before


def test_a_run_that_cannot_be_written_to_is_compared_with_a_warning(
    here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(["compare", "run", "--json"]) == 0
    tables = json.loads(capfd.readouterr().out)
    Path("run/metrics.json").unlink()
    Path("run/metrics.json").mkdir()  # as in a folder that may only be read, for root too
    before = content(here)
    assert run(["compare", "run", "--json"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out) == tables
    [line] = [line for line in said.err.splitlines() if "metrics.json" in line]
    assert line.startswith("fgtrack: warning: run/metrics.json: cannot be written")
    assert content(here) == before


def test_compare_tells_a_run_whose_tables_were_changed(here: Path, capfd: pytest.CaptureFixture[str]) -> None:
    rows = Path("run/updates.csv").read_text().splitlines(keepends=True)
    Path("run/updates.csv").write_text("".join(rows[:-1]))
    assert run(["compare", "run"]) == 0
    assert "the digest is another; repeat the run" in capfd.readouterr().err


#: What is no file, and would be waited for or read for ever.
ENDLESS: dict[str, Callable[[str], None]] = {
    "pipe": os.mkfifo,
    "device": lambda path: os.symlink("/dev/zero", path),
}


@contextmanager
def at_once() -> Iterator[None]:
    """What is done here waits for nobody."""

    def waits(*_: object) -> None:
        pytest.fail("waits for the pipe, or reads the device for ever")

    before = signal.signal(signal.SIGALRM, waits)
    signal.alarm(60)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("make", ENDLESS.values(), ids=ENDLESS)
@pytest.mark.parametrize(
    "words",
    [
        ("info", "endless.jsonl"),
        ("info", "endless_bag"),
        ("replay", "endless.jsonl", "-o", "new"),
        ("convert", "endless.jsonl", "new.jsonl"),
        ("config", "-c", "endless.jsonl"),
        ("replay", "drive.jsonl", "-c", "endless.jsonl", "-o", "new"),
        ("replay", "drive.jsonl", "--map", "endless.jsonl", "-o", "new"),
        ("replay", "drive.jsonl", "--set", "map.excluded=[endless.jsonl]", "-o", "new"),
        ("replay", "bag", "-c", "definitions_of_endless.yaml", "-o", "new"),
        ("convert", "drive.jsonl", "new.jsonl", "--delays", "endless.jsonl"),
        ("simulate", "endless.jsonl", "-o", "new.jsonl"),
        ("simulate", "scenario_with_map_of_endless.yaml", "-o", "new.jsonl"),
        ("sweep", "endless.jsonl", "-o", "new"),
        ("compare", "endless.jsonl"),
        *(("compare", f"run_of_endless/{name}") for name in ("meta.json", "config.yaml", "tracks.csv", "truth.csv")),
    ],
    ids=str,
)
def test_what_has_no_end_in_place_of_a_file_is_one_line_at_once(
    here: Path, capfd: pytest.CaptureFixture[str], words: tuple[str, ...], make: Callable[[str], None]
) -> None:
    make("endless.jsonl")
    Path("endless_bag").mkdir()
    make("endless_bag/a.mcap")
    Path("definitions_of_endless.yaml").write_text("input: {message_definitions: [endless.jsonl]}\n")
    scenario = dump(replace(read_scenario("default"), map="endless.jsonl"))
    Path("scenario_with_map_of_endless.yaml").write_text(scenario)
    if words[1].startswith("run_of_endless/"):
        folder, name = Path(words[1]).parent, Path(words[1]).name
        shutil.copytree("run", folder)
        (folder / name).unlink(missing_ok=True)
        make(str(folder / name))
        words = ("compare", str(folder))
    with at_once():
        assert run(words) in (1, 2)
    [line] = capfd.readouterr().err.splitlines()
    assert "endless" in line
    assert "internal error" not in line
    assert not Path("new").exists()


@pytest.mark.parametrize("make", ENDLESS.values(), ids=ENDLESS)
def test_what_has_no_end_in_the_configuration_of_a_run_is_a_reason_to_leave_out_its_close_up(
    here: Path, make: Callable[[str], None]
) -> None:
    make("endless.jsonl")
    config = Path("run/config.yaml")
    config.write_text(config.read_text().replace("excluded: []", "excluded: [endless.jsonl]"))
    assert "endless.jsonl" in config.read_text()
    with at_once(), pytest.raises(DataError, match=r"endless\.jsonl: .* so no close-up"):
        close_up_of(load_run("run"), Arrival("lidar", START_NS, START_NS, 0))


@pytest.mark.parametrize("make", ENDLESS.values(), ids=ENDLESS)
def test_a_part_of_a_sweep_that_has_no_end_is_one_line_at_once(
    here: Path, call: Call, make: Callable[[str], None]
) -> None:
    [job] = load_plan(Path("sweep.yaml")).jobs
    Path("swept/parts").mkdir(parents=True)
    make(f"swept/parts/{job.key}.json")
    with at_once():
        code, error = call("sweep", "sweep.yaml", "-o", "swept")
    assert code == 1
    assert f"{job.key}.json: cannot be read" in error


def test_a_full_disk_is_no_fault_of_the_call(here: Path) -> None:
    with pytest.raises(DataError, match="free some space"), new_file(Path("new.jsonl"), STREAM, False):
        raise OSError(28, "No space left on device")
    assert not list(here.glob("new*"))


def test_a_file_system_without_links_takes_files(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link(source: Path, target: Path) -> None:
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    monkeypatch.setattr(os, "link", link)
    with new_file(Path("new.jsonl"), STREAM, False) as file:
        file.write(b"{}")
    assert Path("new.jsonl").read_bytes() == b"{}"
    assert not list(here.glob("new*.part"))


def test_what_is_left_of_a_run_that_was_killed_at_its_beginning_can_be_replaced(here: Path, call: Call) -> None:
    (here / "run/meta.json").unlink()
    assert call("replay", "drive.jsonl", "-o", "run")[0] == 2
    assert call("replay", "drive.jsonl", "-o", "run", "--overwrite")[0] == 0
    assert json.loads(Path("run/meta.json").read_text())["complete"] is True


def test_a_stream_replaces_a_stream_at_once(here: Path) -> None:
    """Whoever reads the old one while the new one is written reads the old one to its end."""
    reader = read_stream("other.jsonl")
    first = next(reader)
    write_stream("other.jsonl", drive(), overwrite=True)
    assert [first, *reader] == drive(10)
    assert list(read_stream("other.jsonl")) == drive()
