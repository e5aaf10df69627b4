"""The message types of a recording: rosbags', fgtrack's, the user's and those embedded in the recording.

rosbags generates Python code from a definition and runs it; its grammar admits names and plain values only.
"""

import re
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, cast

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_whole
from fgtrack.io.errors import one_line
from fgtrack.io.ros.definitions import DEFINITIONS

__all__ = ["Key", "MessageTypes", "type_name", "typestore_of"]

Key = tuple[str, MessageDefinition | None]
"""A message type and its definition in the recording: two topics may define one name differently."""

_SEPARATOR = "=" * 80 + "\n"
_EMPTY_LINE = re.compile(r"^[ \t]*(?:#[^\n]*)?\n", re.MULTILINE)
_IDL_TEXT = re.compile(r'"(?:\\.|[^"\\])*"')
_IDL_REMARK = re.compile(r"/\*.*?\*/|//[^\n]*|^#[^\n]*|@\s*[\w:]*(?:\s*\([^()]*\))?", re.DOTALL | re.MULTILINE)


def type_name(name: str) -> str:
    """Full name of a message type: `pkg/Type` becomes `pkg/msg/Type`."""
    package, _, base = name.partition("/")
    return name if "/" in base else f"{package}/msg/{base}"


class MessageTypes:
    """Decodes messages of the given types, each by the definition that came with it.

    Precedence: the definition embedded for the type, those embedded for others, the user's, fgtrack's, rosbags'.

    Raises `CallError` where one of the user's `message_definitions`, files or folders, cannot be read.
    """

    def __init__(self, keys: Iterable[Key], ros1: bool, message_definitions: Iterable[str] = ()) -> None:
        self._ros1 = ros1
        self.types: dict[Key, Typesdict] = {}
        """Types without a problem, each with all its parts."""
        self._stores: dict[Key, Typestore] = {}
        self.problems: dict[Key, str] = {}
        """Why messages of a type cannot be decoded."""
        known = dict(_shipped_types(ros1))
        for path in message_definitions:
            known |= _user_types(Path(path))
        embedded: dict[Key, Typesdict] = {}
        for key in sorted(set(keys), key=str):
            try:
                embedded[key] = _embedded(*key)
            except Exception as error:  # whatever an invalid definition makes the parser raise
                self.problems[key] = f"its embedded definition cannot be read ({one_line(error)})"
        shared: Typesdict = {}
        for types in embedded.values():
            shared = types | shared
        for key, types in embedded.items():
            try:
                self.types[key] = _closure(key[0], (types, shared, known))
            except ValueError as error:
                self.problems[key] = str(error)

    def decode(self, key: Key, data: bytes, what: str) -> Any:  # a message has the attributes of its type
        """Message that is serialized in `data`; `what` names it in the `DataError` of bytes of another type."""
        try:
            if key not in self._stores:
                self._stores[key] = _registered(self.types[key])
            store = self._stores[key]
            return (store.deserialize_ros1 if self._ros1 else store.deserialize_cdr)(data, key[0])
        except MemoryError:
            raise
        except Exception as error:  # whatever bytes of another type make the decoder raise
            raise DataError(f"{what} is not a {key[0]} ({one_line(error)})") from error


@cache
def typestore_of(names: tuple[str, ...]) -> Typestore:
    """One store of shipped ROS 2 types and all their parts."""
    needed: Typesdict = {}
    for name in names:
        needed |= _closure(name, [_shipped_types(False)])
    return _registered(needed)


def _registered(types: Typesdict) -> Typestore:
    store = Typestore()
    store.register(types)
    return store


def _closure(name: str, sources: Sequence[Typesdict]) -> Typesdict:
    """The type `name` with all its parts, each from the first of `sources` that has it.

    Raises `ValueError` for an undefined part.
    """
    needed: Typesdict = {}
    waiting = [name]
    while waiting:
        current = waiting.pop()
        definition = next((types[current] for types in sources if current in types), None)
        if definition is None:
            raise ValueError(
                f"the definition of {current or 'a type without a name'} is not in the recording, "
                "name its .msg file in message_definitions"
            )
        needed[current] = definition
        waiting += _parts(description for _, description in definition[1]) - needed.keys()
    return needed


def _parts(descriptions: Iterable[FieldDesc]) -> set[str]:
    """Names of the message types of members, or of their elements."""
    names = set()
    for kind, value in descriptions:
        while kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind, value = cast("tuple[FieldDesc, int]", value)[0]
        if kind == Nodetype.NAME:
            names.add(cast("str", value))
    return names


@cache
def _shipped_types(ros1: bool) -> Typesdict:
    # Recordings without definitions are from Humble or older.
    types = dict(get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE).fielddefs)
    for name, text in DEFINITIONS.items():
        types |= get_types_from_msg(text, name)
    return types


def _user_types(path: Path) -> Typesdict:
    types: Typesdict = {}
    files = sorted(path.rglob("*.msg")) if path.is_dir() else [path]
    if not files:
        raise CallError(f"{path}: holds no .msg file")
    for file in files:
        package = file.parent.parent.name if file.parent.name == "msg" else file.parent.name
        try:
            types |= get_types_from_msg(read_whole(file, 1.0).decode(), f"{package}/msg/{file.stem}")
        except Exception as error:  # whatever an invalid definition makes the parser raise
            raise CallError(f"{file}: is not a message definition ({one_line(error)})") from error
    return types


def _embedded(name: str, definition: MessageDefinition | None) -> Typesdict:
    """Types that the text of `definition`, of the type `name`, defines; empty without a text.

    Raises whatever rosbags makes of an invalid one.
    """
    form, text = (None, "") if definition is None else (definition.format, definition.data)
    if form not in (MessageDefinitionFormat.MSG, MessageDefinitionFormat.IDL) or not text.strip():
        return {}
    types: Typesdict = {}
    if form == MessageDefinitionFormat.MSG:
        types |= get_types_from_msg(_EMPTY_LINE.sub("", f"{text}\n"), name)
    else:
        first, *others = text.split(_SEPARATOR)
        for part in [part.partition("\n")[2] for part in others] if others and not first.strip() else [text]:
            plain = _IDL_REMARK.sub(" ", _IDL_TEXT.sub('""', part))  # without comments, annotations, contents of texts
            types |= get_types_from_idl(plain.replace(">", "> "))  # rosbags takes the end of `a<b<9>>` for a shift
    return types
