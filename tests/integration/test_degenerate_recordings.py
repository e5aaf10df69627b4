"""Recordings in which something does not vary at all: a usable result, or one line that says what is wrong."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.examples import slow

from fgtrack.cli.main import run
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.stream import write_stream

Capture = pytest.CaptureFixture[str]
MS = 1_000_000
START_NS = 1_600_000_000_000_000_000


def drive(
    count: int = 100,
    *,
    std_m: float = 0.3,
    speed_mps: float = 10.0,
    yaw_rad: float | None = None,
    speed_is_truth: bool = True,
    stamps: int | None = None,
    alike: bool = False,
) -> list[Message]:
    """A car on a straight line at a constant speed, seen by two sensors."""
    rng = np.random.default_rng(1)
    messages: list[Message] = []
    for k in range(count):
        time_s = 0.05 * (k if stamps is None else k % stamps)
        now_ns = START_NS + round(time_s * 1e9)
        x_m = 20.0 + speed_mps * time_s
        messages.append(EgoState(now_ns, now_ns, 0.0, 0.0, 0.0, 0.0))
        known = (0.0, speed_mps) if speed_is_truth else ()
        messages.append(TruthState(now_ns, now_ns, 1, x_m, 5.0, *known))
        for sensor in ("lidar", "radar"):
            x, y = (20.0, 5.0) if alike else rng.normal((x_m, 5.0), std_m).tolist()
            seen = Detection(x_m=x, y_m=y, yaw_rad=yaw_rad)
            messages.append(
                DetectionList(sensor, now_ns, now_ns + 20 * MS, (seen,), "map")
            )
    return sorted(messages, key=lambda message: message.receipt_ns)


def one_detection() -> list[Message]:
    messages = drive()
    first = next(one for one in messages if isinstance(one, DetectionList))
    return [
        one for one in messages if not isinstance(one, DetectionList) or one is first
    ]


def boundless_truth() -> list[Message]:
    messages = drive()
    truth = [place for place, one in enumerate(messages) if isinstance(one, TruthState)]
    for place, y_m in zip(truth[40:42], (math.inf, 1e308), strict=True):
        messages[place] = replace(messages[place], y_m=y_m)
    return messages


NOISELESS = "was the recording simulated without noise?"
FEW = "no free parameter has 30 measurements"
#: What `tune` says of each; None where it fits something.
KINDS = {
    "constant yaw": (lambda: drive(yaw_rad=0.0), None),
    "standing": (lambda: drive(speed_mps=0.0, yaw_rad=0.0), None),
    "truth of positions only": (lambda: drive(speed_is_truth=False), None),
    "truth beyond all bounds": (boundless_truth, None),
    "noiseless": (lambda: drive(std_m=0.0), NOISELESS),
    "all alike, of unknown yaw": (lambda: drive(alike=True), FEW),
    "one detection": (one_detection, FEW),
    "one stamp": (lambda: drive(stamps=1), FEW),
}
_FAST = ("constant yaw", "one detection")
each_kind = pytest.mark.parametrize(
    "kind", [*_FAST, *slow(*(kind for kind in KINDS if kind not in _FAST))]
)


def called(words: Sequence[str], capsys: Capture) -> tuple[int, str, str]:
    code = run(words)
    out, err = capsys.readouterr()
    assert "internal error" not in err
    return code, out, err


@pytest.mark.parametrize(
    "kind", ["one detection", *slow(*(k for k in KINDS if k != "one detection"))]
)
def test_tune_fits_what_can_be_or_says_what_is_wrong(
    kind: str, tmp_path: Path, capsys: Capture
) -> None:
    messages, wrong = KINDS[kind]
    drive_path, out = tmp_path / "drive.jsonl", tmp_path / "tuned.yaml"
    lidar = [one for one in messages() if getattr(one, "sensor", "lidar") == "lidar"]
    write_stream(drive_path, lidar)
    code, text, err = called(
        ["tune", str(drive_path), "-o", str(out), "--json"], capsys
    )
    if wrong is None:
        assert code == 0, err
        found = {one["key"]: one for one in json.loads(text)["parameters"]}
        assert found["sensors.lidar.std.x_m"]["tuned"] == pytest.approx(0.3, rel=0.5)
        yaw = found.get("sensors.lidar.std.yaw_rad")
        # The model gives the yaw some noise, so the likelihood bounds a standard deviation of zero from above alone.
        assert yaw is None or yaw["why"].startswith(
            ("no maximum", "only bounded: below")
        )
    else:
        assert code == 1
        line = err.splitlines()[-1]
        assert line.startswith(
            f"fgtrack: error: {drive_path}: nothing to fit noise to: "
        )
        assert wrong in line
        assert not out.exists()


@each_kind
@pytest.mark.parametrize("command", ["offsets", "advise"])
def test_offsets_and_advice_say_what_can_be_known(
    kind: str, command: str, tmp_path: Path, capsys: Capture
) -> None:
    path = tmp_path / "drive.jsonl"
    write_stream(path, KINDS[kind][0]())
    code, out, err = called([command, str(path)], capsys)
    assert code == 0, err
    assert "nan" not in out
