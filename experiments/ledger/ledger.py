"""Where the error of the present comes from, over seeds: policies, noise, lateness and waiting.

    python experiments/ledger/ledger.py -o out/ledger --jobs 2

The default scenario under the paper's noise and under noise fitted to other seeds; every row has the same measurements,
tracks and first states.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import joblib
import numpy as np
import pandas as pd
import typer

import fgtrack
from fgtrack import Config
from fgtrack.evaluation import average, paired

REFERENCE = "ekf-replay"
MAPS = {"map.track": "oval", "map.pit": "oval"}
NOISES = {"paper": "smoother", "tuned": "tuned"}
"""Shipped configurations, which differ in the noise."""


def judged(seed: int, duration_s: float | None) -> list[dict[str, object]]:
    """Return rows of one seed: quantity, noise, name, RMSE or mean square."""
    messages = list(fgtrack.simulate("default", seed=seed, duration_s=duration_s))
    rows: list[dict[str, object]] = []
    for noise, name in NOISES.items():
        config = Config.from_yaml(name).replace(MAPS, estimator="ekf-backward-forward")
        result = fgtrack.ledger(messages, config)
        tables = result.tables.tables

        def add(quantity: str, what: str, value: float, noise: str = noise) -> None:
            rows.append(
                {
                    "seed": seed,
                    "quantity": quantity,
                    "noise": noise,
                    "name": what,
                    "value": value,
                }
            )

        for row in tables["policies"].records:
            add("policy", row["estimator"], row["rms_m"])
        for row in tables["waiting"].records:
            add("filtered", f"{row['wait_s']:g}", row["filter_m"])
            add("with a smoothing pass", f"{row['wait_s']:g}", row["rts_m"])
            add("smoothed", f"{row['wait_s']:g}", row["smoother_m"])
        for row in tables["sensors"].records:
            add("lateness costs", row["sensor"], row["cost"])
            add("late lists are worth", row["sensor"], row["worth"])
    return rows


def lines(results: pd.DataFrame) -> Iterable[str]:
    """Yield the table: means over the seeds with 95 % intervals, policies against the replaying filter in per cent."""
    values = results.set_index(["quantity", "name", "noise", "seed"]).sort_index()[
        "value"
    ]
    yield f"| {' | '.join(['', *(f'{noise} noise [m] | against {REFERENCE} [%]' for noise in NOISES)])} |"
    yield "| --- " * (1 + 2 * len(NOISES)) + "|"
    for quantity, name in (
        results[["quantity", "name"]].drop_duplicates().itertuples(index=False)
    ):
        cells = []
        for noise in NOISES:
            own = values[quantity, name, noise].to_numpy()
            replay = values["policy", REFERENCE, noise].to_numpy()
            against = (
                ""
                if name == REFERENCE and quantity == "policy"
                else f"{percent(own, replay):+.1f}"
            )
            cells += [f"{average(own):.3f}", against if "late" not in quantity else ""]
        yield f"| {quantity}: {name} | {' | '.join(cells)} |"


def percent(own: Sequence[float], reference: Sequence[float]) -> object:
    """Return the mean over seeds of the difference, in per cent of the reference."""
    own, reference = np.asarray(own), np.asarray(reference)
    return paired(100.0 * own / reference, np.full(len(own), 100.0))


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the table.")] = Path(
        "out/ledger"
    ),
    seeds: Annotated[
        int, typer.Option(help="Seeds 1 to this; the fit has seen none of them.")
    ] = 10,
    duration_s: Annotated[
        float | None, typer.Option(help="Length, in place of the scenario's.")
    ] = None,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Write rows.csv and table.md."""
    out.mkdir(parents=True, exist_ok=True)
    every = joblib.Parallel(n_jobs=jobs)(
        joblib.delayed(judged)(1 + k, duration_s) for k in range(seeds)
    )
    results = pd.DataFrame([row for rows in every for row in rows])
    results.to_csv(out / "rows.csv", index=False)
    table = "\n".join(lines(results)) + "\n"
    (out / "table.md").write_text(table)
    print(table)


if __name__ == "__main__":
    typer.run(main)
