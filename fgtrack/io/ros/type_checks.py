"""Checks what message definitions say: names, plain numbers, and how much a message of a type can become.

rosbags generates Python code from a definition and runs it. What a recording brings must not become anything but names
and numbers there, nor more code and more objects than any message needs.
"""

import math
import re
from collections import Counter
from dataclasses import dataclass, replace
from typing import cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Constdefs, Fielddefs, FieldDesc, Typesdict
from rosbags.typesys.base import normalize_fieldname

__all__ = ["ARRAY_VALUES", "Load", "check_definition", "check_type_name", "load_of", "named_types"]

_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_MEMBER_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_BASE_NAME = re.compile(r"[a-z]+[0-9]*", re.ASCII)
_LONGEST_NAME = 255
_MOST_MEMBERS = 2_000
_LONGEST_ARRAY = 1_000_000
_INTEGERS = range(-(1 << 63), 1 << 64)
_MOST_CODE = 4_000
"""Members, types, and what arrays of texts or messages have, of a type with all that it is made of; some ms each."""
_MOST_VALUES = 10_000
_DEEPEST = 50
_TEXTS = ("string", "wstring")
_TEXT_BYTES, _LENGTH_BYTES, _BYTES_PER_TEXT_VALUE = 4, 4, 16
ARRAY_VALUES = 3
"""What an array of NumPy counts as, by the memory that it takes."""


def check_type_name(name: str) -> None:
    """Raise `ValueError` unless `name` is that of a message type."""
    if len(name) > _LONGEST_NAME or not _TYPE_NAME.fullmatch(name):
        raise ValueError(f"{name[:_LONGEST_NAME]!a} is no name of a message type")


def check_definition(name: str, definition: tuple[Constdefs, Fielddefs]) -> None:
    """Raise `ValueError` unless all names of a definition are such, and its values plain."""
    constants, members = definition
    check_type_name(name)
    if len(constants) + len(members) > _MOST_MEMBERS:
        raise ValueError(f"{name} has more than {_MOST_MEMBERS} members")
    names = [*(constant[0] for constant in constants), *(one[0] for one in members)]
    for member in names:
        if len(member) > _LONGEST_NAME or not _MEMBER_NAME.fullmatch(member) or member.startswith("__"):
            raise ValueError(f"{member[:_LONGEST_NAME]!a} is no name of a member")
    for member, count in Counter(map(normalize_fieldname, names)).items():
        if count > 1:
            raise ValueError(f"{name} has the member {member} twice")
    for member, kind, value in constants:
        if not _is_plain(value) or not _BASE_NAME.fullmatch(kind):
            raise ValueError(f"the constant {member} is no plain value")
    for member, description in members:
        _check_description(member, description)


def _is_plain(value: object) -> bool:
    if type(value) is int:
        return value in _INTEGERS
    return math.isfinite(value) if type(value) is float else type(value) in (bool, str)


def _check_description(member: str, description: FieldDesc) -> None:
    kind, value = description
    if kind == Nodetype.BASE:
        base, size = cast("tuple[str, int]", value)
        if not _BASE_NAME.fullmatch(base) or not 0 <= int(size) <= _LONGEST_ARRAY:
            raise ValueError(f"{member} is of no known type")
    elif kind == Nodetype.NAME:
        check_type_name(cast("str", value))
    else:
        inner, size = cast("tuple[FieldDesc, int]", value)
        if not 0 <= int(size) <= _LONGEST_ARRAY:
            raise ValueError(f"{member} is longer than {_LONGEST_ARRAY}")
        _check_description(member, inner)


def named_types(description: FieldDesc) -> list[str]:
    """The message types that a member consists of, none or one."""
    kind, value = description
    if kind == Nodetype.NAME:
        return [cast("str", value)]
    if kind == Nodetype.BASE:
        return []
    return named_types(cast("tuple[FieldDesc, int]", value)[0])  # an array or a sequence, with its size


@dataclass(frozen=True)
class Load:
    """How many values (numbers, texts, messages, lists) are made of a serialized message, at most."""

    values: int
    """Of the shortest message."""
    num_bytes: int
    """Of the shortest message."""
    per_byte: float
    """Values that any further byte can add."""
    texts_per_byte: float
    """Of them texts, in lists or by their length."""

    def most_values(self, num_bytes: int) -> float:
        """Of a message of so many bytes."""
        return self.values + self.per_byte * num_bytes

    def most_texts(self, num_bytes: int) -> float:
        """Of a message of so many bytes."""
        return self.texts_per_byte * num_bytes


def load_of(name: str, types: Typesdict, ros1: bool) -> Load:
    """The load of messages of the type `name`, which `types` defines with all that it is made of.

    Raises
    ------
    ValueError
        It would take more code, or more values of nothing, than any message: arrays of texts and messages are
        unrolled, and what has no bytes could be there without end.
    """
    code = len(types)
    for _, members in types.values():
        for member, description in members:
            code += 1 + _unrolled(description)
            if code > _MOST_CODE:
                raise ValueError(
                    f"{member}: with it {name} has more than {_MOST_CODE} members, counting what is in arrays"
                )
    return _Loads(types, ros1).of_type(name, 0)


def _unrolled(description: FieldDesc) -> int:
    kind, value = description
    if kind != Nodetype.ARRAY:
        return 0
    inner, size = cast("tuple[FieldDesc, int]", value)
    return 0 if _is_number(inner) else int(size)


def _is_number(description: FieldDesc) -> bool:
    return description[0] == Nodetype.BASE and description[1][0] not in _TEXTS


class _Loads:
    """Loads of types, each found once."""

    def __init__(self, types: Typesdict, ros1: bool) -> None:
        self._types = types
        self._empty_bytes = 0 if ros1 else 1  # CDR gives a message without members one
        self._known: dict[str, Load] = {}

    def of_type(self, name: str, depth: int) -> Load:
        if depth > _DEEPEST:
            raise ValueError(f"{name} is nested more than {_DEEPEST} times, or contains itself")
        if name not in self._known:
            members = [self._of(member, field, depth) for member, field in self._types[name][1]]
            values = 1 + sum(each.values for each in members)
            num_bytes = sum(each.num_bytes for each in members) if members else self._empty_bytes
            if values > _MOST_VALUES:
                raise ValueError(f"{name} has more than {_MOST_VALUES} values")
            per_byte = max((each.per_byte for each in members), default=0.0)
            texts_per_byte = max((each.texts_per_byte for each in members), default=0.0)
            self._known[name] = Load(values, num_bytes, per_byte, texts_per_byte)
        return self._known[name]

    def _of(self, member: str, description: FieldDesc, depth: int) -> Load:
        kind, value = description
        if kind == Nodetype.NAME:
            return self.of_type(cast("str", value), depth + 1)
        if kind == Nodetype.BASE:
            if _is_number(description):
                return Load(1, _size(description), 0.0, 0.0)
            return Load(1, _TEXT_BYTES, 1.0 / _BYTES_PER_TEXT_VALUE, 1.0 / _BYTES_PER_TEXT_VALUE)
        inner, size = cast("tuple[FieldDesc, int]", value)
        if _is_number(inner):  # an array of NumPy, whatever its length
            num_bytes = _size(inner) * int(size) if kind == Nodetype.ARRAY else _LENGTH_BYTES
            return Load(ARRAY_VALUES, num_bytes, 0.0, 0.0)
        one = self._of(member, inner, depth)
        if one.num_bytes == 0:
            raise ValueError(f"{member} is a list of what has no bytes")
        if kind == Nodetype.ARRAY:
            return replace(one, values=1 + int(size) * one.values, num_bytes=int(size) * one.num_bytes)
        in_list = one.values / one.num_bytes
        texts_per_byte = in_list if inner[0] == Nodetype.BASE else one.texts_per_byte
        return Load(1, _LENGTH_BYTES, max(one.per_byte, in_list), texts_per_byte)


def _size(description: FieldDesc) -> int:
    """Bytes of a number; of a type whose name does not end with its bits 1, the least that any has."""
    bits = re.search(r"[0-9]+$", cast("str", description[1][0]))
    return max(1, int(bits[0]) // 8) if bits else 1
