"""Files that somebody named: opened where they are files, and read up to a size that fits into memory."""

import errno
import os
import stat
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO

from fgtrack.core.errors import DataError

__all__ = ["open_file", "open_text", "read_whole"]

_MEGABYTE = 1_000_000


def open_file(path: Path) -> BinaryIO:
    """`path` opened for reading bytes.

    Raises `OSError`, also for what is no file: a pipe would be waited for, a device has no end.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # does not wait for whoever writes into a pipe
    mode = os.fstat(descriptor).st_mode
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        raise OSError(errno.ENOTSUP, "is a pipe or a device, give a file", str(path))
    return os.fdopen(descriptor, "rb")


def open_text(path: Path, encoding: str = "utf-8", newline: str | None = None) -> TextIOWrapper:
    """`path` opened for reading text; raises as `open_file`."""
    return TextIOWrapper(open_file(path), encoding=encoding, newline=newline)


def read_whole(path: Path, largest_mb: float) -> bytes:
    """The bytes of `path`.

    Raises `DataError` for a larger file, and where it cannot be read. What a parser makes of a byte can take thirty.
    """
    largest = int(largest_mb * _MEGABYTE)
    try:
        with open_file(path) as file:
            is_larger = os.fstat(file.fileno()).st_size > largest
            content = b"" if is_larger else file.read(largest + 1)  # a file of /proc says that it has no bytes
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if is_larger or len(content) > largest:
        raise DataError(f"{path}: is larger than {largest_mb:g} MB, more than such a file holds")
    return content
