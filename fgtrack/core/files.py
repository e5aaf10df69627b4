"""Opening and reading of files that a user names: regular files only, up to a size that fits into memory."""

import errno
from collections.abc import Iterator
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO

from fgtrack.core.errors import DataError

GZIP_MAGIC = b"\x1f\x8b"
_PIECE = 2**24
"""Bytes that one read takes."""


def open_file(path: Path) -> BinaryIO:
    """Open `path` for reading bytes.

    Raises `OSError` if it cannot be opened. A pipe or a device is refused too, because
    reading may never end.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise OSError(errno.ENOTSUP, "is a pipe or a device, give a file", str(path))
    return path.open("rb")


def open_text(
    path: Path, encoding: str = "utf-8", newline: str | None = None
) -> TextIOWrapper:
    """Open `path` for reading text; raises as `open_file`."""
    return TextIOWrapper(open_file(path), encoding=encoding, newline=newline)


def _pieces(file: BinaryIO, most: int) -> Iterator[bytes]:
    """Yield the next bytes of a file, at most `most`. A single read would reserve memory for all of them."""
    while most > 0 and (piece := file.read(min(most, _PIECE))):
        yield piece
        most -= len(piece)


def read_whole(path: Path, largest_mb: float) -> bytes:
    """Return the content of `path`.

    Raises `DataError` if the file is larger than `largest_mb` or cannot be read.
    """
    largest = int(largest_mb * 1e6)
    try:
        with open_file(path) as file:
            content = b"".join(_pieces(file, largest + 1))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
    if len(content) > largest:
        raise DataError(
            f"{path}: is larger than {largest_mb:g} MB, more than a file of this kind has"
        )
    return content
