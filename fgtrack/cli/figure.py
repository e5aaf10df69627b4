"""`fgtrack figure`: pictures of runs."""

from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import Runs
from fgtrack.cli.runs import read_runs
from fgtrack.cli.show import console, progress
from fgtrack.evaluation.figures import save_figures


def figure(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures (PNG).")],
) -> None:
    """Draw runs: map, residuals, delays, errors, lag, time per tick."""
    with progress("draw"):
        files = save_figures(read_runs(runs), out)
    for file in files:
        console().print(str(file), highlight=False, soft_wrap=True)
