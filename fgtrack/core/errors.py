"""Errors that a user sees as one line: what is wrong, where, and what to do."""

import difflib
import re
from collections.abc import Iterable

#: Longest message in characters, and the characters of its end that are kept if it is longer.
_LONGEST = 700
_TAIL = 250
#: A run of characters without a space that is longer than this keeps its two ends only.
_LONG_WORD = re.compile(r"\S{201,}")
_WORD_HEAD = 100
_WORD_TAIL = 60


class FgtrackError(Exception):
    """Base of all errors that the package raises on purpose; the message is one line (`one_line`)."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(str(message)))


class DataError(FgtrackError):
    """Error of an input or a run folder (exit code 1)."""


class CallError(FgtrackError, ValueError):
    """Error of a call or of the configuration (exit code 2).

    pydantic adds the key if the error belongs to a configuration file.
    """


def did_you_mean(name: object, known: Iterable[object]) -> str:
    """End of a message about an unknown `name`: ", did you mean 'x'?"; empty if no `known` name is similar."""
    near = difflib.get_close_matches(str(name), [str(each) for each in known], n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def one_line(text: str) -> str:
    """Return `text` on one line; control characters, which names from files may contain, are escaped.

    The middle of a long text, or of a long run of characters without a space, is left out.
    """
    text = _LONG_WORD.sub(_without_middle, text)
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST - _TAIL]} ... {text[-_TAIL:]}"
    return printable(
        " ".join(text.split()) if any(space in text for space in "\n\r\t\v\f") else text
    )


def _without_middle(match: re.Match[str]) -> str:
    """Return the beginning and the end of a long word, with `...` between them."""
    word = match[0]
    return f"{word[:_WORD_HEAD]}...{word[-_WORD_TAIL:]}"


def printable(text: str) -> str:
    """Return `text` with escapes for characters that cannot be printed."""
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def printable_lines(text: str) -> str:
    """Return `text` with escapes for characters that cannot be printed; ends of lines stay."""
    return "\n".join(map(printable, text.split("\n")))
