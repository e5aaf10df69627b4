"""Commands in a terminal: a pseudo-terminal of some width, and what a person sees in it."""

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from collections.abc import Sequence
from pathlib import Path

import pytest

from fgtrack.io.run import load_run

pytestmark = pytest.mark.slow

ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
SHORT_DEMO = """
from dataclasses import replace
from fgtrack.cli import main, study
read = study.read_scenario
study.read_scenario = lambda name: replace(read(name), duration_s=3.0)
raise SystemExit(main.main())
"""


def lines_in_terminal(width: int, *arguments: object, program: Sequence[str] = ("-m", "fgtrack")) -> list[str]:
    """What the command shows on a terminal of `width` columns, as the lines that it writes."""
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 50, width, 0, 0))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    command = [sys.executable, *program, *map(str, arguments)]
    with subprocess.Popen(
        command, stdout=follower, stderr=subprocess.PIPE, env={**environment, "TERM": "xterm"}
    ) as ran:
        os.close(follower)
        shown = b""
        while True:
            try:
                block = os.read(leader, 1 << 16)
            except OSError:  # the terminal is closed
                break
            if not block:
                break
            shown += block
        os.close(leader)
        error = ran.stderr.read().decode() if ran.stderr else ""
    assert ran.returncode == 0, error
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", shown.decode()).replace("\r\n", "\n").splitlines()


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short demo, made in a terminal of 80 columns; `shown.txt` holds what it showed."""
    folder = tmp_path_factory.mktemp("demo")
    lines = lines_in_terminal(80, "demo", "-o", folder, program=("-c", SHORT_DEMO))
    (folder / "shown.txt").write_text("\n".join(lines), encoding="utf-8")
    return folder


def test_the_demo_goes_from_scenario_to_report(demo: Path) -> None:
    assert (demo / "recording/metadata.yaml").exists()
    assert {path.name for path in (demo / "runs").iterdir()} == set(ESTIMATORS)
    found = {name: load_run(demo / "runs" / name) for name in ESTIMATORS}
    assert [one.meta["estimator"] for one in found.values()] == list(ESTIMATORS)
    assert {one.config["sensors"]["radar"]["std"]["speed_mps"] for one in found.values()} == {1.006}  # fitted
    shown = (demo / "shown.txt").read_text(encoding="utf-8")
    summary, tables = shown.split("Tracking (errors")
    assert "at the newest stamp" in " ".join(summary.split())
    for text in tables.split("Error against lag"):
        assert sorted(ESTIMATORS, key=lambda name: text.index(f" {name} ")) == list(ESTIMATORS)
    assert set(found["smoother"].tables["lagged"]["lag_s"].tolist()) == {0.3}
    assert "final" in found["smoother"].tables["smoothed"]["kind"]
    assert {path.name for path in (demo / "figures").iterdir()} >= {"error_against_lag.png", "arrivals.png"}
    assert "report.html" in shown
