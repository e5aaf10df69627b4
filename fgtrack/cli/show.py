"""Output of commands: tables on stdout, progress on stderr where that is a terminal."""

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from rich.console import Console
from rich.progress import (
    BarColumn,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as RichProgress

from fgtrack.cli.arguments import Form
from fgtrack.core.errors import CallError, one_line, printable_lines
from fgtrack.core.types import Message
from fgtrack.evaluation.tables import Table, Tables, bulleted

_WIDTH_WITHOUT_TERMINAL = 120
_MESSAGES = 1000  # between two signs of progress
_SPEED_PERIOD_S = 600.0  # over which the time of the rest is estimated: jobs differ


def console() -> Console:
    """Stdout; a file or a pipe is as wide as COLUMNS says, by default wide enough for nearly every table."""
    probe = Console()
    return probe if probe.is_terminal or os.environ.get("COLUMNS") else Console(width=_WIDTH_WITHOUT_TERMINAL)


def say(line: object) -> None:
    """Print a line as it is, however long."""
    console().print(printable_lines(str(line)), highlight=False, soft_wrap=True, markup=False)


def warn(line: str) -> None:
    """Print a warning as one line on stderr."""
    Console(stderr=True).print(f"fgtrack: warning: {one_line(line)}", highlight=False, soft_wrap=True, markup=False)


def sentences(lines: Iterable[str]) -> None:
    """Print sentences, each behind a dash, wrapped between words."""
    for line in bulleted(lines, console().width):
        console().print(line)


def chosen_form(as_json: bool, form: Form | None) -> Form | None:
    """The form that tables are printed in; None for a terminal. Raises `CallError` where two are asked for."""
    if as_json and form not in (None, "json"):
        raise CallError(f"--json, --format {form}: give one of them")
    return "json" if as_json else form


def show(tables: Tables | Table, form: Form | None, values: Mapping[str, Any] | None = None) -> None:
    """Print tables in a form; as JSON the `values`, which are those of the tables where none are given."""
    if form is None:
        console().print(tables)
    elif form == "json":
        found = values if values is not None else tables.to_dict() if isinstance(tables, Tables) else tables.plain()
        print(json.dumps(found, indent=2, allow_nan=False))
    else:
        print({"md": tables.to_markdown, "csv": tables.to_csv, "latex": tables.to_latex}[form](), end="")


class Progress(Protocol):
    """Says how far work has come."""

    def __call__(self, text: str = "", share: float | None = None) -> None:
        """After a step: what was reached, and which share of the whole, where that is known."""


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Progress]:
    """A bar on a terminal that moves while the block runs, with the time that the rest will take.

    The function given sets the text beside it, after each of `total` steps, or with the share that is done.
    """
    stderr = Console(stderr=True)
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
    left = TextColumn("left"), TimeRemainingColumn()
    with RichProgress(
        *columns,
        *left,
        console=stderr,
        transient=True,
        speed_estimate_period=_SPEED_PERIOD_S,
        disable=not stderr.is_terminal,
    ) as bar:
        task = bar.add_task(what, total=total)

        def moved(text: str = "", share: float | None = None) -> None:
            at: dict[str, Any] = {"advance": 1} if share is None else {"completed": share, "total": 1.0}
            bar.update(task, description=f"{what} {text}".rstrip(), **at)

        yield moved


def counted(messages: Sequence[Message], moved: Progress) -> Iterator[Message]:
    """Yield `messages`; `moved` gets the share of those that have been taken."""
    for number, message in enumerate(messages):
        if number % _MESSAGES == 0:
            moved("", number / len(messages))
        yield message
