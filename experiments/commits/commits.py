"""How much longer does a tick take than at another commit?

    git worktree add ../other COMMIT
    python experiments/commits/commits.py --other ../other -o out/commits

Each cell of `experiments/bench_tracker.py` is measured by both checkouts in turns, each in a process of its own. The
processor time of the ticks counts, so other programs disturb little. Both checkouts use this environment, so their
packages are the same.
"""

import csv
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer

HERE = Path(__file__).resolve().parents[2]
HEADER = ("estimator", "objects", "other_ms", "this_ms", "ratio")


def median_tick_ms(checkout: Path, cell: dict[str, Any]) -> float:
    """Median processor time of the ticks of a cell, measured by the code of `checkout`."""
    run = subprocess.run(
        [
            sys.executable,
            str(checkout / "experiments/bench_tracker.py"),
            json.dumps(cell),
        ],
        env={**os.environ, "PYTHONPATH": str(checkout), "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return median(json.loads(run.stdout.strip().splitlines()[-1])["ticks_ms"])


def row(other: Path, cell: dict[str, Any], rounds: int) -> list[str]:
    """Row of the table: the medians over `rounds` of the median ticks, and the median of their ratios."""
    times_ms = [
        [median_tick_ms(checkout, cell) for checkout in (other, HERE)]
        for _ in range(rounds)
    ]
    other_ms, this_ms = (median(column) for column in zip(*times_ms, strict=True))
    ratio = median(after / before for before, after in times_ms)
    return [
        cell["label"],
        str(cell["count"]),
        f"{other_ms:.3g}",
        f"{this_ms:.3g}",
        f"{ratio:.3g}",
    ]


def cells(
    estimators: Sequence[str], objects: Sequence[str], duration_s: float
) -> list[dict[str, Any]]:
    """Cells of `bench_tracker.py` for all estimators and numbers of objects."""
    return [
        {
            "label": name,
            "config": "smoother",
            "count": int(count),
            "estimator": name,
            "duration_s": duration_s,
            "cpu": True,
        }
        for name in estimators
        for count in objects
    ]


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the table.")] = Path(
        "out/commits"
    ),
    other: Annotated[Path, typer.Option(help="Checkout of the other commit.")] = Path(
        "../other"
    ),
    estimators: Annotated[
        str, typer.Option(help="Estimators, separated by commas.")
    ] = "ekf-replay,smoother-banded,smoother",
    objects: Annotated[
        str, typer.Option(help="Numbers of objects, separated by commas.")
    ] = "1,10,50",
    rounds: Annotated[int, typer.Option(min=1, help="Turns of each cell.")] = 3,
    duration_s: Annotated[float, typer.Option(help="Length of the traffic.")] = 8.0,
) -> None:
    """Measure all cells, write and print commits.csv."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / "commits.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for cell in cells(estimators.split(","), objects.split(","), duration_s):
            writer.writerow(row(other.resolve(), cell, rounds))
    print(path.read_text())


if __name__ == "__main__":
    typer.run(main)
