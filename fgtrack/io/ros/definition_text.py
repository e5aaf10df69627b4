"""Parses the message definitions that a recording carries, and never for long: a line can stand for minutes.

The parsers of rosbags take time that grows with the power of brackets, compute what a constant says, and parse what
every topic repeats again and again. Here a text is taken apart, what says nothing of the fields is left out, what no
definition of ROS has is refused, and each part is parsed once.
"""

import re

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import get_types_from_idl, get_types_from_msg

from fgtrack.io.ros.type_checks import check_definition, check_type_name

__all__ = ["DefinitionReader", "one_line"]

_LONGEST_TEXT = 1_000_000
_MOST_TEXT = 10_000_000  # of all different parts
_MOST_WORK = 100_000
"""Lines of all different parts; some 50 us each."""
_WORK_OF_PART, _WORK_OF_IDL = 10, 30
_WORK_OF_COMPUTED = 30  # of a constant or typedef of IDL, in lines
_MOST_COMPUTED = 2_000
_DEEPEST = 3  # `sequence<string<5>, 4>` has 2

_SEPARATOR = "=" * 80 + "\n"
_MSG_HEADER = re.compile(r"MSG: ([A-Za-z0-9/_]+)[ \t]*\n")
_EMPTY_LINE = re.compile(r"^[ \t]*(?:#[^\n]*)?\n", re.MULTILINE)
# None of the branches can fail behind its first character, so that a text is read once.
_IDL_TOKEN = re.compile(
    r'(?P<skip>\s+|/\*.*?(?:\*/|\Z)|//[^\n]*|^#[^\n]*)|(?P<text>"(?:\\.|[^"\\]|\\\Z)*"?)|(?P<annotation>@\s*[\w:]*)'
    r"|(?P<other>[\w.:]+|.)",
    re.DOTALL | re.MULTILINE | re.ASCII,
)
_SIGN_AFTER = frozenset("=[,<")
_OPERATORS = frozenset("()*/%|^&~")
_EXPONENT = re.compile(r"[0-9.]+[eE]")


def one_line(error: BaseException) -> str:
    """What `error` says, in one line of at most 200 characters."""
    return " ".join(str(error)[:2000].split())[:200] or type(error).__name__


class DefinitionReader:
    """Parses the definitions of one recording, and no more than any recording has."""

    def __init__(self) -> None:
        self._parts: dict[tuple[MessageDefinitionFormat, str, str], Typesdict | ValueError] = {}
        self._text = self._work = 0

    def read(self, name: str, definition: MessageDefinition | None) -> Typesdict:
        """The types that `definition` of the type `name` defines, checked; none where it says nothing.

        Raises `ValueError` where it is no definition, or more than any recording has.
        """
        if definition is None or definition.format not in (MessageDefinitionFormat.MSG, MessageDefinitionFormat.IDL):
            return {}
        text = definition.data
        if len(text) > _LONGEST_TEXT:
            raise ValueError(f"it has more than {_LONGEST_TEXT} characters")
        if not text.strip():
            return {}
        check_type_name(name)
        types: Typesdict = {}
        for part_name, part in _parts(name, definition.format, text):
            types |= self._part(definition.format, part_name, part)
        return types

    def _part(self, form: MessageDefinitionFormat, name: str, text: str) -> Typesdict:
        found = self._parts.get((form, name, text))
        if found is None:
            try:
                found = self._parsed(form, name, text)
            except Exception as error:  # whatever a foreign definition makes the parser raise
                found = ValueError(one_line(error))
            self._parts[form, name, text] = found
        if isinstance(found, ValueError):
            raise found
        return found

    def _parsed(self, form: MessageDefinitionFormat, name: str, text: str) -> Typesdict:
        self._text += len(text)
        if self._text > _MOST_TEXT:
            raise ValueError("with it the definitions are longer than those of any recording")
        is_msg = form is MessageDefinitionFormat.MSG
        plain, work = _plain_msg(text) if is_msg else _plain_idl(text)
        if self._work + work > _MOST_WORK:
            raise ValueError("with it the definitions have more lines than those of any recording")
        self._work += work
        types = get_types_from_msg(plain, name) if is_msg else get_types_from_idl(plain)
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


def _plain_msg(text: str) -> tuple[str, int]:
    """`text` without empty lines and comments, and what it takes to parse it."""
    plain = _EMPTY_LINE.sub("", text if text.endswith("\n") else f"{text}\n")
    return plain, _WORK_OF_PART + plain.count("\n") + plain.count(",")


def _plain_idl(text: str) -> tuple[str, int]:
    """`text` without annotations, comments and what is for a preprocessor, and what it takes to parse it.

    Raises `ValueError` for a constant that is computed: neither ROS' own parser nor its messages know such.
    """
    kept: list[str] = []
    before, depth, brackets, annotation = "", 0, 0, False  # the brackets of an annotation; whether one may begin
    statements = computed = 0
    for found in _IDL_TOKEN.finditer(text):
        kind, token = found.lastgroup, found[0]
        if kind == "skip":
            kept.append(" ")
        elif brackets or (annotation and token == "("):
            brackets += {"(": 1, ")": -1}.get(token, 0)
            annotation = False
        elif kind == "annotation":
            annotation = True
        else:
            annotation = False
            if kind == "text":
                token = '"' + re.sub(r'[\\"]', "", token) + '"'
            elif token in "<>":
                depth = max(0, depth + (1 if token == "<" else -1))
                if depth > _DEEPEST or (token == "<" and kept[-1:] == ["<"]):
                    raise ValueError("it is nested too deeply, or computes with '<<'")
            elif _computes(before, token):
                raise ValueError(f"it computes with {token!r}, a definition of ROS has plain numbers only")
            statements += token in (";", ",")
            computed += token in ("const", "typedef")
            kept.append("> " if token == ">" else token)  # rosbags takes the end of `sequence<string<9>>` for a shift
            before = token
    if computed > _MOST_COMPUTED:
        raise ValueError(f"it has more than {_MOST_COMPUTED} constants")
    return "".join(kept), _WORK_OF_IDL + 2 * statements + _WORK_OF_COMPUTED * computed


def _computes(before: str, token: str) -> bool:
    """Whether `token`, behind `before`, is an operator and no sign of a number."""
    if token in _OPERATORS:
        return True
    return token in ("+", "-") and before not in _SIGN_AFTER and not _EXPONENT.fullmatch(before)
