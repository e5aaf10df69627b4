"""Output of commands: tables on stdout, progress on stderr where that is a terminal."""

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.console import Console

from fgtrack.cli.arguments import Form
from fgtrack.core.errors import one_line, printable_lines
from fgtrack.evaluation.tables import Table, Tables, bulleted

_WIDTH_WITHOUT_TERMINAL = 120
_SPEED_PERIOD_S = 600.0  # over which the time of the rest is estimated: jobs differ


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """Print the rest nowhere (`| head`): what goes to files is written all the same."""
        sys.stdout = None


def console() -> Console:
    """Stdout; a file or a pipe is as wide as COLUMNS specifies, by default wide enough for nearly every table."""
    probe = _Output()
    return (
        probe
        if probe.is_terminal or os.environ.get("COLUMNS")
        else _Output(width=_WIDTH_WITHOUT_TERMINAL)
    )


def say(line: object) -> None:
    """Print a line as it is, however long."""
    console().out(printable_lines(str(line)), highlight=False)


def warn(line: str) -> None:
    """Print a warning as one line on stderr."""
    _Output(stderr=True).out(f"fgtrack: warning: {one_line(line)}", highlight=False)


def sentences(lines: Iterable[str]) -> None:
    """Print sentences, each behind a dash, wrapped between words."""
    for line in bulleted(lines, console().width):
        console().print(line)


def show(
    tables: Tables | Table, form: Form | None, values: Mapping[str, Any] | None = None
) -> None:
    """Print tables in a form; as JSON the `values`, which are those of the tables where none are given."""
    if form is None:
        console().print(tables)
    elif form == "json":
        result = (
            values
            if values is not None
            else tables.to_dict()
            if isinstance(tables, Tables)
            else tables.plain()
        )
        say(json.dumps(result, indent=2, allow_nan=False))
    else:
        text = {
            "md": tables.to_markdown,
            "csv": tables.to_csv,
            "latex": tables.to_latex,
        }[form]()
        say(text.removesuffix("\n"))


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """A bar on a terminal while the block runs; the function given sets its text after each step or with the share."""
    stderr = Console(stderr=True)
    if not stderr.is_terminal:
        yield lambda *_, **__: None
        return
    from rich.progress import Progress

    with Progress(
        console=stderr, transient=True, speed_estimate_period=_SPEED_PERIOD_S
    ) as bar:
        task = bar.add_task(what, total=total)

        def moved(text: str = "", share: float | None = None) -> None:
            at: dict[str, Any] = (
                {"advance": 1} if share is None else {"completed": share, "total": 1.0}
            )
            bar.update(task, description=f"{what} {text}".rstrip(), **at)

        yield moved
