"""`fgtrack compare`: runs beside each other."""

import json

from fgtrack.cli.arguments import Json, Runs
from fgtrack.cli.runs import read_runs
from fgtrack.cli.show import console
from fgtrack.evaluation.labels import labelled
from fgtrack.evaluation.metrics import Metrics, evaluate
from fgtrack.evaluation.tables import comparison_dict, comparison_tables
from fgtrack.io.run import Run, write_metrics


def compare(runs: Runs, as_json: Json = False) -> None:
    """Compare runs in tables, and write metrics.json into each."""
    metrics = evaluated(read_runs(runs))
    if as_json:
        print(json.dumps(comparison_dict(metrics), indent=2, allow_nan=False))
        return
    for table in comparison_tables(metrics):
        console().print(table)


def evaluated(runs: list[Run]) -> dict[str, Metrics]:
    """Metrics by label; each is written into its run folder too."""
    metrics = {label: evaluate(run) for label, run in labelled(runs).items()}
    for run, one in zip(runs, metrics.values(), strict=True):
        write_metrics(run.path, one.as_dict())
    return metrics
