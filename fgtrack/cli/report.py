"""`fgtrack report`: runs as one page to look at."""

from itertools import chain
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.calibration.study import head_at
from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import CallError
from fgtrack.evaluation.runs import evaluated, run_folders
from fgtrack.evaluation.tables.compare import compare
from fgtrack.io.output import check_apart, check_output
from fgtrack.plotting.late_detection import drawn_close_up
from fgtrack.plotting.plot import drawn, planned
from fgtrack.plotting.style import png
from fgtrack.viewers.report import write_report

_SUFFIXES = (".html", ".htm")
_MEGABYTE = 1e6


def report(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="HTML file.")],
    overwrite: Overwrite = False,
) -> None:
    """Write one HTML file: verdict, viewer, figures, tables.

    It opens with the verdict, a viewer that plays the runs, and three figures; all tables and figures and the
    configuration are folded below. The file needs no network and no other file. Its close-up replays the recording;
    where that is not there any more it is left out.
    """
    if out.suffix.lower() not in _SUFFIXES:
        raise CallError(f"{out}: a report is one HTML file, end the name with .html")
    check_output(out, overwrite)
    every = evaluated(runs)
    check_apart(out, run_folders(every))
    with progress("report"):
        close_up, late = drawn_close_up(every)
        pictures = ((name, png(figure)) for name, figure in chain(close_up, drawn(planned(every))))
        size = write_report(every, compare(*every), pictures, out, head_at(late), overwrite)
    say(f"{out}: {size / _MEGABYTE:.1f} MB, open it in a browser")
