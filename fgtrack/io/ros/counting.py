"""Decodes large messages, and counts the values that they become while they do: a list says its length itself."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.interfaces.typing import Fielddefs
from rosbags.typesys.store import Typestore

from fgtrack.io.ros.type_checks import ARRAY_VALUES

__all__ = ["CountingStore", "TooManyError", "longest_list"]


class TooManyError(Exception):
    """A message has more values than allowed."""


class CountingStore(Typestore):
    """A store whose decoders raise `TooManyError` where a message has more than `most_values`, lists of texts aside."""

    def __init__(self, most_values: int) -> None:
        super().__init__()
        self._most_values = most_values
        self._count = 0

    def restart(self) -> None:
        """Count from 0 on, before a message."""
        self._count = 0

    def get_msgdef(self, typename: str) -> Msgdef[object]:
        """The decoders of a type, each counting; made once."""
        known = typename in self.cache
        made = super().get_msgdef(typename)
        if known:
            return made
        own = _own_values(self.fielddefs[typename][1])
        counted = replace(
            made,
            deserialize_cdr_le=self._counted(made.deserialize_cdr_le, own),
            deserialize_cdr_be=self._counted(made.deserialize_cdr_be, own),
            deserialize_ros1=self._counted(made.deserialize_ros1, own),
        )
        self.cache[typename] = counted
        return counted

    # The signature is that of code which rosbags generates.
    def _counted(self, decode: Callable[..., Any], own: int) -> Callable[..., Any]:
        def counted(*of: Any) -> Any:
            self._count += own
            if self._count > self._most_values:
                raise TooManyError
            return decode(*of)

        return counted


def _own_values(members: Fielddefs) -> int:
    """Values of a message itself: those of messages in it count themselves."""
    arrays = sum(kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) for _, (kind, _) in members)
    return 1 + len(members) + arrays * (ARRAY_VALUES - 1)


def longest_list(message: Any) -> int:  # a message has the attributes of its type
    """Length of the longest list in `message`, not looking into lists."""
    longest = 0
    for value in vars(message).values():
        if isinstance(value, list):
            longest = max(longest, len(value))
        elif hasattr(value, "__msgtype__"):
            longest = max(longest, longest_list(value))
    return longest
