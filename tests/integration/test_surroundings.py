"""Commands whose output nobody reads, whose folder is gone, and whose environment is odd."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fgtrack.cli.main import run
from fgtrack.core.output import write_file

pytestmark = pytest.mark.slow

SWEEP = """
format: fgtrack-sweep/1
scenario: single_opponent
config: smoother
duration_s: 0.5
seeds: 2
estimators: [ekf-replay]
set: {map.track: oval}
vary: {association.gate_m: [3.0]}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording, a run of it, and a sweep."""
    made = tmp_path_factory.mktemp("surroundings")
    assert (
        run(
            [
                "simulate",
                "single_opponent",
                "-o",
                str(made / "drive.jsonl"),
                "--duration",
                "1",
            ]
        )
        == 0
    )
    assert run(["replay", str(made / "drive.jsonl"), "-o", str(made / "run")]) == 0
    write_file(made / "sweep.yaml", SWEEP)
    return made


def shell(
    folder: Path, line: str, **environment: str
) -> subprocess.CompletedProcess[str]:
    """What a line of a shell does, in which `fgtrack` is the command."""
    command = f'fgtrack() {{ "{sys.executable}" -m fgtrack "$@"; }}\n{line}'
    return subprocess.run(
        ["bash", "-c", command],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, **environment},
    )


@pytest.mark.parametrize(
    "words", ["info drive.jsonl", "simulate race -o a.jsonl --duration 0.1"]
)
def test_closed_streams_are_no_error(folder: Path, words: str) -> None:
    done = shell(
        folder,
        f"fgtrack {words} >&-; echo $?; fgtrack {words} --overwrite >&- 2>&-; echo $?",
    )
    assert done.stderr == ""
    assert done.stdout.split()[0] == "0"


def test_a_stream_that_cannot_be_written_to_is_a_line(folder: Path) -> None:
    done = shell(folder, "fgtrack info drive.jsonl 1</dev/null")
    assert done.returncode == 2
    assert done.stderr.startswith("fgtrack: error: standard output: cannot be used")


@pytest.mark.parametrize(
    ("words", "made", "steps"),
    [
        ("advise drive.jsonl -c smoother -o advised.yaml", "advised.yaml", ""),
        (
            "sweep sweep.yaml -o swept --jobs 1",
            "swept/summary.csv",
            "fgtrack: sweep: 1 of 2\nfgtrack: sweep: 2 of 2\n",
        ),
    ],
)
def test_what_is_to_be_written_is_written_though_the_reader_has_left(
    folder: Path, words: str, made: str, steps: str
) -> None:
    done = shell(folder, f"(fgtrack {words}; echo $? >&2) | true")
    assert done.stderr == f"{steps}0\n"
    assert (folder / made).exists()


def test_figures_need_nothing_of_the_environment(folder: Path) -> None:
    done = shell(
        folder,
        "fgtrack figure run -o figures",
        MPLBACKEND="nonsense",
        MPLCONFIGDIR="/proc/none",
    )
    assert (done.returncode, done.stderr) == (0, "")
