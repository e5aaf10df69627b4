"""A sweep of settings, seeds and estimators whose runs are scored by their metrics: `fgtrack.sweep`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fgtrack.config.shipped import find_file
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_no_overlap
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.scalars import Scalar, scalars_of
from fgtrack.pipeline.sweep import ERROR_TABLE, PRODUCTS, SWEEP_TABLE, Sweep
from fgtrack.pipeline.sweep_plan import load_plan
from fgtrack.runs import Run

if TYPE_CHECKING:  # takes half a second to import
    from pandas import DataFrame

#: Wall times among the metrics, and what follows from them; they have a table of their own.
_TIMES = "time_per_"


def sweep(
    name: str | Path,
    out: str | Path,
    *,
    num_seeds: int | None = None,
    jobs: int | None = None,
) -> "DataFrame":
    """Return the table `sweep.csv` of a sweep: a row for each point, seed and estimator.

    The sweep resumes: runs that the folder `out` has already are not repeated.

    Parameters
    ----------
    name
        YAML file of the sweep, or the name of a shipped one.
    out
        Folder of the tables.
    num_seeds
        Number of seeds to run, the first of the sweep; None for all.
    jobs
        Number of processes; None for one per core.

    Raises `CallError` for an invalid file, and `DataError` if a run fails.
    """
    import pandas

    plan, folder = load_plan(find_file("sweep", name)), Path(out)
    leading = list(dict.fromkeys(job.seed for job in plan.jobs))[:num_seeds]
    chosen = tuple(job for job in plan.jobs if job.seed in leading)
    for product in PRODUCTS:
        check_no_overlap(folder / product, plan.inputs)
    result = Sweep.open(replace(plan, jobs=chosen), folder).run(score, jobs=jobs or -1)
    if result.errors:
        raise DataError(
            f"{folder / ERROR_TABLE}: {len(result.errors)} runs failed, the first: {result.errors[0]}"
        )
    return pandas.read_csv(folder / SWEEP_TABLE)


def score(run: Run) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
    """Return all scalars of the metrics of `run` by path, and its wall times."""
    scalars = {
        name: value
        for name, value in scalars_of(evaluate(run))
        if name not in ("name", "estimator")
    }
    times = {name: value for name, value in scalars.items() if name.startswith(_TIMES)}
    return {name: value for name, value in scalars.items() if name not in times}, times
