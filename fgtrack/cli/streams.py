"""Standard output and standard error, whoever reads them: nobody, or somebody who leaves."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import Any, TextIO

__all__ = ["standard_streams"]


@contextmanager
def standard_streams() -> Iterator[None]:
    """Let everything be printed while the block runs, and let no reader end it.

    Nothing is printed where a stream is closed (`>&-`) or its reader has left (`| head`): what goes to files is written
    all the same. A letter that a terminal does not know is printed as its escape.
    """
    _occupy()
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _lasting(sys.stdout), _lasting(sys.stderr)
    try:
        yield
    finally:
        for stream, old in ((sys.stdout, before[0]), (sys.stderr, before[1])):
            if stream is not old:
                with suppress(OSError):  # where that mattered, `run` has flushed it before
                    stream.flush()
        sys.stdout, sys.stderr = before


def _occupy() -> None:
    """Let no file that is opened later take the place of a standard stream that is closed."""
    place = -1
    while place < 2:
        place = os.open(os.devnull, os.O_RDWR)
    os.close(place)


def _lasting(stream: TextIO | None) -> TextIO:
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")  # as long as the program runs
    if not isinstance(stream, TextIOWrapper):
        return stream
    stream.reconfigure(errors="backslashreplace")
    try:
        place = stream.fileno()
        stream.flush()
    except (OSError, ValueError):  # one of a test, in memory
        return stream
    if stream.isatty():
        return stream
    file = BufferedWriter(_Abandonable(place, "w", closefd=False))
    return TextIOWrapper(
        file,
        stream.encoding,
        stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


class _Abandonable(FileIO):
    """A pipe whose reader may leave."""

    def write(self, data: Any, /) -> int:  # Any: what has bytes, which has no type in Python 3.11
        """See `io.FileIO.write`; for nobody, where the reader has left."""
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(data)
        except OSError as error:
            raise OSError(error.errno, error.strerror, "standard output or error") from error
