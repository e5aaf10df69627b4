"""`fgtrack sweep`: runs settings x seeds x estimators into one table."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from fgtrack.cli.arguments import All, Dask, Form, FormOption, Jobs, Overwrite, Settings
from fgtrack.cli.show import progress, say, show
from fgtrack.config.shipped import find_file
from fgtrack.core.errors import DataError
from fgtrack.core.output import check_no_overlap, write_file
from fgtrack.evaluation.tables.seeds import (
    SweepTable,
    difference_table,
    read_sweep,
    seed_comparisons,
    summary_table,
)
from fgtrack.pipeline.scored_sweep import score
from fgtrack.pipeline.sweep import (
    ERROR_TABLE,
    PAIRED_TABLE,
    PRODUCTS,
    SUMMARY_TABLE,
    SWEEP_TABLE,
    Sweep,
)
from fgtrack.pipeline.sweep_plan import load_plan


def sweep(
    sweep_name: Annotated[
        str, Argument(metavar="SWEEP", help="Sweep: a file (YAML) or a shipped name.")
    ],
    out: Annotated[
        Path,
        Option("-o", "--out", help="Folder of the tables; finished jobs are kept."),
    ],
    jobs: Jobs = None,
    dask: Dask = None,
    recording: Annotated[
        Path | None,
        Option(
            "--input", metavar="INPUT", help="Recording to use instead of the sweep's."
        ),
    ] = None,
    settings: Settings = None,
    form: FormOption = None,
    everything: All = False,
    overwrite: Overwrite = False,
) -> None:
    """Run a grid of settings, seeds and estimators into one table.

    Prints the mean and the standard error at each point of the grid, and which
    estimators are better.
    """
    tell = say if form is None else lambda line: None
    sweep_file = find_file("sweep", sweep_name)
    plan = load_plan(sweep_file, recording, settings or ())
    for name in PRODUCTS:  # other files in the folder stay
        check_no_overlap(out / name, plan.inputs)
    work = Sweep.open(plan, out, overwrite)
    tell(
        f"jobs: {len(work.plan.jobs)} with {len(work.plan.estimators)} estimators each; to do: {len(work.todo)}"
    )
    with progress("sweep", len(work.todo)) as moved:
        result = work.run(score, jobs=jobs or -1, dask=dask, on_job=moved)
    tell(
        f"{out / SWEEP_TABLE}: {result.num_good} of {len(plan.jobs) * len(plan.estimators)} cells"
    )
    if result.num_good:
        _summarise(read_sweep(out), out, form, everything)
    if result.errors:
        raise DataError(
            f"{out / ERROR_TABLE}: {len(result.errors)} cells failed, the first: {result.errors[0]}"
        )
    if result.problems:
        raise DataError("; ".join(result.problems))
    # With --input, the sweep's metrics were chosen for another recording.
    if result.unknown_metrics and recording is None:
        raise DataError(
            f"{sweep_file}: metrics: {SWEEP_TABLE} has no columns for {', '.join(result.unknown_metrics)}"
        )


def _summarise(
    table: SweepTable, out: Path, form: Form | None, everything: bool
) -> None:
    """Write means and paired differences of the estimators; print the means, and the differences in one metric."""
    comparisons = seed_comparisons(table)
    differences = difference_table(comparisons, table.axes)
    write_file(out / PAIRED_TABLE, differences.to_csv())
    summary = summary_table(table)
    write_file(out / SUMMARY_TABLE, summary.to_csv())
    if form is None and any(map(differences.is_main, differences.records)):
        show(differences, form)
    show(summary.in_full() if everything else summary, form)
    if form is None and not everything:
        say(f"\nall metrics: --all, {out / SUMMARY_TABLE}, {out / PAIRED_TABLE}")
