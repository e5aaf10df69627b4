"""A process that runs commands in forks of itself, so that each costs what it does and not what it imports.

As a script it answers every line of stdin, an `Order` as JSON, by a line with its `Outcome`.
"""

import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module
from pathlib import Path

#: What a process does to files, as Python's audit events; writing into an open file is none.
_CHANGES = (
    "open",
    "os.rename",
    "os.remove",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.truncate",
    "sqlite3.connect",
)


@dataclass(frozen=True)
class Order:
    """A command, and what is to disturb it."""

    words: list[str]
    folder: str
    """Where it runs."""
    kill_after_s: float | None = None
    kill_at_change: int | None = None
    """Kill it right before so many files were opened for writing, renamed, removed or made; -1 only counts them."""
    largest_file: int | None = None
    """Bytes of a file from which on writing fails."""
    user: int | None = None
    """Number of the user that it runs as."""
    out: str | None = None
    """Where stdout goes."""
    call: str = "fgtrack.cli.main:run"
    """Module and function that gets the words and gives the exit code."""


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    """-9 for a killed one."""
    took_s: float
    said: str
    changes: int | None
    """Counted, where that was asked for."""
    peak_mb: float = 0.0
    """Most memory that it had, with what this process has from the start."""
    cpu_s: float = 0.0
    """Of the processor, however busy it is with other things."""


class Server:
    """The process, as seen by a test."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._read() == "ready"

    def __call__(
        self, words: Sequence[str], folder: Path, **disturbed: object
    ) -> Outcome:
        """Run a command in `folder`; `disturbed` are fields of `Order`."""
        assert self._process.stdin is not None
        order = Order(list(words), str(folder), **disturbed)  # type: ignore[arg-type]  # as the caller names them
        self._process.stdin.write(json.dumps(asdict(order)) + "\n")
        self._process.stdin.flush()
        return Outcome(**json.loads(self._read()))

    def _read(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def close(self) -> None:
        """End it."""
        with self._process:  # closes its pipes, which ends it
            pass


def serve() -> None:
    """Answer every line of stdin until its end."""
    _warm_up()
    _answer("ready")
    for line in sys.stdin:
        _answer(json.dumps(asdict(_outcome(Order(**json.loads(line))))))


def _answer(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _warm_up() -> None:
    """Import what the commands import."""
    import fgtrack.cli.sweep  # noqa: F401
    from fgtrack.cli.main import run

    with tempfile.TemporaryDirectory() as folder, open(os.devnull, "w") as nowhere:
        standard, sys.stdout = sys.stdout, nowhere
        stream = f"{folder}/x.jsonl"
        assert (
            run(["simulate", "single_opponent", "--duration", "1", "-o", stream]) == 0
        )
        for storage in ("mcap", "sqlite3"):
            assert (
                run(["convert", stream, f"{folder}/{storage}", "--storage", storage])
                == 0
            )
        assert run(["convert", f"{folder}/mcap", f"{folder}/y.jsonl.gz"]) == 0
        assert (
            run(
                [
                    "replay",
                    stream,
                    "-c",
                    "smoother",
                    "--map",
                    "oval",
                    "-o",
                    f"{folder}/run",
                ]
            )
            == 0
        )
        assert run(["compare", f"{folder}/run"]) == 0
        sys.stdout = standard


def _outcome(order: Order) -> Outcome:
    began_s = time.monotonic()
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as counted:
        pid = os.fork()
        if pid == 0:
            _child(order, said.fileno(), counted.fileno())
        watched = select.poll()
        watched.register(os.pidfd_open(pid), select.POLLIN)
        if not watched.poll(
            None if order.kill_after_s is None else 1e3 * order.kill_after_s
        ):
            os.kill(pid, signal.SIGKILL)
        _, status, used = os.wait4(pid, 0)
        code = os.waitstatus_to_exitcode(status)
        took_s = time.monotonic() - began_s
        said.seek(0)
        counted.seek(0)
        text = said.read().decode(errors="replace")
        changes = int(counted.read() or b"-1")
    return Outcome(
        code,
        took_s,
        text,
        None if changes < 0 else changes,
        used.ru_maxrss / 1000.0,
        used.ru_utime + used.ru_stime,
    )


def _child(order: Order, said: int, counted: int) -> None:
    code = 70
    try:
        module, _, function = order.call.partition(":")
        run = getattr(import_module(module), function)
        os.chdir(order.folder)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(said if order.out is None else os.open(order.out, os.O_WRONLY), 1)
        os.dup2(said, 2)
        sys.stdout, sys.stderr = (
            os.fdopen(number, "w", closefd=False) for number in (1, 2)
        )
        if order.largest_file is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (order.largest_file,) * 2)
        if order.user is not None:
            os.setgroups([])
            os.setgid(order.user)
            os.setuid(order.user)
        changes = (
            (lambda: -1)
            if order.kill_at_change is None
            else _kill_at(order.kill_at_change)
        )
        code = run(order.words)
        os.write(counted, str(changes()).encode())
        sys.stderr.flush()
        sys.stdout.flush()
    finally:
        os._exit(code)


def _kill_at(number: int) -> Callable[[], int]:
    """Kill this process before a change of files; gives how many there were so far."""
    seen = 0

    def look(event: str, arguments: tuple[object, ...]) -> None:
        nonlocal seen
        if event not in _CHANGES or (event == "open" and not _writes(arguments)):
            return
        if seen == number:
            os.kill(os.getpid(), signal.SIGKILL)
        seen += 1

    sys.addaudithook(look)
    return lambda: seen


def _writes(arguments: tuple[object, ...]) -> bool:
    flags = arguments[2]
    return isinstance(flags, int) and bool(
        flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    )


if __name__ == "__main__":
    sys.path[0] = str(
        Path(__file__).parents[1]
    )  # beside this file lies a module `mcap`
    serve()
