"""Text files that are read whole, up to a size that fits into memory."""

from pathlib import Path

from fgtrack.core.errors import DataError

__all__ = ["read_whole"]

_MEGABYTE = 1_000_000


def read_whole(path: Path, largest_mb: float) -> bytes:
    """The bytes of `path`.

    Raises `DataError` for a larger file, and where it cannot be read. What a parser makes of a byte can take thirty.
    """
    try:
        if path.is_fifo():
            raise DataError(f"{path}: is a pipe, give a file")
        if path.stat().st_size > largest_mb * _MEGABYTE:
            raise DataError(f"{path}: is larger than {largest_mb:g} MB, more than such a file holds")
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from error
