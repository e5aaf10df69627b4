"""Errors of readers in words, and the error of an input that breaks off in the middle."""

import re
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

from fgtrack.core.errors import DataError

_T = TypeVar("_T")


def one_line(error: BaseException) -> str:
    """Text of `error` in one line of at most 200 characters."""
    return " ".join(str(error)[:2000].split())[:200] or type(error).__name__


#: What the type of a value is called in a file.
_IN_FILES = {
    "NoneType": "null",
    "bool": "true or false",
    "str": "a text",
    "string": "a text",
    "bytes": "bytes",
    "dict": "an object with names",
    "list": "a list",
    "tuple": "a list",
    "ndarray": "an array",
    **dict.fromkeys(("int", "float", "Decimal", "decimal.Decimal"), "a number"),
}
#: The type of the rejected value in Python's messages.
_FOUND = re.compile(
    r"^'([\w.]+)' object|^(string|list|tuple) indices|, not '([\w.]+)'$|cannot unpack .*? ([\w.]+) object"
)
_OTHER_LENGTH = re.compile(r"values to unpack|^zip\(\) argument|index out of range")


def cause(error: BaseException) -> str:
    """Return the complaint of a reader's exception about a value, in words and on one line."""
    text = one_line(error)
    if isinstance(error, KeyError):
        return (
            f"{error.args[0]!r:.60} is missing" if error.args else "a name is missing"
        )
    if isinstance(error, TypeError | AttributeError):
        found = _FOUND.search(text)
        name = next(filter(None, found.groups())) if found else ""
        return f"{_IN_FILES.get(name, 'a value')} where the format has something else"
    if isinstance(error, UnicodeDecodeError):
        return "bytes that are not text in UTF-8"
    if isinstance(error, RecursionError):
        return "values are nested too deeply"
    if _OTHER_LENGTH.search(text):
        return "a list has another length"
    if isinstance(error, ArithmeticError):
        return "a number is out of range"
    return text


class TruncatedInput(DataError):  # noqa: N818 - it names what the input is; the readers have given all before it
    """An input broke off; everything before has been yielded. A replay finishes the run with it and exits with 1."""


class UntilBreak(Generic[_T]):
    """Iterates over messages up to the end or a break (a `DataError` not before the first), whose error it keeps."""

    def __init__(self, messages: Iterable[_T]) -> None:
        self._messages = messages
        self.error: DataError | None = None

    def __iter__(self) -> Iterator[_T]:
        count = 0
        try:
            for message in self._messages:
                yield message
                count += 1
        except DataError as error:
            if not count and not isinstance(error, TruncatedInput):
                raise
            self.error = error

    def raise_error(self) -> None:
        """Raise the error of the break, if there was one."""
        if self.error:
            raise self.error
