"""The message types of a recording: rosbags', fgtrack's, the user's and those embedded in the recording."""

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import cast

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Nodetype
from rosbags.interfaces.typing import FieldDesc, Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from fgtrack.core.errors import CallError
from fgtrack.io.ros.definitions import DEFINITIONS

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
            types |= _embedded_types(name, definition) if definition else {}
        except Exception as error:  # whatever a foreign definition makes the parser raise
            problems[name] = f"its embedded definition cannot be read ({one_line(error)})"
    needed: Typesdict = {}
    for name in definitions:
        missing = _collect(types, name, needed)
        if missing and name not in problems:
            problems[name] = (
                f"the definition of {missing} is neither in the recording nor known, "
                "name its .msg file in message_definitions"
            )
    store = get_typestore(Stores.EMPTY)
    store.register({name: fields for name, fields in needed.items() if name not in store.fielddefs})
    return store, problems


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


def _user_types(path: Path) -> Typesdict:
    files = sorted(path.rglob("*.msg")) if path.is_dir() else [path]
    if not files:
        raise CallError(f"{path}: holds no .msg file")
    types: Typesdict = {}
    for file in files:
        package = file.parent.parent.name if file.parent.name == "msg" else file.parent.name
        try:
            types |= get_types_from_msg(file.read_text(encoding="utf-8"), f"{package}/msg/{file.stem}")
        except Exception as error:  # whatever a foreign definition makes the parser raise
            raise CallError(f"{file}: is not a message definition ({one_line(error)})") from error
    return types


def _embedded_types(name: str, definition: MessageDefinition) -> Typesdict:
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
