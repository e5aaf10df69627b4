"""`fgtrack compare`: tables of runs."""

import json
from typing import Annotated, Literal

import typer

from fgtrack.cli.arguments import Json, Runs
from fgtrack.cli.show import console, warn
from fgtrack.core.errors import CallError
from fgtrack.evaluation.cautions import cautions
from fgtrack.evaluation.comparison import compare as tables_of
from fgtrack.evaluation.runs import Runs as AnyRuns
from fgtrack.evaluation.runs import judged
from fgtrack.evaluation.tables import Tables
from fgtrack.io.run import write_metrics


def compare(
    runs: Runs,
    as_json: Json = False,
    form: Annotated[
        Literal["md", "csv", "latex", "json"] | None,
        typer.Option("--format", help="Print this instead of tables for a terminal."),
    ] = None,
    streaming: Annotated[
        bool, typer.Option("--streaming", help="Judge what was published when it was ready, too.")
    ] = False,
) -> None:
    """Compare runs in tables, and write metrics.json into each."""
    if as_json and form not in (None, "json"):
        raise CallError(f"--json, --format {form}: give one of them")
    every = judged(runs)
    for line in dict.fromkeys(f"{one.label}: {line}" for one in every for line in cautions(one.run)):
        warn(line)
    tables = written_tables(every, streaming)
    if as_json or form == "json":
        print(json.dumps(tables.to_dict(), indent=2, allow_nan=False))
    elif form is None:
        console().print(tables)
    else:
        print({"md": tables.to_markdown, "csv": tables.to_csv, "latex": tables.to_latex}[form](), end="")


def written_tables(runs: AnyRuns, streaming: bool = False) -> Tables:
    """The tables of `runs`; the metrics of each are written into its folder."""
    every = judged(runs)
    tables = tables_of(*every, streaming=streaming)
    for one in every:
        if one.run.path is not None:
            write_metrics(one.run.path, one.metrics.as_dict())
    return tables
