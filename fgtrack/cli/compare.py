"""`fgtrack compare`: tables of runs."""

from typing import Annotated

import typer

from fgtrack.cli.arguments import All, FormOption, Json, Runs
from fgtrack.cli.show import chosen_form, say, show, warn
from fgtrack.core.errors import FgtrackError
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.evaluation.runs import Runs as AnyRuns
from fgtrack.evaluation.runs import evaluated, recordings_warning
from fgtrack.evaluation.tables import Tables
from fgtrack.evaluation.tables.compare import compare as tables_of
from fgtrack.io.run import write_metrics


def compare(
    runs: Runs,
    as_json: Json = False,
    form: FormOption = None,
    everything: All = False,
    streaming: Annotated[
        bool, typer.Option("--streaming", help="Judge what was published when it was ready, too.")
    ] = False,
) -> None:
    """Compare runs in tables, and write metrics.json into each."""
    form = chosen_form(as_json, form)
    every = evaluated(runs)
    of_each = dict.fromkeys(f"{one.label}: {line}" for one in every for line in diagnostics(one.run))
    for line in (*recordings_warning(every), *of_each):
        warn(line)
    tables = written_tables(every, streaming)
    show(tables.in_full() if everything else tables, form)
    if form is None and tables.has_more and not everything:
        say("\nevery table and column: --all")


def written_tables(runs: AnyRuns, streaming: bool = False) -> Tables:
    """The tables of `runs`; the metrics of each are written into its folder, with a warning where they cannot be."""
    every = evaluated(runs)
    tables = tables_of(*every, streaming=streaming)
    for one in every:
        if one.run.path is not None:
            try:
                write_metrics(one.run.path, one.metrics.as_dict())
            except FgtrackError as error:
                warn(f"{error}; the tables are complete without it")
    return tables
