"""Autoferry, judged on scenarios that no number of the configuration comes from.

    python experiments/real_data/held_out.py AUTOFERRY -o out/held_out --jobs 2

AUTOFERRY holds a folder for each scenario. For each of them the rules (rules.py) give the numbers of the configuration
from the truth of all others; the tracker is judged on the one left out. `rules.csv` has the numbers of every fold, and
in its last row those of all scenarios, which `configs/autoferry.yaml` has. `scores.csv`, `nis.csv` and
`differences.csv` are of the recorded delays; those of late lists begin with the delay, and `costs.csv` says what it
costs.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import costs
import typer
from joblib import Parallel, delayed
from options import Estimators, Jobs, Out
from rules import numbers, recorded, ruled
from scores import HEADER, Found, autoferry_sources, scored, write, write_scores

import fgtrack
from fgtrack import Config, open_input
from fgtrack.evaluation import EvaluatedRun, paired


def judged(
    source: Path,
    config: Config,
    estimators: Sequence[str],
    sensor: str,
    delays_s: Sequence[float],
) -> tuple[list[list[Found]], list[costs.Sums]]:
    """Scores of one recording by delay and estimator, and what each delay but the first, which is 0, is compared by."""
    found, compared, prompt = [], [], list[EvaluatedRun]()
    recording = list(open_input(source, config.input).messages())
    for delay_s in delays_s:
        messages = costs.late(recording, sensor, delay_s) if delay_s else recording
        configs = [replace(config, estimator=each) for each in estimators]
        runs = [
            EvaluatedRun(one.estimator, fgtrack.replay(messages, one))
            for one in configs
        ]
        found.append(
            [
                scored(source.name, source, *each)
                for each in zip(configs, runs, strict=True)
            ]
        )
        if delay_s:
            compared.append(costs.sums(prompt, runs))
        else:
            prompt = runs
    return found, compared


def differences(scores: Sequence[Sequence[str]]) -> list[list[str]]:
    """Of every estimator from the first: mean over the scenarios and its 95 % interval."""
    first, *others = dict.fromkeys(row[1] for row in scores)
    rows = []
    for other in others:
        for metric in ("mota", "hota", "gospa_m", "rmse_m"):
            column = HEADER.index(metric)
            here, there = (
                [float(row[column]) for row in scores if row[1] == each]
                for each in (other, first)
            )
            rows.append([other, first, metric, f"{paired(here, there):.2f}"])
    return rows


def main(
    autoferry: Annotated[
        Path, typer.Argument(help="Folder with a folder per scenario.")
    ],
    out: Out = Path("out/held_out"),
    estimators: Estimators = "ekf-replay",
    judge: Annotated[str, typer.Option(help="Scenarios to judge, all if empty.")] = "",
    base: Annotated[
        str, typer.Option(help="Configuration that the numbers go into.")
    ] = "autoferry",
    late: Annotated[str, typer.Option(help="Sensor that is late.")] = "lidar",
    delays_s: Annotated[str, typer.Option(help="How late, separated by commas.")] = "",
    jobs: Jobs = 1,
) -> None:
    """Apply the rules with each scenario left out, judge it, print all tables."""
    config = Config.from_yaml(base)
    sources = autoferry_sources(autoferry, "")
    known = {name: recorded(source, config) for name, source in sources.items()}
    judge_names = judge.split(",") if judge else list(known)

    labels = [*judge_names, "none"]
    folds = {
        name: ruled(config, [one for other, one in known.items() if other != name])
        for name in labels
    }
    rows = [
        [name, *(f"{value:g}" for value in numbers(fold).values())]
        for name, fold in folds.items()
    ]
    write(out / "rules.csv", ["held_out", *numbers(folds["none"])], rows)

    names, lags_s = (
        estimators.split(","),
        [0.0, *(float(each) for each in delays_s.split(",") if each)],
    )
    of_scenarios = Parallel(n_jobs=jobs)(
        delayed(judged)(sources[name], folds[name], names, late, lags_s)
        for name in judge_names
    )
    cost_rows = []
    for k, delay_s in enumerate(lags_s):
        found = [
            one
            for each in zip(*(found[k] for found, _ in of_scenarios), strict=True)
            for one in each
        ]
        prefix = f"{delay_s:g}_s_" if delay_s else ""
        write_scores(out, found, prefix)
        header = ["estimator", "against", "metric", "difference"]
        write(
            out / f"{prefix}differences.csv",
            header,
            differences([one.scores for one in found]),
        )
        if delay_s:
            compared = [compared[k - 1] for _, compared in of_scenarios]
            cost_rows += [[f"{delay_s:g}", *row] for row in costs.rows(compared, names)]
    if cost_rows:
        write(out / "costs.csv", ["delay_s", *costs.HEADER], cost_rows)


if __name__ == "__main__":
    typer.run(main)
