"""Entries of large JSON files one after the other, in the memory of the largest entry."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from fgtrack.core.errors import DataError
from fgtrack.core.files import open_text

__all__ = ["list_entries", "object_entries"]

_BLOCK = 1 << 20
_LARGEST_ENTRY = 1 << 22
_GOES_ON = ("", *"0123456789.eE+-")  # behind what may be the beginning of a number
_LARGEST_FILE = 1 << 31

# Parsed JSON, checked by who asks for it.
Json = Any


def list_entries(file: Path) -> Iterator[Json]:
    """The entries of `file`, a list. Raises `DataError` where it is none, or an entry or the file is too large."""
    with _opened(file) as text:
        reader = _Reader(file, text)
        reader.take("[")
        while not reader.ends("]"):
            yield reader.value()


def object_entries(file: Path, name: str) -> Iterator[tuple[str, Json]]:
    """Keys and values of what `file`, an object, holds under `name`; raises as `list_entries`."""
    with _opened(file) as text:
        reader = _Reader(file, text)
        reader.take("{")
        while not reader.ends("}"):
            key = reader.value()
            reader.take(":")
            if key != name:
                reader.value()
                continue
            reader.take("{")
            while not reader.ends("}"):
                inner = reader.value()
                reader.take(":")
                yield inner, reader.value()
            return
    raise DataError(f"{file}: holds no {name}")


def _opened(file: Path) -> TextIO:
    try:
        if file.stat().st_size > _LARGEST_FILE:
            raise DataError(f"{file}: is larger than {_LARGEST_FILE / 1e9:.1f} GB, give it in parts")
        return open_text(file)
    except OSError as error:
        raise DataError(f"{file}: cannot be read ({error.strerror})") from error


class _Reader:
    """Values and signs of a JSON text, as they come."""

    def __init__(self, file: Path, text: TextIO) -> None:
        self._file = file
        self._text = text
        self._ahead = ""
        self._at = 0
        self._decoder = json.JSONDecoder()
        self._first = True

    def take(self, sign: str) -> None:
        """Go behind `sign`, which must come next."""
        if self._next() != sign:
            raise self._error(f"{sign!r} expected")
        self._at += 1
        self._first = True

    def ends(self, sign: str) -> bool:
        """Whether the list or object ends with `sign` here; else go to its next entry."""
        found = self._next()
        if found == sign:
            self._at += 1
            self._first = False
            return True
        if not self._first:
            self.take(",")
        self._first = False
        return False

    def value(self) -> Json:
        """The next value."""
        self._next()
        while True:
            try:
                value, end = self._decoder.raw_decode(self._ahead, self._at)
            except RecursionError as error:
                raise self._error("nested too deeply") from error
            except ValueError as error:
                if not self._more():
                    raise self._error(str(error)) from error
                continue
            if self._ahead[end : end + 1] in _GOES_ON and self._more():
                continue
            self._at = end
            self._first = False
            return value

    def _next(self) -> str:
        """The next sign that is no space; empty at the end."""
        while True:
            while self._at < len(self._ahead):
                if not self._ahead[self._at].isspace():
                    return self._ahead[self._at]
                self._at += 1
            self._ahead, self._at = "", 0
            if not self._more():
                return ""

    def _more(self) -> bool:
        """Read on, twice as far each time that an entry is not whole; False at the end of the file."""
        self._ahead, self._at = self._ahead[self._at :], 0
        if len(self._ahead) > _LARGEST_ENTRY:
            raise self._error(f"an entry of more than {_LARGEST_ENTRY >> 20} MB")
        try:
            block = self._text.read(max(_BLOCK, len(self._ahead)))
        except UnicodeDecodeError as error:
            raise self._error(f"no UTF-8 text, {error.reason}") from error
        self._ahead += block
        return bool(block)

    def _error(self, problem: str) -> DataError:
        return DataError(f"{self._file}: is not JSON of the expected form ({problem}), fetch it again")
