"""The message types of a recording: of rosbags, of fgtrack, of the user, and embedded in the recording.

rosbags generates Python code from a definition and runs the code. So only names and
numbers of a recording may get into a definition.
"""

import math
import re
from collections import ChainMap
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, cast

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import (
    Stores,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_whole
from fgtrack.inputs.errors import one_line
from fgtrack.inputs.ros.definitions import DEFINITIONS
from fgtrack.inputs.ros.own_messages import LITTLE_ENDIAN, has_own_layout, own_message

Key = tuple[str, MessageDefinition | None]
"""A message type and its definition in the recording; two topics may define the same name differently."""

_LARGEST_BYTES = 32_000_000
"""Largest message that is decoded: object lists are far smaller, and a byte takes up to a hundred bytes of memory."""
_LONGEST_TEXT = 200_000
"""Longest definition in characters."""
_MOST_VALUES = 4_000
"""Most values of a type with all its parts: rosbags generates code for each element of an array of texts."""
_LONGEST_ARRAY = 1_000_000
_INTEGERS = range(-(1 << 63), 1 << 64)
_TYPE_NAME = re.compile(r"(?!.{256})[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_MEMBER_NAME = re.compile(r"(?!__|.{256})[A-Za-z_]\w*", re.ASCII)
_BASE_NAME = re.compile(r"[a-z]+[0-9]*", re.ASCII)
_SEPARATOR = "=" * 80 + "\n"
_EMPTY_LINE = re.compile(r"^[ \t]*(?:#[^\n]*)?\n", re.MULTILINE)
# An unclosed text or remark matches up to the end of the input. Otherwise every later start would search for its end.
_IDL_TEXT = re.compile(r'"(?:\\.|[^"\\])*(?:"|\\?\Z)', re.DOTALL)
_IDL_REMARK = re.compile(
    r"/\*.*?(?:\*/|\Z)|//[^\n]*|^#[^\n]*|@\s*[\w:]*(?:\s*\([^()]*\))?",
    re.DOTALL | re.MULTILINE,
)
_IDL_COSTLY = re.compile(r"=[^;=()*/%|^&~<]*[()*/%|^&~<]|(?:sequence\s*<\s*){4}")


class MessageTypes:
    """Decodes messages of the given types, each by the definition in its recording.

    Precedence: the definition embedded for the type, definitions embedded for other
    types, then definitions of the user, of fgtrack and of rosbags.
    """

    def __init__(
        self, keys: Iterable[Key], ros1: bool, message_definitions: Iterable[str] = ()
    ) -> None:
        self._ros1 = ros1
        self.types: dict[Key, Typesdict] = {}
        """Types that can be decoded, each with all its parts."""
        self._stores: dict[Key, Typestore] = {}
        self.problems: dict[Key, str] = {}
        """Reason why messages of a type cannot be decoded."""
        given: Typesdict = {}
        for path in message_definitions:
            given |= _user_types(Path(path))
        embedded: dict[Key, Typesdict] = {}
        for key in sorted(set(keys), key=str):
            try:
                embedded[key] = _embedded(*key)
            except Exception as error:  # the parser raises any exception
                self.problems[key] = (
                    f"its embedded definition cannot be read ({one_line(error)})"
                )
        for key, types in embedded.items():
            try:
                self.types[key] = _closure(
                    key[0],
                    ChainMap(types, *embedded.values(), given, _shipped_types(ros1)),
                )
            except (ValueError, RecursionError) as error:
                self.problems[key] = str(error)
        self._in_own_layout = {
            key
            for key, types in self.types.items()
            if not ros1 and has_own_layout(key[0], types)
        }

    def starts_with_header(self, key: Key) -> bool:
        """True if messages of the type can be decoded and begin with a header."""
        members = self.types[key][key[0]][1] if key in self.types else []
        return bool(members) and members[0][1][1] == "std_msgs/msg/Header"

    def decode(
        self, key: Key, data: bytes, what: str, log_ns: int | None = None
    ) -> Any:  # Any: an instance of the message type
        """Decode `data`; raises `DataError`, which begins with `what`, for a huge or malformed message.

        With `log_ns`, a message of fgtrack's own types in the present layout is decoded
        to a `Message`.
        """
        if len(data) > _LARGEST_BYTES:
            raise DataError(
                f"{what}: has {len(data)} bytes, at most {_LARGEST_BYTES} are decoded"
            )
        try:
            if (
                log_ns is not None
                and key in self._in_own_layout
                and data.startswith(LITTLE_ENDIAN)
            ):
                return own_message(key[0], data, log_ns)
            if key not in self._stores:
                self._stores[key] = _registered(self.types[key])
            store = self._stores[key]
            if self._ros1:
                return store.deserialize_ros1(data, key[0])
            return store.deserialize_cdr(data, key[0])
        except MemoryError:
            raise
        except Exception as error:  # wrong bytes cause any exception in the decoder
            raise DataError(f"{what} is not a {key[0]} ({one_line(error)})") from error


@cache
def typestore_of(names: tuple[str, ...]) -> Typestore:
    """Return a type store with the shipped ROS 2 types `names` and all their parts."""
    needed: Typesdict = {}
    for name in names:
        needed |= _closure(name, _shipped_types(False))
    return _registered(needed)


def _registered(types: Typesdict) -> Typestore:
    store = Typestore()
    store.register(types)
    return store


def _closure(name: str, known: Mapping[str, Any]) -> Typesdict:
    """Return the type `name` with all its parts; raises `ValueError` for an undefined, recursive or too large type."""
    needed: Typesdict = {}
    sizes: dict[str, int] = {}

    def size_of(description: FieldDesc) -> int:
        kind, value = description
        if kind == Nodetype.BASE:
            return 1
        if kind == Nodetype.NAME:
            return size_of_type(cast("str", value))
        inner, count = cast("tuple[FieldDesc, int]", value)
        size = size_of(inner)
        fixed = int(count) if kind == Nodetype.ARRAY else 1
        if kind == Nodetype.SEQUENCE and size == 0:
            raise ValueError(f"{name} has a list whose elements are empty")
        is_number = inner[0] == Nodetype.BASE and cast("tuple[str, int]", inner[1])[
            0
        ] not in ("string", "wstring")
        # Numbers become one NumPy array.
        return size * (min(fixed, 1) if is_number else fixed)

    def size_of_type(current: str) -> int:
        if current not in sizes:
            try:
                needed[current] = known[current]
            except KeyError as error:
                raise ValueError(
                    f"the definition of {current or 'a type without a name'} is not in the recording, "
                    "give its .msg file in message_definitions"
                ) from error
            # Until the size is computed. So a type that contains itself is too large.
            sizes[current] = _MOST_VALUES + 1
            sizes[current] = sum(
                size_of(description) for _, description in known[current][1]
            )
        if sizes[current] > _MOST_VALUES:
            raise ValueError(
                f"{name} has more than {_MOST_VALUES} values, or contains itself"
            )
        return sizes[current]

    size_of_type(name)
    return needed


class _ShippedTypes(dict[str, Any]):  # Any: a type in the form of rosbags
    """Types of fgtrack, else of rosbags, by name; each is defined at its first use, because rosbags has many."""

    def __init__(self, ros1: bool) -> None:
        super().__init__()
        self._ros1 = ros1

    def __missing__(self, name: str) -> Any:
        definition = DEFINITIONS.get(name)
        if definition is not None:
            self |= get_types_from_msg(definition, name)
        else:
            self[name] = _types_of_rosbags(self._ros1)[name]
        return self[name]


_shipped_types = cache(_ShippedTypes)


@cache
def _types_of_rosbags(ros1: bool) -> Typesdict:
    # Recordings without definitions are from Humble or older.
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE).fielddefs


def _user_types(path: Path) -> Typesdict:
    types: Typesdict = {}
    for file in sorted(path.rglob("*.msg")) if path.is_dir() else [path]:
        package = (
            file.parent.parent.name if file.parent.name == "msg" else file.parent.name
        )
        try:
            types |= checked(
                get_types_from_msg(
                    read_whole(file, 1.0).decode(), f"{package}/msg/{file.stem}"
                )
            )
        except Exception as error:  # the parser raises any exception
            raise CallError(
                f"{file}: is not a message definition ({one_line(error)})"
            ) from error
    return types


def _embedded(name: str, definition: MessageDefinition | None) -> Typesdict:
    """Return the types that the `definition` of the type `name` defines.

    Empty without a text, and for another language than MSG and IDL. Raises `ValueError` for a text that is too long or
    invalid.
    """
    form, text = (
        (None, "") if definition is None else (definition.format, definition.data)
    )
    if (
        form not in (MessageDefinitionFormat.MSG, MessageDefinitionFormat.IDL)
        or not text.strip()
    ):
        return {}
    if len(text) > _LONGEST_TEXT:
        raise ValueError(f"it has more than {_LONGEST_TEXT} characters")
    _check_type_name(name)
    if form == MessageDefinitionFormat.MSG:
        return checked(get_types_from_msg(_EMPTY_LINE.sub("", f"{text}\n"), name))
    types: Typesdict = {}
    first, *others = text.split(_SEPARATOR)
    for part in (
        [part.partition("\n")[2] for part in others]
        if others and not first.strip()
        else [text]
    ):
        types |= checked(get_types_from_idl(_without_remarks(part)))
    return types


def _without_remarks(text: str) -> str:
    """Return the IDL text without comments.

    Raises `ValueError` for a text that computes constants or nests sequences deeply: rosbags would parse it for
    minutes.
    """
    plain = _IDL_REMARK.sub(" ", _IDL_TEXT.sub('""', text))
    if _IDL_COSTLY.search(plain):
        raise ValueError(
            "it computes a constant or nests sequences: definitions of ROS do neither"
        )
    # rosbags would read the end of `sequence<string<9>>` as a shift operator.
    return plain.replace(">", "> ")


def checked(types: Typesdict) -> Typesdict:
    """Return `types`; raises `ValueError` unless all names in them are valid names and all constants plain values."""
    for name, (constants, members) in types.items():
        _check_type_name(name)
        names = [
            *(constant[0] for constant in constants),
            *(member[0] for member in members),
        ]
        for member in names:
            if not _MEMBER_NAME.fullmatch(member):
                raise ValueError(f"{member!a:.200} is not a valid name of a member")
        if len(set(map(normalize_fieldname, names))) < len(names):
            raise ValueError(f"{name} has two members with the same name")
        for member, kind, value in constants:
            is_number = (
                value in _INTEGERS
                if type(value) is int
                else type(value) is float and math.isfinite(value)
            )
            if not (
                is_number or type(value) in (bool, str)
            ) or not _BASE_NAME.fullmatch(kind):
                raise ValueError(f"the constant {member} is not a plain value")
        for member, description in members:
            node, inner = _innermost(description)
            if node == Nodetype.NAME:
                _check_type_name(cast("str", inner))
            elif not _BASE_NAME.fullmatch(cast("tuple[str, int]", inner)[0]):
                raise ValueError(f"{member} has an unknown type")
    return types


def _check_type_name(name: str) -> None:
    if not _TYPE_NAME.fullmatch(name):
        raise ValueError(f"{name!a:.200} is not a valid name of a message type")


def _innermost(description: FieldDesc) -> FieldDesc:
    """Return the type of the elements of nested arrays and sequences. Raises `ValueError` for too long an array."""
    while description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        description, size = cast("tuple[FieldDesc, int]", description[1])
        if not 0 <= int(size) <= _LONGEST_ARRAY:
            raise ValueError(f"an array is longer than {_LONGEST_ARRAY}")
    return description
