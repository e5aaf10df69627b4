"""Errors that a user sees as one line: what is wrong, where, and what to do."""

import difflib
from collections.abc import Iterable

_LONGEST, _TAIL = 700, 250


class FgtrackError(Exception):
    """Base of every error that the package raises on purpose; its text is `one_line`."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class DataError(FgtrackError):
    """An input or a run is bad (exit code 1)."""


class CallError(FgtrackError, ValueError):
    """The call or the configuration is bad (exit code 2); of a configuration file, pydantic adds the key."""


def did_you_mean(name: object, known: Iterable[object]) -> str:
    """Suffix of a message on a `name` that is not among the `known` ones; empty where none is similar."""
    near = difflib.get_close_matches(str(name), [str(each) for each in known], n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def one_line(text: str) -> str:
    """`text` on one line, escaped (it holds names from files), of a long one the beginning and the end."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST - _TAIL]} ... {text[-_TAIL:]}"
    return printable(
        " ".join(text.split()) if any(space in text for space in "\n\r\t\v\f") else text
    )


def printable(text: str) -> str:
    """`text` with escapes for what is neither a letter nor a sign."""
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def printable_lines(text: str) -> str:
    """`text` with escapes for what is neither a letter, a sign nor an end of line."""
    return "\n".join(map(printable, text.split("\n")))
