"""The table of settings of Karle et al. 2023 (table I) beside that of a sweep.

    fgtrack sweep karle2023_table -o out/table
    python experiments/karle2023_table/karle2023_table.py out/table

Prints two tables: the paper's numbers beside those of its filter, and its filter beside the replaying EKF and the
smoother. Rows that the sweep does not have (yet) stay empty.
"""

import csv
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import typer

PUBLISHED = Path(__file__).with_name("published.csv")
FILTER, REPLAY, SMOOTHER = "ekf-backward-forward", "ekf-replay", "smoother"

#: Columns of published.csv and of sweep.csv.
RESIDUALS = {
    "along [m]": "along_m",
    "across [m]": "across_m",
    "yaw [deg]": "yaw_rad",
    "speed [m/s]": "speed_mps",
}

Row = Mapping[str, str]
Cells = Mapping[tuple[str, str, str], Row]


def main(
    folder: Annotated[Path, typer.Argument(help="Folder of the sweep.")],
    seed: Annotated[int, typer.Option(help="Which of its seeds.")] = 0,
) -> None:
    """Print the two tables as Markdown."""
    with PUBLISHED.open(newline="") as file:
        rows = list(csv.DictReader(file))
    with (folder / "sweep.csv").open(newline="") as file:
        found = {
            (row["changed"], row["to"], row["estimator"]): row
            for row in csv.DictReader(file)
            if int(row["seed"]) == seed
        }
    print(beside_the_paper(rows, found), beside_each_other(rows, found), sep="\n\n")


def beside_the_paper(rows: Iterable[Row], found: Cells) -> str:
    """Mean ± standard deviation of every residual, and the precision, in the paper and of its filter in the sweep."""
    heads = [
        f"{name}: {source}"
        for name in (*RESIDUALS, "precision")
        for source in ("paper", "here")
    ]
    lines = [["row", *heads]]
    for row in rows:
        cell = found.get((row["changed"], row["to"], FILTER))
        entries = []
        for name in RESIDUALS.values():
            entries += [published(row, name), residual(cell, name)]
        lines.append([row["row"], *entries, row["precision"], value(cell, "precision")])
    return markdown(lines)


def beside_each_other(rows: Iterable[Row], found: Cells) -> str:
    """The paper's filter, the replaying EKF and the smoother: residual along, RMSE against truth, precision."""
    columns = (
        "residual along [m]",
        "position RMSE [m]",
        "speed RMSE [m/s]",
        "precision",
    )
    lines = [
        [
            "row",
            *(
                f"{name}: {estimator}"
                for name in columns
                for estimator in (FILTER, REPLAY, SMOOTHER)
            ),
        ]
    ]
    for row in rows:
        cells = [
            found.get((row["changed"], row["to"], estimator))
            for estimator in (FILTER, REPLAY, SMOOTHER)
        ]
        entries = [residual(cell, "along_m") for cell in cells]
        for name in (
            "truth.overall.errors.position_m.rmse",
            "truth.overall.errors.speed_mps.rmse",
            "precision",
        ):
            entries += [value(cell, name) for cell in cells]
        lines.append([row["row"], *entries])
    return markdown(lines)


def published(row: Row, name: str) -> str:
    """Mean ± standard deviation of a residual in the paper."""
    quantity, unit = name.rsplit("_", 1)
    unit = "deg" if unit == "rad" else unit
    mean, std = row[f"{quantity}_mean_{unit}"], row[f"{quantity}_std_{unit}"]
    return f"{mean} ± {std}" if mean else "-"


def residual(cell: Row | None, name: str) -> str:
    """Mean ± standard deviation of a residual in the sweep, angles in degrees."""
    if cell is None or not cell.get(f"residuals.{name}.mean"):
        return "-"
    scale = math.degrees(1.0) if name.endswith("_rad") else 1.0
    mean, std = (
        scale * float(cell[f"residuals.{name}.{moment}"]) for moment in ("mean", "std")
    )
    return f"{round(mean, 2) + 0.0:.2f} ± {std:.2f}"


def value(cell: Row | None, name: str) -> str:
    """A number of the sweep."""
    return "-" if cell is None or not cell.get(name) else f"{float(cell[name]):.2f}"


def markdown(lines: list[list[str]]) -> str:
    """A table of GitHub Markdown."""
    head, *rest = lines
    return "\n".join(
        f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rest)
    )


if __name__ == "__main__":
    typer.run(main)
