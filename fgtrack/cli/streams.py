"""Standard output and standard error whose reader may leave."""

import sys
from contextlib import AbstractContextManager, ExitStack, redirect_stderr, redirect_stdout
from io import BufferedWriter, FileIO, TextIOWrapper, UnsupportedOperation
from typing import Any, TextIO

__all__ = ["standard_streams"]


def standard_streams() -> AbstractContextManager[object]:
    """Return a context in which no reader of stdout or stderr ends the program.

    Nothing is printed where a reader has left (`| head`): what goes to files is written all the same. A letter that a
    terminal does not know is printed as its escape.
    """
    streams = ExitStack()
    streams.enter_context(redirect_stdout(_lasting(sys.stdout)))
    streams.enter_context(redirect_stderr(_lasting(sys.stderr)))
    return streams


def _lasting(stream: TextIO) -> TextIO:
    try:
        file = BufferedWriter(_Abandonable(stream.fileno(), "w", closefd=False))
    except (AttributeError, UnsupportedOperation):  # closed (`>&-`), or in memory
        return stream
    stream.flush()
    return TextIOWrapper(file, stream.encoding, "backslashreplace", line_buffering=bool(stream.line_buffering))


class _Abandonable(FileIO):
    """A pipe whose reader may leave."""

    def write(self, data: Any, /) -> int:  # Any: what has bytes, which has no type in Python 3.11
        """See `io.FileIO.write`; without effect once the reader has left."""
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(data)
        except OSError as error:
            raise OSError(error.errno, error.strerror, "standard output or error") from error
