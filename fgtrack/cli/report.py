"""`fgtrack report`: runs as one page to look at."""

from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated

import typer
from matplotlib.figure import Figure

import fgtrack
from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.figure import drawn_close_up
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import CallError
from fgtrack.core.files import read_head
from fgtrack.evaluation.plot import named_figures
from fgtrack.evaluation.report.page import page
from fgtrack.evaluation.runs import JudgedRun, judged, run_folders
from fgtrack.io.output import Kind, check_apart, check_output, new_file

_SUFFIXES = (".html", ".htm")
_START, _MARK = b"<!DOCTYPE html>", b'<meta name="generator" content="fgtrack '
_HEAD = 1000
_MEGABYTE = 1e6


def _is_report(path: Path) -> bool:
    head = read_head(path, _HEAD)
    return head.startswith(_START) and _MARK in head


REPORT = Kind("a report of fgtrack", _is_report)


def report(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="HTML file.")],
    overwrite: Overwrite = False,
) -> None:
    """Write one HTML file: verdict, tables, figures, viewer.

    The verdict, all tables and figures, the configuration, and a viewer that plays the runs. The file needs no network
    and no other file. Its close-up replays the recording; where that is not there any more it is left out.
    """
    if out.suffix.lower() not in _SUFFIXES:
        raise CallError(f"{out}: a report is one HTML file, end the name with .html")
    check_output(out, REPORT, overwrite)
    every = judged(runs)
    check_apart(out, run_folders(every))
    with progress("report"):
        close_up, missing = drawn_close_up(every)
        notes = [] if missing is None else [f"no close-up: {missing}"]
        size = write_report(every, chain(close_up, named_figures(every)), out, overwrite, notes)
    say(f"{out}: {size / _MEGABYTE:.1f} MB, open it in a browser")


def write_report(
    runs: Sequence[JudgedRun],
    figures: Iterable[tuple[str, Figure]],
    out: Path,
    overwrite: bool,
    notes: Sequence[str] = (),
) -> int:
    """Write the report of `runs` with `figures` by name, and `notes` of what is missing; gives its size in bytes."""
    content = page(runs, figures, fgtrack.__version__, notes)
    text = content.encode("utf-8", "backslashreplace")  # names of files need not be UTF-8
    with new_file(out, REPORT, overwrite) as file:
        file.write(text)
    return len(text)
