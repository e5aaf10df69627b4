"""Entries of large JSON files one after the other, in the memory of the largest entry."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import ijson

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_file
from fgtrack.io.errors import one_line

__all__ = ["list_entries", "object_entries"]

# Parsed JSON, checked by who asks for it.
Json = Any


def list_entries(file: Path) -> Iterator[Json]:
    """The entries of `file`, a list. Raises `DataError` where it is not JSON."""
    with _reading(file) as content:
        yield from ijson.items(content, "item", use_float=True)


def object_entries(file: Path, name: str) -> Iterator[tuple[str, Json]]:
    """Keys and values of what `file`, an object, holds under `name`; raises as `list_entries`."""
    with _reading(file) as content:
        yield from ijson.kvitems(content, name, use_float=True)


@contextmanager
def _reading(file: Path) -> Iterator[BinaryIO]:
    try:
        with open_file(file) as content:
            yield content
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror})") from error
    except (ijson.JSONError, UnicodeDecodeError) as error:
        raise DataError(f"{file}: is not JSON of the expected form ({one_line(error)}), fetch it again") from error
