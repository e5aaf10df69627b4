"""The README's comparison: position errors with an association per run, from the sweep `comparison`.

    python experiments/ledger/comparison.py -o out/comparison --jobs 2

Each estimator tracks the race by itself, as a user's run does. The states of 0.3 s ago are its lagged output.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

import fgtrack
from fgtrack.evaluation import average, paired

NOW, AGO = (
    "truth.overall.errors.position_m.rmse",
    "lagged.0.3.errors.position_m.rmse",
)
REFERENCE = ("late", "ekf-replay", NOW)
#: Rows of the table: delays, estimator, metric.
ROWS = (
    ("late", "drop", NOW),
    ("late", "ekf-backward-forward", NOW),
    ("late", "rewind-forget", NOW),
    REFERENCE,
    ("late", "smoother-banded", NOW),
    ("none", "ekf-replay", NOW),
    ("late", "ekf-replay", AGO),
    ("late", "ekf-rts", AGO),
    ("late", "smoother-banded", AGO),
)


def table(rows: pd.DataFrame) -> str:
    """Return a Markdown table of the errors over the seeds that have all rows, with 95 % intervals."""
    values = rows.set_index(["delays", "estimator", "seed"]).sort_index()
    errors = {row: values.loc[row[:2]][row[2]].dropna().sort_index() for row in ROWS}
    seeds = set.intersection(*(set(each.index) for each in errors.values()))
    errors = {row: each[each.index.isin(seeds)] for row, each in errors.items()}
    reference = errors[REFERENCE].to_numpy()
    lines = [
        f"{len(seeds)} seeds",
        "",
        "| delays | estimator | state | position RMSE [m] | against `ekf-replay` [%] |",
        "|---|---|---|---|---|",
    ]
    for (delays, name, metric), each in errors.items():
        own = each.to_numpy()
        against = paired(100.0 * own / reference, np.full(len(own), 100.0))
        state = "now" if metric == NOW else "0.3 s ago"
        lines.append(
            f"| {delays} | `{name}` | {state} | {average(own):.3f} | {against:+.1f} |"
        )
    smoother = errors["late", "smoother-banded", AGO].to_numpy()
    for name in ("ekf-replay", "ekf-rts"):
        own = errors["late", name, AGO].to_numpy()
        gain = paired(100.0 * smoother / own, np.full(len(own), 100.0))
        lines += ["", f"smoother-banded against {name}, 0.3 s ago: {gain:+.1f} %"]
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the tables.")] = Path(
        "out/comparison"
    ),
    seeds: Annotated[int, typer.Option(help="Number of seeds, from 1.")] = 8,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
    sweep: Annotated[
        str, typer.Option(help="Sweep with the rows of the table.")
    ] = "comparison",
) -> None:
    """Run the sweep, which resumes, and write comparison.md."""
    text = table(fgtrack.sweep(sweep, out, num_seeds=seeds, jobs=jobs))
    (out / "comparison.md").write_text(text)
    print(text)


if __name__ == "__main__":
    typer.run(main)
