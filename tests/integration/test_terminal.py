"""Commands in a terminal: a pseudo-terminal of some width, and what a person sees in it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fgtrack.runs import load_run

pytestmark = pytest.mark.slow

ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
SHORT_DEMO = """
from dataclasses import replace
from fgtrack.cli import main, study
read = study.read_scenario
study.read_scenario = lambda name: replace(read(name), duration_s=3.0)
raise SystemExit(main.main())
"""


#: A program in a pseudo-terminal of 80 columns whose output goes to a pipe.
IN_TERMINAL = (
    *(sys.executable, "-c", "import pty, sys; sys.exit(pty.spawn(sys.argv[1:]) >> 8)"),
    *(
        "sh",
        "-c",
        'unset COLUMNS LINES NO_COLOR; stty cols 80 rows 50 && exec "$0" "$@"',
    ),
)


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short demo, made in a terminal of 80 columns; `shown.txt` holds what it showed."""
    folder = tmp_path_factory.mktemp("demo")
    done = subprocess.run(
        [*IN_TERMINAL, sys.executable, "-c", SHORT_DEMO, "demo", "-o", str(folder)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env={**os.environ, "TERM": "xterm"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", done.stdout)
    (folder / "shown.txt").write_text(shown, encoding="utf-8")
    return folder


def test_the_demo_goes_from_scenario_to_report(demo: Path) -> None:
    assert (demo / "recording/metadata.yaml").exists()
    assert {path.name for path in (demo / "runs").iterdir()} == set(ESTIMATORS)
    found = {name: load_run(demo / "runs" / name) for name in ESTIMATORS}
    assert [one.meta["estimator"] for one in found.values()] == list(ESTIMATORS)
    assert {
        one.config["sensors"]["radar"]["std"]["speed_mps"] for one in found.values()
    } == {1.006}  # fitted
    shown = (demo / "shown.txt").read_text(encoding="utf-8")
    summary, tables = shown.split("\nTracking\n")
    assert "at the newest stamp" in " ".join(summary.split())
    for text in tables.split("Error against lag"):
        assert sorted(ESTIMATORS, key=lambda name: text.index(f" {name} ")) == list(
            ESTIMATORS
        )
    assert set(found["smoother"].tables["lagged"]["lag_s"].tolist()) == {0.3}
    assert "final" in found["smoother"].tables["smoothed"]["kind"]
    assert {path.name for path in (demo / "figures").iterdir()} >= {
        "error_against_lag.png",
        "arrivals.png",
    }
    assert "report.html" in shown
