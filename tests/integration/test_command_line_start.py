"""What the command line imports, and what its help says."""

import os
import subprocess
import sys

import pytest

from fgtrack.cli.main import COMMANDS, run

HEAVY = (
    "gtsam",
    "scipy",
    "matplotlib",
    "numba",
    "numpy",
    "pandas",
    "rosbags",
    "pydantic",
    "scipy.special",
)


def loaded_by(program: str) -> set[str]:
    """The heavy packages that a new interpreter has loaded after `program`."""
    code = f"{program}\nimport sys\nprint('loaded:', *[name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].removeprefix("loaded:").split())


def test_the_help_imports_nothing_heavy() -> None:
    assert loaded_by("from fgtrack.cli.main import run; run(['--help'])") == set()


def called(*commands: list[str]) -> str:
    """Program that runs `commands` in one process."""
    return (
        "from fgtrack.cli.main import run\n"
        f"for words in {list(commands)!r}: assert run(words) == 0\n"
    )


def test_the_configuration_is_printed_without_a_compiler_and_without_readers() -> None:
    loaded = loaded_by(
        called(["config"], ["config", "-c", "smoother"], ["config", "--list"])
    )
    assert loaded.isdisjoint({"gtsam", "matplotlib", "numba", "pandas", "rosbags"})


def test_the_contents_of_a_recording_are_listed_without_a_compiler(tmp_path) -> None:
    recordings = [str(tmp_path / name) for name in ("drive.jsonl", "drive")]
    for each in recordings:
        assert run(["simulate", "default", "--duration", "0.5", "-o", each]) == 0
    loaded = loaded_by(
        called(
            *(
                ["info", each, *options]
                for each in recordings
                for options in ([], ["-c", "smoother"])
            )
        )
    )
    assert loaded.isdisjoint({"gtsam", "matplotlib", "numba", "pandas"})


def test_a_replay_imports_no_tables_of_others_no_figures_and_no_special_functions(
    tmp_path,
) -> None:
    recording = str(tmp_path / "drive.jsonl")
    assert run(["simulate", "default", "--duration", "0.5", "-o", recording]) == 0
    call = [
        "replay",
        recording,
        "-c",
        "tuned",
        "-e",
        "ekf-replay",
        "-o",
        str(tmp_path / "run"),
    ]
    loaded = loaded_by(f"from fgtrack.cli.main import run; assert run({call!r}) == 0")
    assert loaded.isdisjoint(
        {"gtsam", "matplotlib", "pandas", "rosbags", "scipy.special"}
    )


def test_every_command_has_a_line_in_the_help_and_a_help_of_its_own(capsys) -> None:
    assert run(["--help"]) == 0
    listed = (
        capsys.readouterr().out.partition("Commands:")[2].partition("Exit codes:")[0]
    )
    assert [line.split()[0] for line in listed.splitlines() if line.strip()] == list(
        COMMANDS
    )
    assert "..." not in listed
    for name in COMMANDS:
        assert run([name, "--help"]) == 0
        assert f"fgtrack {name}" in capsys.readouterr().out


def test_python_m_runs_the_command_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "fgtrack", "--version"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith("fgtrack ")


@pytest.mark.parametrize(
    ("words", "offered"),
    [("rep", {"replay", "report"}), ("replay drive.jsonl --pit", {"--pit-map"})],
)
def test_the_shell_completes_commands_and_options(
    words: str, offered: set[str]
) -> None:
    asked = {
        "_FGTRACK_COMPLETE": "complete_bash",
        "COMP_WORDS": f"fgtrack {words}",
        "COMP_CWORD": str(len(words.split())),
    }
    program = [
        sys.executable,
        "-c",
        "import sys; sys.argv[0] = 'fgtrack'; from fgtrack.cli.entry import main; main()",
    ]
    done = subprocess.run(
        program, capture_output=True, text=True, env={**os.environ, **asked}
    )
    assert set(done.stdout.split()) == offered, done.stderr
