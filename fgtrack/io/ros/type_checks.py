"""Checks of message definitions: names, plain numbers and size.

rosbags generates Python code from a definition and runs it: what a recording brings must not become anything but names
and numbers there.
"""

import math
import re
from collections import Counter
from typing import cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Constdefs, Fielddefs, FieldDesc, Typesdict
from rosbags.typesys.base import normalize_fieldname

__all__ = ["check_definition", "check_size", "check_type_name", "named_types"]

_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_MEMBER_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_BASE_NAME = re.compile(r"[a-z]+[0-9]*", re.ASCII)
_LONGEST_NAME = 255
_MOST_MEMBERS = 2_000
_MOST_VALUES = 4_000
"""Of a type with all that it is made of; arrays of texts and messages become code for each element."""
_LONGEST_ARRAY = 1_000_000
_INTEGERS = range(-(1 << 63), 1 << 64)
_TEXTS = ("string", "wstring")


def check_type_name(name: str) -> None:
    """Raise `ValueError` unless `name` is that of a message type."""
    if len(name) > _LONGEST_NAME or not _TYPE_NAME.fullmatch(name):
        raise ValueError(f"{name[:_LONGEST_NAME]!a} is not a name of a message type")


def check_definition(name: str, definition: tuple[Constdefs, Fielddefs]) -> None:
    """Raise `ValueError` unless all names of a definition are names, and its constants plain values."""
    constants, members = definition
    check_type_name(name)
    if len(constants) + len(members) > _MOST_MEMBERS:
        raise ValueError(f"{name} has more than {_MOST_MEMBERS} members")
    names = [*(constant[0] for constant in constants), *(one[0] for one in members)]
    for member in names:
        if len(member) > _LONGEST_NAME or not _MEMBER_NAME.fullmatch(member) or member.startswith("__"):
            raise ValueError(f"{member[:_LONGEST_NAME]!a} is not a name of a member")
    for member, count in Counter(map(normalize_fieldname, names)).items():
        if count > 1:
            raise ValueError(f"{name} has the member {member} twice")
    for member, kind, value in constants:
        if not _is_plain(value) or not _BASE_NAME.fullmatch(kind):
            raise ValueError(f"the constant {member} is not a plain value")
    for member, description in members:
        _check_description(member, description)


def _is_plain(value: object) -> bool:
    if type(value) is int:
        return value in _INTEGERS
    return math.isfinite(value) if type(value) is float else type(value) in (bool, str)


def _check_description(member: str, description: FieldDesc) -> None:
    kind, value = description
    if kind == Nodetype.BASE:
        if not _BASE_NAME.fullmatch(cast("tuple[str, int]", value)[0]):
            raise ValueError(f"{member} is of an unknown type")
    elif kind == Nodetype.NAME:
        check_type_name(cast("str", value))
    else:
        inner, size = cast("tuple[FieldDesc, int]", value)
        if not 0 <= int(size) <= _LONGEST_ARRAY:
            raise ValueError(f"{member} is longer than {_LONGEST_ARRAY}")
        _check_description(member, inner)


def named_types(description: FieldDesc) -> list[str]:
    """Message types that a member consists of, none or one."""
    kind, value = description
    if kind == Nodetype.NAME:
        return [cast("str", value)]
    if kind == Nodetype.BASE:
        return []
    return named_types(cast("tuple[FieldDesc, int]", value)[0])  # an array or a sequence, with its size


def check_size(name: str, types: Typesdict) -> None:
    """Raise `ValueError` for a type that contains itself, or has more values than any message needs."""
    sizes: dict[str, int] = {}

    def size_of(description: FieldDesc) -> int:
        kind, value = description
        if kind == Nodetype.NAME:
            return size_of_type(cast("str", value))
        if kind == Nodetype.BASE:
            return 1
        inner, count = cast("tuple[FieldDesc, int]", value)
        is_number = inner[0] == Nodetype.BASE and cast("tuple[str, int]", inner[1])[0] not in _TEXTS
        if is_number:  # numbers become one NumPy array
            return 0 if kind == Nodetype.ARRAY and int(count) == 0 else 1
        size = size_of(inner)
        if kind == Nodetype.SEQUENCE and size == 0:
            raise ValueError(f"{name} has a list of elements without content")
        return size * int(count) if kind == Nodetype.ARRAY else size

    def size_of_type(current: str) -> int:
        if current not in sizes:
            sizes[current] = _MOST_VALUES + 1  # until it is known: a type that contains itself is too large
            sizes[current] = sum(size_of(field) for _, field in types[current][1])
        if sizes[current] > _MOST_VALUES:
            raise ValueError(f"{name} has more than {_MOST_VALUES} values, or contains itself")
        return sizes[current]

    size_of_type(name)
