"""What of the gap between the estimators is noise that does not fit?

    python experiments/fitted_noise/fitted_noise.py -o out/fitted-noise

Replays the default scenario with every estimator under the paper's noise and under noise fitted by `fgtrack tune`.
"""

import csv
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Annotated

import joblib
import typer

import fgtrack
from fgtrack.evaluation.intervals import average, paired
from fgtrack.evaluation.metrics import evaluate

PAPER, FITTED = "smoother", "tuned"
ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
WAIT_S = 0.3


@dataclass(frozen=True)
class Result:
    """One run."""

    config: str
    estimator: str
    seed: int
    rmse_m: float
    """Of the position now."""
    waiting_gain: float
    """By how much the RMSE `WAIT_S` ago is smaller than that of the present states at the same stamps; NaN of a filter.
    """
    nees: float
    """Mean of the position's, 2 if consistent."""
    lidar_nis: float
    """Mean over its expectation."""
    radar_nis: float
    """The same."""


def result(config: str, estimator: str, seed: int, duration_s: float | None) -> Result:
    """Replay one seed of the default scenario."""
    messages = fgtrack.simulate("default", seed=seed, duration_s=duration_s)
    run = fgtrack.replay(
        messages, config, map="oval", pit_map="oval", estimator=estimator, set={"smoother.lagged_s": [WAIT_S]}
    )
    found = evaluate(run)
    assert found.truth is not None
    gains = [one.gain("position_m") for one in found.lagged if one.lag_s == WAIT_S]
    nis = {name: one.mean / one.dof for name, one in found.consistency.nis.items()}
    return Result(
        config=config,
        estimator=estimator,
        seed=seed,
        rmse_m=found.truth.overall.errors["position_m"].rmse,
        waiting_gain=gains[0] if gains else math.nan,
        nees=found.consistency.position_nees.mean,
        lidar_nis=nis["lidar_cluster"],
        radar_nis=nis["radar"],
    )


def rows(results: Sequence[Result]) -> list[list[str]]:
    """A row for each configuration and estimator: means over the seeds and their 95 % intervals."""
    found = []
    for config in dict.fromkeys(one.config for one in results):
        best = [one.rmse_m for one in results if (one.config, one.estimator) == (config, ESTIMATORS[0])]
        for estimator in ESTIMATORS:
            mine = [one for one in results if (one.config, one.estimator) == (config, estimator)]
            rmse_m = [one.rmse_m for one in mine]
            against = "" if estimator == ESTIMATORS[0] else f"{paired(rmse_m, best):+.4f}"
            gain = [100.0 * one.waiting_gain for one in mine]
            ratios = [
                f"{average([getattr(one, name) for one in mine]):.2f}" for name in ("nees", "lidar_nis", "radar_nis")
            ]
            waiting = "" if math.isnan(gain[0]) else f"{average(gain):.0f}"
            found.append([config, estimator, f"{average(rmse_m):.3f}", against, *ratios, waiting])
    return found


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the tables.")] = Path("out/fitted-noise"),
    configs: Annotated[str, typer.Option(help="Configurations: the paper's noise, the fitted one.")] = "smoother,tuned",
    seeds: Annotated[int, typer.Option(help="Seeds 1 to this; the fit has seen none of them.")] = 10,
    duration_s: Annotated[float | None, typer.Option(help="Length, in place of the scenario's.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Write runs.csv and table.md."""
    out.mkdir(parents=True, exist_ok=True)
    tasks = [(config, name, 1 + k) for config in configs.split(",") for name in ESTIMATORS for k in range(seeds)]
    results = joblib.Parallel(n_jobs=jobs)(joblib.delayed(result)(*task, duration_s) for task in tasks)
    with (out / "runs.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([each.name for each in fields(Result)])
        writer.writerows(astuple(one) for one in results)
    header = ["configuration", "estimator", "position RMSE [m]", f"against {ESTIMATORS[0]} [m]", "NEES (2)"]
    header += ["LiDAR NIS (1)", "RADAR NIS (1)", f"error less after {WAIT_S:g} s [%]"]
    lines = [header, ["---"] * len(header), *rows(results)]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"
    (out / "table.md").write_text(table)
    print(table)


if __name__ == "__main__":
    typer.run(main)
