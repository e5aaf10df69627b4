"""`fgtrack figure`: pictures of runs."""

from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import console, progress
from fgtrack.evaluation.figures import save_figures
from fgtrack.evaluation.runs import judged
from fgtrack.io.output import new_files


def figure(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures (PNG).")],
    overwrite: Overwrite = False,
) -> None:
    """Draw runs: map, residuals, delays, errors, lag, time per tick."""
    found = [one.run for one in judged(runs)]
    with progress("draw"), new_files(out, overwrite) as folder:
        files = save_figures(found, folder)
    for file in files:
        console().print(str(out / file.name), highlight=False, soft_wrap=True)
