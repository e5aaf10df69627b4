"""`fgtrack figure`: pictures of runs."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import console, progress
from fgtrack.evaluation.plot import save_figures
from fgtrack.evaluation.runs import judged
from fgtrack.io.output import new_files


class Form(StrEnum):
    """Format of the pictures."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"


def figure(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures.")],
    form: Annotated[Form, typer.Option("--format", help="Format of the pictures.")] = Form.PNG,
    overwrite: Overwrite = False,
) -> None:
    """Draw runs: map, residuals, delays, errors, lag, time per tick."""
    found = judged(runs)
    with progress("draw"), new_files(out, overwrite) as folder:
        files = save_figures(found, folder, form)
    for file in files:
        console().print(str(out / file.name), highlight=False, soft_wrap=True)
