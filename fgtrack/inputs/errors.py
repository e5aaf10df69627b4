"""Plain messages for exceptions of readers, and the error of an input that breaks off."""

import re
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

from fgtrack.core.errors import DataError

_T = TypeVar("_T")


def one_line(error: BaseException) -> str:
    """Return the text of `error` on one line of at most 200 characters; the type's name if there is no text."""
    return " ".join(str(error)[:2000].split())[:200] or type(error).__name__


#: Words for the type of a value in a file.
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
#: Matches Python's messages that contain the type of the rejected value.
_REJECTED_TYPE = re.compile(
    r"^'([\w.]+)' object|^(string|list|tuple) indices|, not '([\w.]+)'$|cannot unpack .*? ([\w.]+) object"
)
_OTHER_LENGTH = re.compile(r"values to unpack|^zip\(\) argument|index out of range")


def cause(error: BaseException) -> str:
    """Describe a reader's exception about a value in plain words, on one line."""
    text = one_line(error)
    if isinstance(error, KeyError):
        return (
            f"{error.args[0]!r:.60} is missing" if error.args else "a name is missing"
        )
    if isinstance(error, TypeError | AttributeError):
        match = _REJECTED_TYPE.search(text)
        name = next(filter(None, match.groups())) if match else ""
        return f"{_IN_FILES.get(name, 'a value')} where the format has another type of value"
    if isinstance(error, UnicodeDecodeError):
        return "bytes that are not text in UTF-8"
    if isinstance(error, RecursionError):
        return "values are nested too deeply"
    if _OTHER_LENGTH.search(text):
        return "a list has another length"
    if isinstance(error, ArithmeticError):
        return "a number is out of range"
    return text


class TruncatedInput(DataError):  # noqa: N818 - the name describes the input
    """An input broke off; all messages before the break have been yielded.

    A replay finishes the run with these messages and exits with code 1.
    """


class UntilBreak(Generic[_T]):
    """Iterator over messages. A `DataError` ends it as the last message does, and is kept in `error`.

    A `DataError` before the first message is raised, unless it is a `TruncatedInput`.
    """

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
        """Raise the `DataError` that ended the messages; do nothing if they ended regularly."""
        if self.error:
            raise self.error
