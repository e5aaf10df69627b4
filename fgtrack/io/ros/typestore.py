"""The message types of a recording: rosbags', fgtrack's, the user's and those embedded in the recording."""

import os
from collections.abc import Collection, Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import MessageDefinition
from rosbags.interfaces.typing import Fielddefs, Typesdict
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_whole
from fgtrack.io.errors import MOST_OBJECTS, refuse_larger
from fgtrack.io.ros.definition_text import DefinitionReader, one_line
from fgtrack.io.ros.definitions import DEFINITIONS
from fgtrack.io.ros.type_checks import check_definition, check_size, named_types

__all__ = ["Key", "MessageTypes", "build_typestore", "one_line", "type_name"]

_LARGEST_FILE_MB = 1.0
_LARGEST_MESSAGE = 32_000_000
"""Of a message that is decoded: an object list or a state, never an image; each byte takes up to a hundred."""
_MOST_FOLDERS = 10_000  # below a folder of definitions
Key = tuple[str, MessageDefinition | None]
"""A message type, and what the recording says of it: two topics may know different types by one name."""


def type_name(name: str) -> str:
    """Full name of a message type: `pkg/Type` becomes `pkg/msg/Type`."""
    package, _, base = name.partition("/")
    return name if "/" in base else f"{package}/msg/{base}"


class MessageTypes:
    """Decodes messages of the given types, each by the definition that came with it.

    Precedence: the definition embedded for the type, those embedded for others, the user's, fgtrack's, rosbags'.

    Parameters
    ----------
    keys
        The types, with what the recording carries of them.
    ros1
        Whether the messages are serialized as ROS 1 does.
    message_definitions
        The user's `.msg` files, or folders of them.
    most_objects
        A message with a longer list is refused.

    Raises
    ------
    CallError
        One of the user's `message_definitions` cannot be read.
    """

    def __init__(
        self,
        keys: Iterable[Key],
        ros1: bool,
        message_definitions: Iterable[str] = (),
        most_objects: int = MOST_OBJECTS,
    ) -> None:
        self._ros1 = ros1
        self._most_objects = most_objects
        self._types: dict[Key, Typesdict] = {}
        self._stores: dict[Key, Typestore] = {}
        self.problems: dict[Key, str] = {}
        """Why messages of a type cannot be decoded."""
        keys = sorted(set(keys), key=str)
        embedded = self._embedded(keys)
        known = _known_types(ros1, message_definitions)
        shared, ambiguous = _shared(embedded.values())
        for key in keys:
            if key not in self.problems:
                try:
                    types = _closure(key[0], [embedded[key], shared, known], ambiguous)
                    check_size(key[0], types)
                    self._types[key] = types
                except (ValueError, RecursionError) as error:
                    self.problems[key] = str(error)

    def _embedded(self, keys: list[Key]) -> dict[Key, Typesdict]:
        reader = DefinitionReader()
        found: dict[Key, Typesdict] = {}
        for key in keys:
            try:
                found[key] = reader.read(*key)
            except ValueError as error:
                self.problems[key] = f"its embedded definition cannot be read ({one_line(error)})"
        return found

    def fields(self, key: Key) -> Fielddefs:
        """The members of a type that has no problem."""
        return self._types[key][key[0]][1]

    def types(self, key: Key) -> Typesdict:
        """A type that has no problem, with all that it is made of."""
        return self._types[key]

    def decode(self, key: Key, data: bytes, what: str) -> Any:  # a message has the attributes of its type
        """Message that is serialized in `data`; `what` names it in errors.

        Raises
        ------
        DataError
            The bytes are not of the type, or hold a list of more than `most_objects`.
        """
        refuse_larger(len(data), what, _LARGEST_MESSAGE)
        try:
            store = self._store(key)
            message = (store.deserialize_ros1 if self._ros1 else store.deserialize_cdr)(data, key[0])
        except Exception as error:  # whatever bytes of another type make the decoder raise
            raise DataError(f"{what} is not a {key[0]} ({one_line(error)})") from error
        if len(data) > self._most_objects and (length := _longest_list(message)) > self._most_objects:
            raise DataError(f"{what}: a list of {length} objects, more than input.most_objects allows")
        return message

    def _store(self, key: Key) -> Typestore:
        if key not in self._stores:
            self._stores[key] = _registered(self._types[key])
        return self._stores[key]


def _longest_list(message: Any) -> int:  # a message has the attributes of its type
    """Length of the longest list in `message`, not looking into lists."""
    lengths = [0]
    for value in vars(message).values():
        if isinstance(value, list):
            lengths.append(len(value))
        elif hasattr(value, "__msgtype__"):
            lengths.append(_longest_list(value))
    return max(lengths)


def build_typestore(
    definitions: Mapping[str, MessageDefinition | None], ros1: bool, message_definitions: Iterable[str] = ()
) -> tuple[Typestore, Mapping[str, str]]:
    """One store of the types that are the keys of `definitions`, and of those which cannot be read why.

    Arguments and errors as of `MessageTypes`, by type name.
    """
    found = MessageTypes(definitions.items(), ros1, message_definitions)
    needed: Typesdict = {}
    for key in definitions.items():
        needed |= {} if key in found.problems else found.types(key)
    return _registered(needed), {name: problem for (name, _), problem in found.problems.items()}


def _registered(types: Typesdict) -> Typestore:
    store = Typestore()
    store.register(types)
    return store


def _shared(embedded: Collection[Typesdict]) -> tuple[Typesdict, frozenset[str]]:
    """What the definitions of any type say, and the names of which they say different things."""
    shared: Typesdict = {}
    ambiguous = set()
    for types in embedded:
        for name, definition in types.items():
            if shared.setdefault(name, definition)[1] != definition[1]:
                ambiguous.add(name)
    return shared, frozenset(ambiguous)


def _closure(name: str, sources: list[Typesdict], ambiguous: frozenset[str]) -> Typesdict:
    """The type `name` with all that it is made of, each from the first of `sources` that has it.

    Raises `ValueError` where none has, or where it is to be taken from other topics which contradict each other.
    """
    needed: Typesdict = {}
    pending = [name]
    while pending:
        current = pending.pop()
        if current in needed:
            continue
        found = next((types[current] for types in sources if current in types), None)
        if found is None:
            raise ValueError(
                f"the definition of {current or 'a type without a name'} is neither in the recording nor known, "
                "name its .msg file in message_definitions"
            )
        if current in ambiguous and current not in sources[0]:
            raise ValueError(f"the recording defines {current} in several ways, and for this type in none of its own")
        needed[current] = found
        pending += [part for _, field in found[1] for part in named_types(field)]
    return needed


def _known_types(ros1: bool, message_definitions: Iterable[str]) -> Typesdict:
    types = dict(_shipped_types(ros1))
    for path in message_definitions:
        types |= _user_types(Path(path))
    return types


@cache
def _shipped_types(ros1: bool) -> Typesdict:
    # Recordings without definitions are from Humble or older.
    types = dict(get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE).fielddefs)
    for name, text in DEFINITIONS.items():
        types |= get_types_from_msg(text, name)
    return types


def definition_files(path: Path) -> list[Path]:
    """The `.msg` files at or below `path`. Raises `CallError` where there are none, or folders without end."""
    if not path.is_dir():
        return [path]
    files: list[Path] = []
    for count, (folder, _, names) in enumerate(os.walk(path), start=1):
        if count > _MOST_FOLDERS:
            raise CallError(f"{path}: has more than {_MOST_FOLDERS} folders, name that of the message definitions")
        files += (Path(folder, name) for name in names if name.endswith(".msg"))
    if not files:
        raise CallError(f"{path}: holds no .msg file")
    return sorted(files)


def _user_types(path: Path) -> Typesdict:
    types: Typesdict = {}
    for file in definition_files(path):
        package = file.parent.parent.name if file.parent.name == "msg" else file.parent.name
        try:
            found = get_types_from_msg(read_whole(file, _LARGEST_FILE_MB).decode(), f"{package}/msg/{file.stem}")
            for name, definition in found.items():
                check_definition(name, definition)
        except Exception as error:  # whatever a foreign definition makes the parser raise
            raise CallError(f"{file}: is not a message definition ({one_line(error)})") from error
        types |= found
    return types
