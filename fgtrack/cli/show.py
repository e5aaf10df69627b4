"""What commands show: tables on stdout, progress on stderr where that is a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich import box
from rich.console import Console, JustifyMethod, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from fgtrack.core.errors import one_line, printable

_WIDTH_WITHOUT_TERMINAL = 120
_SPEED_PERIOD_S = 600.0  # over which the time of the rest is estimated: jobs differ


def console() -> Console:
    """Stdout; wide enough for every table where it is a file or a pipe."""
    probe = Console()
    return probe if probe.is_terminal else Console(width=_WIDTH_WITHOUT_TERMINAL)


def say(line: object) -> None:
    """Print a line as it is, however long."""
    console().print("\n".join(map(printable, str(line).split("\n"))), highlight=False, soft_wrap=True, markup=False)


def warn(line: str) -> None:
    """Print a warning as one line on stderr."""
    Console(stderr=True).print(f"fgtrack: warning: {one_line(line)}", highlight=False, soft_wrap=True, markup=False)


class _Plain(Table):
    """A table whose cells are shown as they are, whatever names a file brings."""

    def add_row(self, *cells: RenderableType | None, **options: Any) -> None:
        """See `Table.add_row`; a text is no markup, and holds no control characters."""
        super().add_row(*(Text(one_line(cell)) if isinstance(cell, str) else cell for cell in cells), **options)


def table(*headings: str) -> Table:
    """A table without rows; a heading that begins with `>` stands above numbers, to the right."""
    empty = _Plain(box=box.SIMPLE_HEAD, show_edge=False)
    for heading in headings:
        justify: JustifyMethod = "right" if heading.startswith(">") else "left"
        empty.add_column(Text(heading.removeprefix(">")), justify=justify, overflow="fold")
    return empty


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Callable[[str], None]]:
    """A bar that moves while the block runs; the function given sets the text beside it, after each of `total` steps.

    With a total also the number of steps done, and the time that the rest will take.
    """
    stderr = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    counted = () if total is None else (MofNCompleteColumn(), TextColumn("left"), TimeRemainingColumn())
    hidden = not stderr.is_terminal
    with Progress(
        *columns, *counted, console=stderr, disable=hidden, transient=True, speed_estimate_period=_SPEED_PERIOD_S
    ) as bar:
        task = bar.add_task(what, total=total)
        yield lambda text: bar.update(task, advance=1, description=f"{what} {text}")


class TickProgress:
    """Tells a progress bar, now and then, how far a replay has come."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self._first_ns: int | None = None
        self._count = 0

    def __call__(self, now_ns: int, num_tracks: int) -> None:
        """After a tick."""
        if self._first_ns is None or now_ns < self._first_ns:
            self._first_ns = now_ns
        self._count += 1
        if self._count % 50 == 0:
            self._show(f"{(now_ns - self._first_ns) / 1e9:.1f} s of data, {num_tracks} tracks")
