"""Output of the commands: tables on stdout, progress on stderr if stderr is a terminal."""

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from typing import Any

from rich.console import Console

from fgtrack.cli.arguments import Form
from fgtrack.core.errors import one_line, printable_lines
from fgtrack.evaluation.tables import Table, Tables, bulleted

_WIDTH_WITHOUT_TERMINAL = 120
#: Period from which the remaining time is estimated; it is long, because the jobs of a sweep differ.
_SPEED_PERIOD_S = 600.0
# Number of lines of progress in a log.
_LOG_LINES = 10


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """Discard the remaining output (`| head`); files are still written."""
        sys.stdout = None


def console() -> Console:
    """Console on stdout. A file or a pipe has the width COLUMNS, by default a width that fits nearly all tables."""
    probe = _Output()
    return (
        probe
        if probe.is_terminal or os.environ.get("COLUMNS")
        else _Output(width=_WIDTH_WITHOUT_TERMINAL)
    )


def say(line: object) -> None:
    """Print a line without wrapping."""
    console().out(printable_lines(str(line)), highlight=False)


def warn(line: str) -> None:
    """Print a warning as one line on stderr."""
    _Output(stderr=True).out(f"fgtrack: warning: {one_line(line)}", highlight=False)


def sentences(lines: Iterable[str]) -> None:
    """Print sentences as a list with dashes, wrapped between words."""
    for line in bulleted(lines, console().width):
        console().print(line)


def show(
    tables: Tables | Table, form: Form | None, values: Mapping[str, Any] | None = None
) -> None:
    """Print tables in the format `form`.

    JSON prints `values`; without `values` it prints the contents of the tables.
    """
    if form is None:
        console().print(tables)
    elif form == "json":
        contents: object = values
        if values is None:
            contents = (
                tables.to_dict() if isinstance(tables, Tables) else tables.plain()
            )
        say(json.dumps(contents, indent=2, allow_nan=False))
    else:
        text = {
            "md": tables.to_markdown,
            "csv": tables.to_csv,
            "latex": tables.to_latex,
        }[form]()
        say(text.removesuffix("\n"))


def _logged(
    what: str, total: int | None, clock_s: Callable[[], float] = time.monotonic
) -> Callable[..., None]:
    """Return a function that counts steps and prints a line at each tenth of `total` to stderr.

    The line holds the time that is left, if the remaining steps take as long as the
    finished ones.
    """
    done = count(1)
    start_s = clock_s()

    def moved(text: str = "", share: float | None = None) -> None:
        if total is None or share is not None:
            return
        number = next(done)
        if number * _LOG_LINES // total > (number - 1) * _LOG_LINES // total:
            line = f"fgtrack: {what}: {number} of {total}"
            if number < total:
                left_s = (clock_s() - start_s) * (total - number) / number
                line += f", about {_duration(left_s)} left"
            print(one_line(line), file=sys.stderr, flush=True)

    return moved


def _duration(seconds: float) -> str:
    """Return a duration in words: seconds, minutes, or hours and minutes."""
    minutes = round(seconds / 60.0)
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return (
        f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
    )


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Show a progress bar during the block, if stderr is a terminal.

    Without a terminal, a line is printed at each tenth of `total` steps, for a log. Both
    hold the time that is left.

    Yields a function that advances the bar: `moved(text)` by one step, `moved(text,
    share)` to a share from 0 to 1.
    """
    stderr = Console(stderr=True)
    if not stderr.is_terminal:
        yield _logged(what, total)
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
