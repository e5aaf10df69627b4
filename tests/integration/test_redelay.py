"""`fgtrack convert --delays`: a recording under other delays, from file to file."""

from collections.abc import Callable
from pathlib import Path

import pytest

from fgtrack.cli.main import run
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.source import open_input
from fgtrack.runs import load_run

Command = Callable[..., tuple[int, str, str]]

SCENARIO = """
duration_s: 3.0
ego: {kind: track, arc_m: 100.0, speed: [[0.0, 66.0]]}
opponents: [{kind: track, arc_m: 140.0, lateral_m: -3.0, speed: [[0.0, 66.0]]}]
sensors:
  - {name: lidar_cluster, std: {x_m: 0.3, y_m: 0.3}, delay: {kind: constant, delay_s: 0.15}}
  - {name: radar, std: {x_m: 1.0, y_m: 1.0, speed_mps: 0.2}, phase_s: 0.023, delay: {kind: constant, delay_s: 0.06}}
"""
BURSTS = """
lidar_cluster:
  delay:
    kind: markov_time
    good: {kind: gamma, min_s: 0.09, mean_s: 0.151, q90_s: 0.191}
    bad: {kind: uniform, min_s: 0.2, max_s: 0.35}
    to_bad_per_s: 0.5
    to_good_per_s: 2.0
radar: {delay: {kind: gamma, min_s: 0.01, mean_s: 0.06, q90_s: 0.1}}
"""
BACK = """
lidar_cluster: {delay: {kind: constant, delay_s: 0.15}}
radar: {delay: {kind: constant, delay_s: 0.06}}
"""
LOSS = """
radar: {loss_probability: 0.5, clock: [{kind: arrival}, {kind: offset, offset_s: -0.05}]}
"*": {delay: {kind: none}}
"""


@pytest.fixture
def fgtrack(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Command:
    """Runs a command in a folder with a recording and files of delays; exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    for name, text in {
        "scenario": SCENARIO,
        "bursts": BURSTS,
        "back": BACK,
        "loss": LOSS,
    }.items():
        Path(f"{name}.yaml").write_text(text)

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        return code, *capsys.readouterr()

    assert call("simulate", "scenario.yaml", "-o", "original.jsonl")[0] == 0
    return call


def read(path: str) -> list[Message]:
    return list(open_input(Path(path)).messages())


def digest(fgtrack: Command, recording: str) -> object:
    assert (
        fgtrack(
            "replay",
            recording,
            "-o",
            f"runs/{recording}",
            "--map",
            "oval",
            "-e",
            "ekf-replay",
        )[0]
        == 0
    )
    return load_run(Path(f"runs/{recording}")).meta["digest"]


def test_constant_delays_restore_a_stream_that_went_through_bursts_and_a_bag(
    fgtrack: Command,
) -> None:
    assert (
        fgtrack(
            "convert",
            "original.jsonl",
            "bursts",
            "--delays",
            "bursts.yaml",
            "--seed",
            7,
        )[0]
        == 0
    )
    assert read("bursts") != read("original.jsonl")
    assert len(read("bursts")) == len(read("original.jsonl"))
    assert fgtrack("convert", "bursts", "back.jsonl", "--delays", "back.yaml")[0] == 0
    assert Path("back.jsonl").read_bytes() == Path("original.jsonl").read_bytes()
    assert digest(fgtrack, "back.jsonl") == digest(fgtrack, "original.jsonl")


def test_the_seed_decides_the_digest_of_the_run_whatever_the_storage(
    fgtrack: Command,
) -> None:
    for out, seed in {"a.jsonl": 7, "b.jsonl.gz": 7, "c": 7, "d.jsonl": 8}.items():
        assert (
            fgtrack(
                "convert",
                "original.jsonl",
                out,
                "--delays",
                "bursts.yaml",
                "--seed",
                seed,
            )[0]
            == 0
        )
    assert (
        fgtrack("convert", "original.jsonl", "e.jsonl", "--delays", "bursts.yaml")[0]
        == 0
    )
    digests = [
        digest(fgtrack, name)
        for name in ("a.jsonl", "b.jsonl.gz", "c", "d.jsonl", "e.jsonl")
    ]
    assert digests[0] == digests[1] == digests[2]
    assert len(set(digests)) == 3


def test_what_is_lost_is_said(fgtrack: Command) -> None:
    code, out, err = fgtrack(
        "convert", "original.jsonl", "loss.jsonl", "--delays", "loss.yaml"
    )
    lost = len(read("original.jsonl")) - len(read("loss.jsonl"))
    assert (code, out, err) == (
        0,
        f"loss.jsonl: {len(read('loss.jsonl'))} messages, lost {lost} of radar\n",
        "",
    )
    assert 15 < lost < 45
    lists = [m for m in read("loss.jsonl") if isinstance(m, DetectionList)]
    assert {(m.sensor, m.receipt_ns - m.stamp_ns) for m in lists} == {
        ("lidar_cluster", 0),
        ("radar", 50_000_000),
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "radar: {dely: {kind: none}}",
            "bad.yaml: radar.dely: unknown key, did you mean 'delay'; the keys are delay, clock",
        ),
        (
            "sonar: {delay: {kind: none}}",
            "sensor 'sonar' is not in the input, whose sensors are: lidar",
        ),
    ],
)
def test_a_bad_file_of_delays_is_one_line_that_names_the_key(
    fgtrack: Command, text: str, message: str
) -> None:
    Path("bad.yaml").write_text(text)
    code, _, err = fgtrack(
        "convert", "original.jsonl", "out.jsonl", "--delays", "bad.yaml"
    )
    assert code == 2
    assert message in err
    assert len(err.splitlines()) == 1
    assert not Path("out.jsonl").exists()
