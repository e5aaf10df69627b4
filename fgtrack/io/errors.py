"""The error of an input that breaks off in the middle, and how to work with what comes before the break."""

from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

from fgtrack.core.errors import DataError

_T = TypeVar("_T")


def one_line(error: BaseException) -> str:
    """Text of `error` in one line of at most 200 characters."""
    return " ".join(str(error)[:2000].split())[:200] or type(error).__name__


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
