"""The command line in-process: exit codes, one line for every error, and the chain from scenario to figure."""

import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from support.messages import START_NS, standing

from fgtrack.cli.main import run
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList
from fgtrack.inputs.ros.bag_writer import write_bag
from fgtrack.inputs.stream import read_stream, write_stream
from fgtrack.runs import load_run


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    code: int
    out: str
    err: str

    @property
    def error(self) -> str:
        """The one line on stderr."""
        lines = [
            line
            for line in self.err.splitlines()
            if not line.startswith("fgtrack: warning: ")
        ]
        assert len(lines) == 1, self.err
        assert lines[0].startswith("fgtrack: error: "), self.err
        assert "Traceback" not in self.out + self.err
        assert "internal error" not in self.err
        return lines[0].removeprefix("fgtrack: error: ")


Command = Callable[..., Outcome]


@pytest.fixture
def fgtrack(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Command:
    """Runs a command in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> Outcome:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return Outcome(code, out, err)

    return call


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    path = tmp_path / "drive.jsonl"
    write_stream(path, standing(60))
    return path


# --- the chain


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One simulated scenario, written in every way."""
    folder = tmp_path_factory.mktemp("recordings")
    made = {}
    for name, extra in [
        ("s.jsonl", ()),
        ("s.jsonl.gz", ()),
        ("mcap", ()),
        ("sqlite3", ("--storage", "sqlite3")),
    ]:
        made[name] = folder / name
        assert (
            run(
                [
                    "simulate",
                    "default",
                    "-o",
                    str(made[name]),
                    "--duration",
                    "2",
                    "--seed",
                    "3",
                    *extra,
                ]
            )
            == 0
        )
    return made


@pytest.fixture(scope="module")
def runs(
    recordings: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """A replay of each of them."""
    folder = tmp_path_factory.mktemp("runs")
    maps = ["--map", "oval", "--pit-map", "oval"]
    for name, path in recordings.items():
        assert (
            run(
                [
                    "replay",
                    str(path),
                    "-c",
                    "karle2023",
                    "-o",
                    str(folder / name),
                    *maps,
                ]
            )
            == 0
        )
    return {name: folder / name for name in recordings}


def test_every_storage_gives_the_same_run_to_the_byte(runs: dict[str, Path]) -> None:
    for name in ("tracks.csv", "updates.csv"):
        assert len({(path / name).read_bytes() for path in runs.values()}) == 1
    assert len({load_run(path).meta["digest"] for path in runs.values()}) == 1
    assert len(load_run(runs["mcap"]).tracks) > 50


def test_runs_are_compared_as_tables_and_as_json(
    fgtrack: Command, runs: dict[str, Path]
) -> None:
    assert fgtrack("compare", runs["mcap"], runs["sqlite3"]).code == 0
    told = fgtrack("compare", runs["mcap"], runs["sqlite3"], "--json")
    assert told.code == 0
    assert json.loads(told.out)
    assert json.loads((runs["mcap"] / "metrics.json").read_text())
    for form, start in (
        ("md", "### Tracking"),
        ("latex", r"\begin{table}"),
        ("csv", "table,run,"),
        ("json", "{"),
    ):
        told = fgtrack("compare", runs["mcap"], "--format", form)
        assert (told.code, told.err) == (0, "")
        assert start in told.out
        assert told.out.startswith(
            {"md": "- The configured noise", "latex": "% The configured noise"}.get(
                form, start
            )
        )


def test_a_recording_of_which_nothing_was_used_fails_and_says_why(
    fgtrack: Command, stream: Path
) -> None:
    told = fgtrack(
        "replay",
        stream,
        "-c",
        "karle2023",
        "--set",
        "sensors.lidar.max_delay_s=0.01",
        "-o",
        "late",
    )
    assert told.code == 1
    assert told.error == f"{stream}: none of the 60 detections was used (60 too_old)"
    warning = "fgtrack: warning: lidar: 60 of 60 too_old: median delay 0.05 s, allowed 0.01 s: raise sensors.lidar."
    assert told.err.startswith(warning)
    assert load_run("late").meta["complete"]
    assert (
        "late (ekf-backward-forward): lidar: 60 of 60 too_old"
        in fgtrack("compare", "late").err
    )


def test_streaming_is_compared_when_it_is_asked_for(
    fgtrack: Command, runs: dict[str, Path]
) -> None:
    plain, told = (
        fgtrack("compare", runs["mcap"], "--json", *more)
        for more in ((), ("--streaming",))
    )
    assert (told.code, told.err) == (0, "")
    tables = json.loads(told.out)["tables"]
    assert [row["judged"] for row in tables["streaming"]] == [
        "asked",
        "ready",
        "predicted",
    ]
    assert tables["load"][0]["load"] > 0.0
    assert "streaming" not in json.loads(plain.out)["tables"]


def test_the_printed_configuration_is_one(fgtrack: Command, stream: Path) -> None:
    printed = fgtrack("config", "-c", "karle2023", "--set", "filter.storage_s=2.0")
    assert printed.code == 0
    Path("c.yaml").write_text(printed.out)
    assert fgtrack("config", "-c", "c.yaml").out == printed.out
    assert fgtrack("replay", stream, "-c", "c.yaml", "-o", "run").code == 0
    asked, ran = load(Config, Path("c.yaml")), load(Config, Path("run/config.yaml"))
    assert {name: sensor.std for name, sensor in ran.sensors.items()} == {
        n: s.std for n, s in asked.sensors.items()
    }
    assert (
        replace(ran, sensors=asked.sensors, ego=asked.ego) == asked
    )  # with what the recording carries


# --- the call is bad: 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("replay", "missing", "-o", "run"), "missing: there is no such file"),
        (("compare", "missing"), "missing: not a run folder"),
        (
            ("simulate", "missing.yaml", "-o", "x.jsonl"),
            "missing.yaml: there is no such scenario file",
        ),
        (
            ("simulate", "default", "-o", "x.jsonl", "--duration", "0"),
            "duration_s: Input should be greater than 0",
        ),
        (("simulate", "default", "-o", "x.jsonl", "--seed", "-1"), "--seed"),
        (
            ("replay", "drive.jsonl", "-o", "foreign"),
            "foreign: exists and is not a run folder",
        ),
        (
            ("replay", "drive.jsonl", "-o", "run", "-e", "magic"),
            "estimator 'magic' is unknown",
        ),
        (
            ("replay", "drive.jsonl", "-o", "run", "--map", "missing.csv"),
            "missing.csv: there is no such map",
        ),
        (
            ("convert", "drive.jsonl", "drive.html"),
            "drive.html: a recording is a stream (.jsonl, .jsonl.gz) or a rosbag2",
        ),
        (
            ("info", "drive.jsonl", "b"),
            "usage: fgtrack info [OPTIONS] {INPUT})",
        ),
        (("replya", "drive.jsonl"), "Did you mean 'replay'?"),
        (
            ("replay", "drive.jsonl", "-o", "run", "-c", "a.yaml", "--config", "b"),
            "-c / --config: given 2 times, but the option takes one value",
        ),
        (
            ("--max-memory", "1", "--max-memory", "2", "info", "drive.jsonl"),
            "--max-memory: given 2 times",
        ),
    ],
    ids=" ".join,
)
def test_a_bad_call_is_one_line_and_exit_code_2(
    fgtrack: Command,
    stream: Path,
    tmp_path: Path,
    arguments: Sequence[str],
    message: str,
) -> None:
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign/thesis.tex").write_text("years of work")
    called = fgtrack(*arguments)
    assert message in called.error
    assert called.code == 2
    assert (tmp_path / "foreign/thesis.tex").exists()
    assert list(read_stream(stream)) == standing(60)


def test_no_command_shows_the_help_and_is_a_bad_call(fgtrack: Command) -> None:
    for arguments in [(), ("--debug",)]:
        called = fgtrack(*arguments)
        assert called.code == 2
        assert "replay" in called.out
    assert fgtrack("--help").code == 0
    assert fgtrack("--version").out.startswith("fgtrack ")


# --- the data are bad: 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"hello\n", "has a format that fgtrack does not read"),
        (b'{"type": "ego"}\n', "is no header record"),
        (
            b'{"type": "header", "format": "fgtrack-stream/2"}\n',
            "of format 'fgtrack-stream/1'",
        ),
    ],
)
def test_a_file_that_is_no_input_is_one_line_and_exit_code_1(
    fgtrack: Command, tmp_path: Path, content: bytes, message: str
) -> None:
    (tmp_path / "input").write_bytes(content)
    for arguments in [
        ("replay", "input", "-o", "run"),
        ("info", "input"),
        ("convert", "input", "out.jsonl"),
    ]:
        called = fgtrack(*arguments)
        assert message in called.error
        assert "input" in called.error
        assert called.code == 1


@pytest.mark.parametrize("name", ["empty.jsonl", "empty"])
def test_a_recording_without_anything_to_track_is_exit_code_1(
    fgtrack: Command, tmp_path: Path, name: str
) -> None:
    if name.endswith("jsonl"):
        write_stream(tmp_path / name, [])
    else:
        write_bag(tmp_path / name, [])
    called = fgtrack("replay", name, "-o", "run")
    assert name in called.error
    assert called.code == 1


def test_a_truncated_stream_is_replayed_up_to_the_break(
    fgtrack: Command, stream: Path
) -> None:
    whole = stream.read_bytes()
    cut = whole[: len(whole) // 2]
    stream.write_bytes(cut)
    called = fgtrack("replay", stream, "-o", "run")
    assert "drive.jsonl:" in called.error
    assert "the messages before are replayed" in called.error
    assert called.code == 1
    found = load_run("run")
    assert found.meta["complete"] is True
    assert "breaks off" in found.meta["broken_off"]
    assert (
        len(found.updates)
        == found.meta["detections_received"]
        == cut.count(b'"lidar"', 0, cut.rindex(b"\n"))
    )
    assert fgtrack("compare", "run").code == 0


def test_a_recording_whose_receipts_go_back_is_replayed_up_to_there(
    fgtrack: Command, tmp_path: Path
) -> None:
    recording = tmp_path / "loop.jsonl"  # a bag is read in order of receipt
    messages = standing(60)
    messages[60] = replace(messages[60], receipt_ns=START_NS)
    write_stream(recording, messages)
    called = fgtrack("replay", recording, "-o", "run")
    assert "receipt" in called.error
    assert "loop.jsonl" in called.error
    assert called.code == 1
    found = load_run("run")
    assert len(found.updates) == found.meta["detections_received"] >= 30


def test_a_receipt_far_ahead_is_left_out_with_a_line_and_the_rest_is_replayed(
    fgtrack: Command, tmp_path: Path
) -> None:
    recording = tmp_path / "loop.jsonl"
    messages = standing(60)
    messages[60] = replace(messages[60], receipt_ns=START_NS + 10**13)
    write_stream(recording, messages)
    called = fgtrack("replay", recording, "-o", "run")
    assert called.code == 0
    assert called.err.splitlines()[0] == (
        f"fgtrack: {recording}: left out messages with receipts that do not fit the others: 1 of the ego"
    )
    found = load_run("run")
    assert found.meta["broken_off"] is None
    assert len(found.updates) == found.meta["detections_received"] == 60


def test_an_unknown_sensor_says_what_to_do(fgtrack: Command, tmp_path: Path) -> None:
    sonar = DetectionList("sonar", START_NS, START_NS, (Detection(x_m=1.0, y_m=2.0),))
    write_stream(tmp_path / "sonar.jsonl", [sonar])
    called = fgtrack("replay", "sonar.jsonl", "-c", "karle2023", "-o", "run")
    assert "'sonar' has no model" in called.error
    assert "ignore_sensors" in called.error
    assert called.code == 1
    assert not Path("run").exists()
    ignored = fgtrack(
        "replay", "sonar.jsonl", "-o", "run", "--set", "ignore_sensors=[sonar]"
    )
    assert "contains neither ego states nor detections" in ignored.error
    assert ignored.code == 1


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (
            ZeroDivisionError("oh"),
            1,
            "internal error: ZeroDivisionError: oh (run with --debug)",
        ),
        (
            PermissionError(13, "Permission denied", "x.csv"),
            2,
            "x.csv: cannot be used (Permission denied)",
        ),
        (
            OSError(28, "No space left on device", "x.csv"),
            1,
            "x.csv: cannot be used (No space left on device)",
        ),
        (
            KeyboardInterrupt(),
            130,
            "interrupted; finished results are in the output folder",
        ),
    ],
    ids=repr,
)
def test_whatever_is_raised_is_one_line_and_shows_its_traceback_on_demand(
    fgtrack: Command,
    stream: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    code: int,
    message: str,
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("fgtrack.pipeline.replay.replay", broken)
    called = fgtrack("replay", stream, "-o", "run")
    assert (called.code, called.err) == (code, f"fgtrack: error: {message}\n")
    assert (
        code == 130
        or "Traceback" in fgtrack("--debug", "replay", stream, "-o", "run").err
    )


def test_a_warning_of_a_plug_in_is_a_line(
    fgtrack: Command, stream: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warns(*_: object, **__: object) -> None:
        warnings.simplefilter("always")
        warnings.warn("\x1b[31mdivide\nby zero", RuntimeWarning, stacklevel=1)
        raise DataError("not this time")

    monkeypatch.setattr("fgtrack.pipeline.replay.replay", warns)
    called = fgtrack("replay", stream, "-o", "run")
    warned, _ = called.err.splitlines()
    assert "RuntimeWarning: \\x1b[31mdivide by zero" in warned
    assert "test_cli.py:" in warned


def test_whatever_a_recording_says_every_command_prints_lines_for_a_terminal(
    fgtrack: Command, tmp_path: Path
) -> None:
    """As the name of a sensor, and of a key that is not known."""
    odd = "\u202e[bold]\u96f7\u9054[/bold][/]\x1b[31m $\\frac{"
    named = [
        replace(one, sensor=odd) if isinstance(one, DetectionList) else one
        for one in standing(100)
    ]
    write_stream(tmp_path / "odd.jsonl", named)
    lines = (tmp_path / "odd.jsonl").read_text(encoding="utf-8").splitlines()
    lines[1] = json.dumps({**json.loads(lines[1]), odd: 1})
    (tmp_path / "odd.jsonl").write_text("\n".join(lines), encoding="utf-8")
    called = [
        fgtrack("info", "odd.jsonl"),
        fgtrack("replay", "odd.jsonl", "-o", "run"),
        fgtrack("compare", "run"),
    ]
    called += [
        fgtrack("compare", "run", "--all"),
        fgtrack("advise", "odd.jsonl"),
        fgtrack("offsets", "odd.jsonl"),
    ]
    called += [fgtrack("convert", "odd.jsonl", "odd.mcap"), fgtrack("info", "odd.mcap")]
    called += [
        fgtrack("report", "run", "-o", "run.html"),
        fgtrack("export", "run", "-o", "run.mcap"),
    ]
    for one in called:
        assert "internal error" not in one.err
        for line in (one.out + one.err).splitlines():
            assert line.isprintable()
