"""What commands show: tables on stdout, progress on stderr where that is a terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

_WIDTH_WITHOUT_TERMINAL = 120


def console() -> Console:
    """Stdout; wide enough for every table where it is a file or a pipe."""
    probe = Console()
    return probe if probe.is_terminal else Console(width=_WIDTH_WITHOUT_TERMINAL)


@contextmanager
def progress(what: str) -> Iterator[Callable[[str], None]]:
    """A bar that moves while the block runs; the function given sets the text beside it."""
    stderr = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=stderr, disable=not stderr.is_terminal, transient=True) as bar:
        task = bar.add_task(what, total=None)
        yield lambda text: bar.update(task, description=f"{what} {text}")


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
