"""`fgtrack figure`: pictures of runs."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.evaluation.plot import save_figures
from fgtrack.evaluation.runs import judged
from fgtrack.io.output import new_files


def figure(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures.")],
    form: Annotated[Literal["png", "svg", "pdf"], typer.Option("--format", help="Format of the pictures.")] = "png",
    overwrite: Overwrite = False,
) -> None:
    """Draw runs: map, residuals, delays, errors, lag, time per tick."""
    found = judged(runs)
    with progress("draw"), new_files(out, overwrite) as folder:
        files = save_figures(found, folder, form)
    for file in files:
        say(out / file.name)
