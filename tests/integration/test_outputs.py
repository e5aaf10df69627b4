"""What a command did not make it neither removes nor replaces."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import kitti
from support.messages import START_NS, standing
from support.paper import paper
from support.pictures import with_blank_pictures

from fgtrack.cli import study
from fgtrack.cli.main import COMMANDS, _command, run
from fgtrack.config.shipped import shipped_folder
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.source import open_input
from fgtrack.inputs.stream import write_stream
from fgtrack.pipeline.replay import replay
from fgtrack.runs import RunWriter, load_run
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate

MS = 1_000_000
SWEEP = (
    "format: fgtrack-sweep/1\nscenario: default\nestimators: [ekf-replay]\nseeds: 1\n"
)

SCENARIOS = shipped_folder() / "scenarios"

Call = Callable[..., tuple[int, str]]


def noisy(count: int = 120) -> list[Message]:
    """The same without yaws, with noise that can be fitted."""
    rng, messages = np.random.default_rng(1), list[Message]()
    for k in range(count):
        now_ns, (x_m, y_m) = START_NS + k * 50 * MS, rng.normal((20.0, 1.0), 0.5)
        messages.append(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        messages.append(
            DetectionList("lidar", now_ns, now_ns, (Detection(x_m=x_m, y_m=y_m),))
        )
    return messages


def one_second(scenario: Scenario, rng: np.random.Generator) -> Iterator[Message]:
    """The first second of a simulated race."""
    yield from simulate(replace(scenario, duration_s=1.0), rng)


def content(path: Path) -> dict[str, bytes | None]:
    """Every file below `path` with its bytes, and every folder."""
    below = [path, *sorted(path.rglob("*"))]
    return {
        str(item): item.read_bytes() if item.is_file() else None
        for item in below
        if os.path.lexists(item)
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with recordings, runs, and what every command makes of them."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(study, "simulated", one_second)
        with_blank_pictures(patch)
        write_stream("drive.jsonl", standing(30))
        write_stream("noisy.jsonl", noisy())
        write_stream("other.jsonl", standing(10))
        write_bag("bag", standing(10))
        seen = [kitti.pose(frame, 20.0, 3.0, 0.0) for frame in range(30)]
        kitti.folder(
            folder / "kitti", oxts=[kitti.oxts(speed_mps=10.0)] * 30, pointrcnn_car=seen
        )
        Path("sweep.yaml").write_text(SWEEP)
        for words in (
            ("replay", "other.jsonl", "-o", "run"),
            ("replay", "kitti/oxts/0001.txt", "-o", "kitti_run"),
            ("demo", "-o", "demo"),
            *(
                words
                for words, out in WRITERS
                if words[0] in ("figure", "export", "info", "rank")
                and not out.endswith(".pdf")
            ),
        ):
            assert run(list(words)) == 0
        # Any file stands for what the slow commands make.
        names = "report.html", "tuned.yaml", "advised.yaml", "ledger.png", "figures.pdf"
        for name in names:
            Path(name).write_text("# before\n")
    return folder


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, a copy of that one; figures are copied, not drawn."""
    folder = shutil.copytree(made, tmp_path / "here")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(study, "simulated", one_second)
    with_blank_pictures(monkeypatch)

    def redraw(named: object, folder: Path, form: str) -> list[Path]:
        return [
            Path(shutil.copy(picture, folder))
            for picture in sorted((made / "figures").iterdir())
        ]

    monkeypatch.setattr("fgtrack.cli.pictures.save_named", redraw)
    monkeypatch.setattr(
        "fgtrack.cli.pictures.save_pages",
        lambda figures, file: file.write((made / "figures.pdf").read_bytes()),
    )
    return folder


@pytest.fixture
def call(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[Call]:
    """Runs a command; gives its exit code and the line on stderr."""

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
    (
        ("replay", "drive.jsonl", "-o", "demo/runs", "-e", "ekf-replay,smoother"),
        "demo/runs/smoother",
    ),
    (("demo", "-o", "demo"), "demo/recording"),
    (("study", "drive.jsonl", "-o", "demo"), "demo/settings.yaml"),
    (("figure", "run", "-o", "figures"), "figures/arrivals.png"),
    (("figure", "run", "-o", "figures.pdf"), "figures.pdf"),
    (("report", "run", "-o", "report.html"), "report.html"),
    (("export", "run", "-o", "run.mcap"), "run.mcap"),
    (("export", "run", "-o", "ros2.mcap", "--ros2"), "ros2.mcap"),
    (("export", "run", "-o", "ros2", "--ros2"), "ros2"),
    (
        ("export", "kitti_run", "-o", "0001.txt", "--kitti", "kitti/oxts/0001.txt"),
        "0001.txt",
    ),
    (("tune", "noisy.jsonl", "-o", "tuned.yaml"), "tuned.yaml"),
    (("advise", "drive.jsonl", "-o", "advised.yaml"), "advised.yaml"),
    (("info", "drive.jsonl", "--write", "my.yaml"), "my.yaml"),
    (("ledger", "noisy.jsonl", "--figure", "ledger.png"), "ledger.png"),
    (
        ("rank", "drop", "--scenario", "late-by-3", "--runs", "2", "-o", "ranking"),
        "ranking",
    ),
    (
        ("rank", "--export", "problems", "--scenario", "late-by-3"),
        "problems/late-by-3",
    ),
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
        writes |= {"-o", "--out", "--output"} & {
            option for each in parameters for option in each.opts
        }
        assert bool(writes) == (name in tried), name
        kinds = [
            each
            for each in parameters
            if (getattr(each, "help", None) or "").startswith("Write ")
        ]
        assert not [
            each for each in kinds if not set(each.opts) & tried.get(name, set())
        ], name


@pytest.mark.parametrize(("words", "place"), WRITERS, ids=str)
def test_what_exists_is_refused_at_once_and_replaced_with_overwrite(
    here: Path, call: Call, words: tuple[str, ...], place: str
) -> None:
    flag = {"-o", "--write", "--figure"}.intersection(words)
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
    assert {
        name: data
        for name, data in after.items()
        if not name.startswith(str(here / out))
    } == {
        name: data
        for name, data in before.items()
        if not name.startswith(str(here / out))
    }
    assert not [name for name in after if "part" in name]


def test_a_recording_with_something_else_in_its_folder_is_not_replaced(
    here: Path, call: Call
) -> None:
    (here / "bag/notes.txt").write_text("why")
    before = content(here)
    assert call("convert", "drive.jsonl", "bag", "--overwrite")[0] == 2
    assert content(here) == before


def test_other_files_beside_a_run_stay(here: Path, call: Call) -> None:
    (here / "run/notes.txt").write_text("why")
    assert call("replay", "drive.jsonl", "-o", "run", "--overwrite")[0] == 0
    assert (here / "run/notes.txt").read_text() == "why"
    assert load_run("run").meta["input"] == {
        "path": "drive.jsonl",
        "kind": "stream",
        "path_from_run": "../drive.jsonl",
    }


HEADER = '{"type": "header", "format": "fgtrack-stream/1"}\n'
TRUTH = '{"type": "truth", "stamp_ns": 1, "receipt_ns": 1, "object_id": 1, "x_m": 0, "y_m": 0}\n'


@pytest.mark.parametrize(
    "text",
    ['{"type": "ego"}\n', "", HEADER + '{"ty', HEADER + TRUTH, HEADER + TRUTH + "{}\n"],
)
def test_an_input_that_gives_nothing_leaves_the_old_run(
    here: Path, call: Call, text: str
) -> None:
    Path("bad.jsonl").write_text(text)
    before = content(here / "run")
    code, error = call("replay", "bad.jsonl", "-o", "run", "--overwrite")
    assert code == 1
    assert "bad.jsonl" in error
    assert content(here / "run") == before
    assert call("replay", "bad.jsonl", "-o", "new/run")[0] == 1
    assert not (here / "new").exists()


def test_nothing_is_replayed_where_one_of_several_folders_is_in_use(
    here: Path, call: Call
) -> None:
    Path("runs/smoother").mkdir(parents=True)
    Path("runs/smoother/thesis").write_text("x")
    assert (
        call("replay", "drive.jsonl", "-o", "runs", "-e", "ekf-replay,smoother")[0] == 2
    )
    assert os.listdir("runs") == ["smoother"]


def test_a_replay_that_is_under_way_holds_all_its_folders(here: Path) -> None:
    folders = {name: Path("runs") / name for name in ("ekf-replay", "smoother")}

    def messages() -> Iterator[Message]:
        yield from standing(5)
        for folder in folders.values():
            with pytest.raises(CallError, match="another command is writing there"):
                RunWriter(folder, overwrite=True)
        yield from standing(10)[10:]

    assert len(replay(messages, paper(), folders)) == 2


#: Commands whose output is an input, holds one or lies in one, and which.
TANGLED = [
    (("convert", "drive.jsonl", "./drive.jsonl"), "drive.jsonl"),
    (("convert", "bag/bag.mcap", "bag"), "bag/bag.mcap"),
    (("simulate", "more/scenario.yaml", "-o", "more"), "more/scenario.yaml"),
    (
        ("replay", "drive.jsonl", "-c", "run/config.yaml", "-o", "run"),
        "run/config.yaml",
    ),
    (("replay", "bag", "-o", "bag/run"), "bag"),
    (("figure", "run", "-o", "run/figures"), "run"),
    (("report", "run", "-o", "run/report.html"), "run"),
    (
        ("study", "demo/recording", "-c", "demo/settings.yaml", "-o", "demo"),
        "demo/settings.yaml",
    ),
    (("export", "run", "-o", "run/run.mcap"), "run"),
    (
        (
            "export",
            "kitti_run",
            "-o",
            "kitti/oxts/0001.txt",
            "--kitti",
            "kitti/oxts/0001.txt",
        ),
        "kitti/oxts/0001.txt",
    ),
    (("tune", "noisy.jsonl", "-c", "tuned.yaml", "-o", "tuned.yaml"), "tuned.yaml"),
    (("sweep", "sweep.yaml", "--input", "bag", "-o", "bag"), "bag"),
]


@pytest.mark.parametrize(("words", "which"), TANGLED, ids=str)
def test_an_input_is_never_the_output(
    here: Path, call: Call, words: tuple[str, ...], which: str
) -> None:
    Path("more").mkdir()
    shutil.copy(SCENARIOS / "single_opponent.yaml", "more/scenario.yaml")
    before = content(here)
    code, error = call(*words, *(() if words[0] == "sweep" else ("--overwrite",)))
    assert code == 2
    assert "must not overlap the input" in error
    assert which in error
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
    assert load_run("run").tables["tracks"]["tick"].size


def test_what_appears_while_a_recording_is_written_is_not_replaced(here: Path) -> None:
    def messages(file: Path) -> Iterator[Message]:
        yield from standing(5)
        file.parent.mkdir(exist_ok=True)
        file.write_text("mine")

    with pytest.raises(CallError, match=r"new\.jsonl"):
        write_stream("new.jsonl", messages(Path("new.jsonl")))
    assert Path("new.jsonl").read_text() == "mine"
    with pytest.raises(CallError, match="newbag"):
        write_bag("newbag", messages(Path("newbag/mine")))
    assert os.listdir("newbag") == ["mine"]
    assert not list(here.glob("*.part"))


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


def test_an_output_that_cannot_be_written_is_a_bad_call_everywhere(
    here: Path, call: Call
) -> None:
    Path("file").write_text("")
    Path("sweep.yaml").write_text(SWEEP)
    for words, _ in [*WRITERS, *ONGOING[:1]]:
        flag = {"-o", "--write", "--figure"}.intersection(words)
        at = words.index(*flag) + 1 if flag else 2
        words = (*words[:at], f"file/x{Path(words[at]).suffix}", *words[at + 1 :])
        code, error = call(*words)
        assert code == 2, words
        assert "file/x" in error


def test_a_run_that_cannot_be_written_to_is_compared_with_a_warning(
    here: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run(["compare", "run", "--json"]) == 0
    tables = json.loads(capfd.readouterr().out)
    Path("run/metrics.json").unlink()
    Path(
        "run/metrics.json"
    ).mkdir()  # as in a folder that may only be read, for root too
    before = content(here)
    assert run(["compare", "run", "--json"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out) == tables
    [line] = [line for line in said.err.splitlines() if "metrics.json" in line]
    assert line.startswith("fgtrack: warning: run/metrics.json: cannot be written")
    assert content(here) == before


@pytest.mark.parametrize(
    ("write", "out"), [(write_stream, "other.jsonl"), (write_bag, "bag")]
)
def test_what_fails_while_it_is_written_keeps_the_old_recording(
    here: Path, write: Callable[..., int], out: str
) -> None:
    def failing(error: Exception, count: int) -> Iterator[Message]:
        yield from standing(count)
        raise error

    before = content(here)
    for error, count in (
        (RuntimeError("broken"), 5),
        (DataError("broken"), 5),
        (DataError("broken"), 0),
    ):
        with pytest.raises((DataError, RuntimeError), match="broken"):
            write(out, failing(error, count), overwrite=True)
        assert content(here) == before
    new = f"new-{out}"  # what comes before the break of an input is written where nothing is lost
    with pytest.raises(DataError, match=r"broken$"):
        write(new, failing(DataError("broken"), 5))
    assert list(open_input(here / new).messages()) == standing(5)
