"""What commands show: tables on stdout, progress on stderr where that is a terminal."""

import json
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Message
from fgtrack.evaluation.tables import Table, Tables
from fgtrack.evaluation.terminal import bulleted, hanging

_WIDTH_WITHOUT_TERMINAL = 120
LINE_PERIOD_S = 10.0
"""Between two lines of progress off a terminal."""
SOON_S = 1.0
"""What takes less needs no percentage."""
_TICKS, _MESSAGES = 50, 1000  # between two signs of progress
_SPEED_PERIOD_S = 600.0  # over which the time of the rest is estimated: jobs differ


def console() -> Console:
    """Stdout; a file or a pipe is as wide as COLUMNS says, by default wide enough for nearly every table."""
    probe = Console()
    return probe if probe.is_terminal or os.environ.get("COLUMNS") else Console(width=_WIDTH_WITHOUT_TERMINAL)


def say(line: object) -> None:
    """Print a line as it is, however long."""
    console().print(printable_lines(str(line)), highlight=False, soft_wrap=True, markup=False)


def command_line(*words: object) -> str:
    """A command as a shell takes it, whatever is in the names of files."""
    return shlex.join(map(str, words))


def warn(line: str) -> None:
    """Print a warning as one line on stderr."""
    Console(stderr=True).print(f"fgtrack: warning: {one_line(line)}", highlight=False, soft_wrap=True, markup=False)


def entries(names: Mapping[str, str]) -> None:
    """Print names and what they are, in two columns."""
    for line in hanging(names, console().width):
        console().print(line)


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
        found = values if values is not None else tables.to_dict() if isinstance(tables, Tables) else tables.records()
        print(json.dumps(found, indent=2, allow_nan=False))
    else:
        print({"md": tables.to_markdown, "csv": tables.to_csv, "latex": tables.to_latex}[form](), end="")


class Progress(Protocol):
    """Says how far work has come."""

    def __call__(self, text: str = "", share: float | None = None) -> None:
        """After a step: what was reached, and which share of the whole, where that is known."""


@contextmanager
def progress(what: str, total: int | None = None) -> Iterator[Progress]:
    """A bar that moves while the block runs; off a terminal a line now and then, where the work takes long.

    The function given sets the text beside it, after each of `total` steps, or with the share that is done. With either
    also the percentage, and the time that the rest will take.
    """
    stderr = Console(stderr=True)
    if not stderr.is_terminal:
        yield _Lines(what, total)
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    left = (TextColumn("left"), TimeRemainingColumn())
    with RichProgress(*columns, *left, console=stderr, transient=True, speed_estimate_period=_SPEED_PERIOD_S) as bar:
        task = bar.add_task(what, total=total)

        def moved(text: str = "", share: float | None = None) -> None:
            words = f"{what} {text}".rstrip()
            if share is None:
                bar.update(task, advance=1, description=words)
            else:
                bar.update(task, completed=share, total=1.0, description=words)

        yield moved


class _Lines:
    """Progress for a file: a line every few seconds."""

    def __init__(self, what: str, total: int | None) -> None:
        self._what, self._total, self._steps = what, total, 0
        self._last_s = time.monotonic()

    def __call__(self, text: str = "", share: float | None = None) -> None:
        self._steps += 1
        share = self._steps / self._total if share is None and self._total else share
        now_s = time.monotonic()
        if now_s - self._last_s < LINE_PERIOD_S:
            return
        self._last_s = now_s
        parts = [self._what, *([] if share is None else [f"{share:.0%}"]), *([text] if text else [])]
        print(f"fgtrack: {', '.join(parts)}", file=sys.stderr, flush=True)


class TickProgress:
    """Tells how far replays have come, now and then.

    Parameters
    ----------
    tell
        Is told.
    end_ns
        When the recording ends; asked once the replay has taken a while.
    passes
        How often it is replayed.
    """

    def __init__(self, tell: Progress, end_ns: Callable[[], int | None] = lambda: None, passes: int = 1) -> None:
        self._tell, self._find_end, self._passes = tell, end_ns, passes
        self._first_ns: int | None = None
        self._last_ns = self._pass = self._count = 0
        self._started_s = time.monotonic()
        self._end_ns: int | None = None
        self._asked = False

    def __call__(self, now_ns: int, num_tracks: int) -> None:
        """After a tick."""
        if self._first_ns is None:
            self._first_ns = now_ns
        elif now_ns < self._last_ns:  # the next estimator begins
            self._pass += 1
            self._end_ns, self._asked = self._last_ns, True
        self._last_ns = now_ns
        self._count += 1
        if self._count % _TICKS:
            return
        if not self._asked and time.monotonic() - self._started_s >= SOON_S:
            self._end_ns, self._asked = self._find_end(), True
        done_ns = now_ns - self._first_ns
        self._tell(f"{done_ns / NS_PER_S:.1f} s of data, {num_tracks} tracks", self._share(done_ns))

    def _share(self, done_ns: int) -> float | None:
        if self._end_ns is None or self._first_ns is None or self._end_ns <= self._first_ns:
            return None
        return (self._pass + min(done_ns / (self._end_ns - self._first_ns), 1.0)) / self._passes


def told(messages: Sequence[Message], tell: Progress) -> Iterator[Message]:
    """`messages`, telling how many have been taken."""
    for number, message in enumerate(messages):
        if number % _MESSAGES == 0:
            tell("", number / len(messages))
        yield message
