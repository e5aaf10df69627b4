"""The page from a question to a figure is executed, with fewer seeds and a shorter scene."""

import re
import shlex
from pathlib import Path

import pytest

from fgtrack.cli.main import run
from fgtrack.pipeline.sweep_plan import load_plan

PAGE = (Path(__file__).parents[2] / "docs/paper.md").read_text(encoding="utf-8")
FILES = ("crossing.yaml", "question.yaml")


def write_files(folder: Path, changes: dict[str, str]) -> None:
    """Write the files of the page into `folder`, each after its first mention, with `changes` of their text."""
    blocks = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    for name, text in zip(FILES, blocks, strict=True):
        for before, after in changes.items():
            text = text.replace(before, after)
        (folder / name).write_text(text)


def commands() -> list[list[str]]:
    lines = PAGE.splitlines()
    return [shlex.split(line)[1:] for line in lines if line.startswith("fgtrack ")]


def test_the_files_of_the_page_are_short_and_make_a_plan(tmp_path: Path) -> None:
    write_files(tmp_path, {})
    assert all(len((tmp_path / name).read_text().splitlines()) <= 20 for name in FILES)
    plan = load_plan(tmp_path / "question.yaml")
    assert len(plan.jobs) == 40
    assert all(job.problem is None for job in plan.jobs)


@pytest.mark.slow  # replays eight short drives
def test_the_commands_of_the_page_give_the_figure_and_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_files(tmp_path, {"seeds: 10": "seeds: 2", "duration_s: 12": "duration_s: 4"})
    monkeypatch.chdir(tmp_path)
    every = commands()
    assert len(every) == 3
    for command in every:
        assert run(command) == 0, command
    shown = capsys.readouterr().out
    assert (
        "caption of error_against_delay: Error against delay (mean over 2 seeds"
        in shown
    )
    table = shown[shown.index("\\begin{table}") :]
    assert "Mean over 2 seeds" in table
    assert "LiDAR delay [s] & estimator & position RMSE [m]" in table
    assert "truth." not in table
    content = (tmp_path / "out/paper/error_against_delay.pdf").read_bytes()
    assert b"/CIDFontType2" in content
    assert b"/Type3" not in content
