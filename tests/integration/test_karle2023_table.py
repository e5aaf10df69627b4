"""The script that prints the table of settings beside the paper's."""

import csv
from pathlib import Path

import pytest
from support.scripts import load

from fgtrack.pipeline.sweep_plan import load_plan

script = load("karle2023_table")
SWEEP = Path(__file__).parents[2] / "configs/sweeps/karle2023_table.yaml"


def published() -> list[dict[str, str]]:
    with script.PUBLISHED.open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_rows_of_the_sweep_are_those_of_the_paper() -> None:
    jobs = load_plan(SWEEP).jobs
    wanted = [(row["changed"], row["to"]) for row in published()]
    assert sorted((changed, "" if to is None else str(to)) for changed, to in (job.cells for job in jobs)) == sorted(
        wanted
    )


def test_the_tables_hold_the_paper_and_what_the_sweep_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = {
        "residuals.along_m.mean": -0.1234,
        "residuals.along_m.std": 0.5,
        "residuals.yaw_rad.mean": 0.0174533,
        "residuals.yaw_rad.std": 0.0349066,
        "precision": 0.75,
    }
    with (tmp_path / "sweep.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["changed", "to", "seed", "estimator", *found])
        writer.writerow(["base", "", 0, "ekf-backward-forward", *found.values()])
        writer.writerow(["base", "", 1, "ekf-backward-forward", *(0.0 for _ in found)])
    script.main(tmp_path, seed=0)
    beside, among = capsys.readouterr().out.split("\n\n")
    lines = beside.splitlines()
    assert len(lines) == len(among.splitlines()) == 2 + len(published())
    assert lines[2] == (
        "| EKF, CTRV | -0.08 ± 0.73 | -0.12 ± 0.50 | 0.03 ± 0.38 | - | -0.11 ± 2.58 | 1.00 ± 2.00 | -0.21 ± 2.76 | - "
        "| 0.50 | 0.75 |"
    )
    assert lines[3].startswith("| EKF, CV | -0.10 ± 0.72 | - |")
