"""Message definitions that a recording carries, parsed by rosbags."""

import re

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import get_types_from_idl, get_types_from_msg

from fgtrack.io.ros.type_checks import check_definition, check_type_name

__all__ = ["DefinitionReader", "one_line"]

_LONGEST_TEXT = 200_000
_MOST_PARTS = 1_000
_SEPARATOR = "=" * 80 + "\n"
_MSG_HEADER = re.compile(r"MSG: ([A-Za-z0-9/_]+)[ \t]*\n")
_EMPTY_LINE = re.compile(r"^[ \t]*(?:#[^\n]*)?\n", re.MULTILINE)
_IDL_TEXT = re.compile(r'"(?:\\.|[^"\\])*"')
_IDL_REMARK = re.compile(r"/\*.*?\*/|//[^\n]*|^#[^\n]*|@\s*[\w:]*(?:\s*\([^()]*\))?", re.DOTALL | re.MULTILINE)
_IDL_NESTED = re.compile(r"(?:sequence\s*<\s*){4}")
_IDL_COMPUTED = re.compile(r"=[^;]*[()*/%|^&~<]")


def one_line(error: BaseException) -> str:
    """Text of `error` in one line of at most 200 characters."""
    return " ".join(str(error)[:2000].split())[:200] or type(error).__name__


class DefinitionReader:
    """Parses the definitions of one recording, each part once."""

    def __init__(self) -> None:
        self._parts: dict[tuple[MessageDefinitionFormat, str, str], Typesdict | ValueError] = {}

    def read(self, name: str, definition: MessageDefinition | None) -> Typesdict:
        """Types that `definition` of the type `name` defines, checked; empty without a text.

        Raises `ValueError` for an invalid definition, and beyond the caps of this module.
        """
        if definition is None or definition.format not in (MessageDefinitionFormat.MSG, MessageDefinitionFormat.IDL):
            return {}
        if len(definition.data) > _LONGEST_TEXT:
            raise ValueError(f"it has more than {_LONGEST_TEXT} characters")
        if not definition.data.strip():
            return {}
        check_type_name(name)
        types: Typesdict = {}
        for part_name, part in _parts(name, definition.format, definition.data):
            types |= self._part(definition.format, part_name, part)
        return types

    def _part(self, form: MessageDefinitionFormat, name: str, text: str) -> Typesdict:
        key = form, name, text
        if key not in self._parts:
            if len(self._parts) >= _MOST_PARTS:
                raise ValueError(f"the recording defines more than {_MOST_PARTS} types")
            try:
                self._parts[key] = _parsed(form, name, text)
            except Exception as error:  # whatever an invalid definition makes the parser raise
                self._parts[key] = ValueError(one_line(error))
        found = self._parts[key]
        if isinstance(found, ValueError):
            raise found
        return found


def _parsed(form: MessageDefinitionFormat, name: str, text: str) -> Typesdict:
    if form is MessageDefinitionFormat.MSG:
        types = get_types_from_msg(_EMPTY_LINE.sub("", text if text.endswith("\n") else f"{text}\n"), name)
    else:
        types = get_types_from_idl(_plain_idl(text))
    for each, found in types.items():
        check_definition(each, found)
    return types


def _parts(name: str, form: MessageDefinitionFormat, text: str) -> list[tuple[str, str]]:
    """Name and text of each type in the text of the type `name` and of all that it is made of."""
    first, *others = text.split(_SEPARATOR)
    if form is MessageDefinitionFormat.IDL:
        return [("", part.partition("\n")[2]) for part in others] if others and not first.strip() else [("", text)]
    parts = [(name, first)]
    for part in others:
        header = _MSG_HEADER.match(part)
        if header is None:
            raise ValueError("a type in it has no name, a line 'MSG: package/Type'")
        parts.append((header[1], part[header.end() :]))
    return parts


def _plain_idl(text: str) -> str:
    """Text without string contents, annotations, comments and preprocessor lines, which define no member.

    Raises `ValueError` for what rosbags would parse or evaluate for minutes: computed constants, nested sequences.
    """
    plain = _IDL_REMARK.sub(" ", _IDL_TEXT.sub('""', text))
    if _IDL_COMPUTED.search(plain):
        raise ValueError("it computes a constant, a definition of ROS has plain numbers only")
    if _IDL_NESTED.search(plain):
        raise ValueError("it is nested too deeply")
    return plain.replace(">", "> ")  # rosbags takes the end of `sequence<string<9>>` for a shift
