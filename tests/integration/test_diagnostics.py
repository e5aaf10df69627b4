"""Warnings of the commands, with the recording that causes them; a healthy recording causes none."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from fgtrack.cli.main import run
from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.inputs.stream import write_stream

MS = 1_000_000
START_NS = 1_600_000_000_000_000_000
Call = Callable[..., tuple[int, list[str]]]


@pytest.fixture
def call(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Call:
    """Runs a command in an empty folder; gives its exit code and the lines on stderr."""
    monkeypatch.chdir(tmp_path)

    def called(*arguments: object) -> tuple[int, list[str]]:
        capsys.readouterr()
        code = run([str(argument) for argument in arguments])
        return code, capsys.readouterr().err.splitlines()

    return called


def drive(
    count: int = 100, *, ego: bool = True, frame: str = "ego", seed: int = 1
) -> list[Message]:
    """An ego at rest and a car ahead of it, seen by a lidar with the noise of the default configuration."""
    rng = np.random.default_rng(seed)
    messages: list[Message] = []
    for k in range(count):
        now_ns = START_NS + k * 20 * MS
        if ego:
            messages.append(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        x_m, y_m, yaw_rad = rng.normal(
            (20.0 + 0.02 * k, 1.0, 0.0), (0.3, 0.3, 0.4)
        ).tolist()
        car = Detection(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad)
        messages.append(DetectionList("lidar", now_ns - 50 * MS, now_ns, (car,), frame))
    return messages


def replayed(
    call: Call, messages: Sequence[Message], *settings: str
) -> tuple[int, list[str], list[str]]:
    """Exit code, warnings and errors of a replay."""
    write_stream("drive.jsonl", messages, overwrite=True)
    options = [part for setting in settings for part in ("--set", setting)]
    code, lines = call(
        "replay", "drive.jsonl", "-c", "smoother", *options, "-o", "run", "--overwrite"
    )
    warned = [
        line.removeprefix("fgtrack: warning: ")
        for line in lines
        if line.startswith("fgtrack: warning: ")
    ]
    return code, warned, [line for line in lines if line.startswith("fgtrack: error: ")]


def test_a_healthy_recording_causes_none(call: Call) -> None:
    assert replayed(call, drive()) == (0, [], [])
    assert call("compare", "run") == (0, [])


def test_no_ego(call: Call) -> None:
    code, (line,), _ = replayed(call, drive(ego=False))
    assert (
        code,
        "ego: no state was received, so detections in its frame cannot be transformed: set its topic"
        in line,
    ) == (
        1,
        True,
    )
    code, (line,), _ = replayed(call, drive(ego=False, frame="map"))
    assert (code, line.startswith("ego: no state was received, so new objects")) == (
        0,
        True,
    )
    assert (
        replayed(call, drive(ego=False, frame="map"), "birth.ego_speed_factor=0.0")[1]
        == []
    )


@pytest.mark.slow
def test_noise_that_does_not_fit_names_the_command_that_fits_it(call: Call) -> None:
    _, warned, _ = replayed(
        call, drive(160), "sensors.lidar.std={x_m: 0.1, y_m: 0.1, yaw_rad: 0.1}"
    )
    (line,) = [
        line
        for line in warned
        if "the configured noise is too small, errors are" in line
    ]
    command = line.split("`")[1]
    assert (
        command
        == "fgtrack advise drive.jsonl -c run/config.yaml --tune -o advised.yaml"
    )
    assert call(*command.split()[1:])[0] == 0, "it can be called as it stands"


def test_runs_of_different_recordings(call: Call) -> None:
    for seed in (1, 2):
        write_stream(f"drive{seed}.jsonl", drive(40, seed=seed))
        assert (
            call(
                "replay", f"drive{seed}.jsonl", "-c", "smoother", "-o", f"runs/{seed}"
            )[0]
            == 0
        )
    code, lines = call("compare", "runs")
    (line,) = [line for line in lines if "recordings" in line]
    assert code == 0
    assert "the runs come from 2 recordings" in line
    assert "drive1.jsonl" in line
    assert "drive2.jsonl" in line
