"""The message types of a recording: rosbags', fgtrack's, the user's and those embedded in the recording."""

import os
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import cast

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import Constdefs, Fielddefs, FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fgtrack.core.errors import CallError
from fgtrack.core.files import read_whole
from fgtrack.io.ros.definitions import DEFINITIONS

_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_MEMBER_NAME = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_BASE_NAME = re.compile(r"[a-z]+[0-9]*", re.ASCII)
_MOST_MEMBERS = 2_000
_LONGEST_ARRAY = 1_000_000
_LONGEST_TEXT = 1_000_000
_LARGEST_FILE_MB = 1.0
_MOST_FOLDERS = 10_000  # below a folder of definitions
_IDL_SEPARATOR = "=" * 80 + "\n"


def type_name(name: str) -> str:
    """Full name of a message type: `pkg/Type` becomes `pkg/msg/Type`."""
    package, _, base = name.partition("/")
    return name if "/" in base else f"{package}/msg/{base}"


def build_typestore(
    definitions: Mapping[str, MessageDefinition | None], ros1: bool, message_definitions: Iterable[str] = ()
) -> tuple[Typestore, Mapping[str, str]]:
    """Types for messages of the types that are the keys of `definitions`, and of those which cannot be read why.

    Precedence: definitions embedded in the recording, the user's, fgtrack's, rosbags'.

    Parameters
    ----------
    definitions
        What the recording carries, by type name.
    ros1
        Whether the messages are serialized as ROS 1 does.
    message_definitions
        The user's `.msg` files, or folders of them.

    Raises
    ------
    CallError
        One of the user's `message_definitions` cannot be read.
    """
    types: Typesdict = dict(_shipped_types(ros1))
    for path in message_definitions:
        types |= _user_types(Path(path))
    problems: dict[str, str] = {}
    for name, definition in definitions.items():
        try:
            types |= _checked(_embedded_types(name, definition)) if definition else {}
        except Exception as error:  # whatever a foreign definition makes the parser raise
            problems[name] = f"its embedded definition cannot be read ({one_line(error)})"
    needed: Typesdict = {}
    for name in definitions:
        missing = _collect(types, name, needed)
        if missing is not None and name not in problems:
            problems[name] = (
                f"the definition of {missing or 'a type without a name'} is neither in the recording nor known, "
                "name its .msg file in message_definitions"
            )
    store = get_typestore(Stores.EMPTY)
    store.register({name: fields for name, fields in needed.items() if name not in store.fielddefs})
    return store, problems


def check_definition(name: str, definition: tuple[Constdefs, Fielddefs]) -> None:
    """Raise `ValueError` unless all names of a definition are such, and its values plain.

    rosbags generates Python code from a definition, with these names in it, and runs it: what a recording brings must
    not become anything but names and numbers there.
    """
    constants, members = definition
    if not _TYPE_NAME.fullmatch(name):
        raise ValueError(f"{name!a} is no name of a message type")
    if len(constants) + len(members) > _MOST_MEMBERS:
        raise ValueError(f"{name} has more than {_MOST_MEMBERS} members")
    for member in (*(constant[0] for constant in constants), *(one[0] for one in members)):
        if not _MEMBER_NAME.fullmatch(member):
            raise ValueError(f"{member!a} is no name of a member")
    for member, kind, value in constants:
        if type(value) not in (bool, int, float, str) or not _BASE_NAME.fullmatch(kind):
            raise ValueError(f"the constant {member} is no plain value")
    for member, description in members:
        _check_description(member, description)


def _check_description(member: str, description: FieldDesc) -> None:
    kind, value = description
    if kind == Nodetype.BASE:
        base, size = cast("tuple[str, int]", value)
        if not _BASE_NAME.fullmatch(base) or not 0 <= int(size) <= _LONGEST_ARRAY:
            raise ValueError(f"{member} is of no known type")
    elif kind == Nodetype.NAME:
        if not _TYPE_NAME.fullmatch(cast("str", value)):
            raise ValueError(f"{value!a} is no name of a message type")
    else:
        inner, size = cast("tuple[FieldDesc, int]", value)
        if not 0 <= int(size) <= _LONGEST_ARRAY:
            raise ValueError(f"{member} is longer than {_LONGEST_ARRAY}")
        _check_description(member, inner)


def _checked(types: Typesdict) -> Typesdict:
    for name, definition in types.items():
        check_definition(name, definition)
    return types


def one_line(error: BaseException) -> str:
    """What `error` says, in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def _collect(types: Typesdict, name: str, needed: Typesdict) -> str | None:
    """Add `name` and all that it is made of to `needed`; gives the name of one that is missing in `types`."""
    pending, missing = [name], None
    while pending:
        current = pending.pop()
        if current not in types:
            missing = current
        elif current not in needed:
            needed[current] = types[current]
            pending += [part for _, field in types[current][1] for part in _named_types(field)]
    return missing


def _named_types(description: FieldDesc) -> list[str]:
    kind, value = description
    if kind == Nodetype.NAME:
        return [cast("str", value)]
    if kind == Nodetype.BASE:
        return []
    return _named_types(cast("tuple[FieldDesc, int]", value)[0])  # an array or a sequence, with its size


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
            types |= _checked(
                get_types_from_msg(read_whole(file, _LARGEST_FILE_MB).decode(), f"{package}/msg/{file.stem}")
            )
        except Exception as error:  # whatever a foreign definition makes the parser raise
            raise CallError(f"{file}: is not a message definition ({one_line(error)})") from error
    return types


def _embedded_types(name: str, definition: MessageDefinition) -> Typesdict:
    if len(definition.data) > _LONGEST_TEXT:
        raise ValueError(f"it has more than {_LONGEST_TEXT} characters")
    match definition.format:
        case MessageDefinitionFormat.MSG if definition.data.strip():
            return get_types_from_msg(definition.data, name)
        case MessageDefinitionFormat.IDL if definition.data.startswith(f"{_IDL_SEPARATOR}IDL: "):
            types: Typesdict = {}
            for part in definition.data.split(_IDL_SEPARATOR)[1:]:
                types |= get_types_from_idl(part.partition("\n")[2])
            return types
        case MessageDefinitionFormat.IDL:
            return get_types_from_idl(definition.data)
        case _:
            return {}
