"""Every key of a settings dataclass, with its type, default and meaning, as tables and as commented YAML."""

import ast
import dataclasses
import inspect
import json
import textwrap
import types
from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from itertools import pairwise
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from fgtrack.config.yaml_file import plain

_FORMULAS = {"6.28318530718": "2 pi", "0.547722557505": "sqrt(0.3)"}


class Setting(NamedTuple):
    """One key of a section."""

    name: str
    type: str
    default: str
    doc: str


class Section(NamedTuple):
    """The keys of one dataclass; a name that the user chooses is NAME in `path`."""

    path: str
    kind: str | None
    doc: str
    settings: tuple[Setting, ...]


def sections(root: type, path: str = "") -> Iterator[Section]:
    """Yield the sections of the dataclass `root` and of all dataclasses in its fields.

    Each dataclass comes once, in the order of the fields.
    """
    for _, section in _sections(root, path, None, set()):
        yield section


def _sections(
    cls: type, path: str, kind: str | None, seen: set[type]
) -> Iterator[tuple[type, Section]]:
    if cls in seen:
        return
    seen.add(cls)
    yield cls, _section(cls, path, kind)
    hints = get_type_hints(cls, include_extras=True)
    for field in _fields(cls):
        inner = f"{path}.{field.name}" if path else field.name
        for below, choice, named in _dataclasses(hints[field.name]):
            yield from _sections(
                below, f"{inner}.{named}" if named else inner, choice, seen
            )


def _section(cls: type, path: str, kind: str | None) -> Section:
    """Return the keys of one dataclass."""
    hints = get_type_hints(cls, include_extras=True)
    docs = _attribute_docs(cls)
    settings = [
        Setting(
            field.name,
            _type(hints[field.name]),
            _default(field),
            docs.get(field.name) or _summary(hints[field.name]),
        )
        for field in _fields(cls)
    ]
    return Section(path, kind, inspect.getdoc(cls) or "", tuple(settings))


def _fields(cls: Any) -> list["dataclasses.Field[Any]"]:  # Any: a dataclass
    """Return the fields of a dataclass, without the `kind` that selects it."""
    return [
        field
        for field in dataclasses.fields(cls)
        if field.name != "kind" or _kind(cls) is None
    ]


def _dataclasses(hint: Any, named: str = "") -> Iterator[tuple[type, str | None, str]]:
    """Yield the dataclasses in a type: each with its `kind` or None, and with its part of a key.

    The part is NAME in a mapping, N in a list, else `named`.
    """
    origin = get_origin(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        yield hint, _kind(hint), named
    elif origin is Annotated:
        yield from _dataclasses(get_args(hint)[0], named)
    elif origin in (Union, types.UnionType):
        for one in get_args(hint):
            yield from _dataclasses(one, named)
    elif origin in (tuple, list, Mapping, dict) or (
        isinstance(origin, type) and issubclass(origin, Mapping)
    ):
        for one in get_args(hint):
            yield from _dataclasses(one, "NAME" if origin not in (tuple, list) else "N")


def _summary(hint: Any) -> str:
    """Return the first line of the description of a section: a value that consists of further keys."""
    found = list(_dataclasses(hint))
    if len(found) > 1:
        return "Keys of each kind below."
    return (
        one_line((inspect.getdoc(found[0][0]) or "").partition("\n\n")[0])
        if found
        else ""
    )


def _kind(cls: type) -> str | None:
    """Return the value of `kind` that selects this dataclass; None for a dataclass without kinds."""
    hint = get_type_hints(cls).get("kind")
    return (
        str(get_args(hint)[0])
        if get_origin(hint) is Literal and len(get_args(hint)) == 1
        else None
    )


def _type(hint: Any) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _type(arguments[0])
    if origin is Literal:
        return " / ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        kinds = [
            _kind(one)
            if isinstance(one, type) and dataclasses.is_dataclass(one)
            else None
            for one in arguments
        ]
        if all(kinds):
            return "by `kind`: " + " / ".join(f"`{kind}`" for kind in kinds)
        return " / ".join(dict.fromkeys(_type(one) for one in arguments))
    if origin is tuple:
        inner = [one for one in arguments if one is not Ellipsis]
        return (
            f"list of {_type(inner[0])}"
            if Ellipsis in arguments
            else f"{len(inner)} x {_type(inner[0])}"
        )
    if origin is not None and len(arguments) == 2:
        return f"{_type(arguments[0])} to {_type(arguments[1])}"
    if origin is not None:
        return f"list of {_type(arguments[0])}"
    if hint is type(None):
        return "null"
    if dataclasses.is_dataclass(hint):
        return "keys below"
    return {
        "str": "text",
        "float": "number",
        "int": "integer",
        "bool": "true / false",
    }.get(hint.__name__, "value")


def _default(field: "dataclasses.Field[Any]") -> str:
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING:
        return "required"
    if dataclasses.is_dataclass(value):
        kind = _kind(type(value))
        return f"`{kind}`" if kind else ""
    if isinstance(value, Mapping) and any(
        dataclasses.is_dataclass(one) for one in value.values()
    ):
        return ", ".join(f"`{name}`" for name in value)
    return f"`{_yaml(value)}`"


def _yaml(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return (
            "{" + ", ".join(f"{key}: {_yaml(one)}" for key, one in value.items()) + "}"
        )
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_yaml(one) for one in value) + "]"
    text = f"{value:.12g}" if isinstance(value, float) else str(value)
    return _FORMULAS.get(text, text)


@cache
def _attribute_docs(cls: type) -> dict[str, str]:
    """Return the strings below the fields of a class and of its bases, by field."""
    found: dict[str, str] = {}
    for one in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(one):
            continue
        tree: Any = ast.parse(textwrap.dedent(inspect.getsource(one))).body[
            0
        ]  # Any: a ClassDef
        for field, below in pairwise(tree.body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                name = ast.unparse(field.target)
                found[name] = one_line(ast.literal_eval(below.value))
    return found


def one_line(text: str) -> str:
    """Return `text` on one line, with the bars escaped that would end a cell of a Markdown table."""
    return " ".join(text.split()).replace("|", "\\|")


def settings_page(target: str, heading: str = "##") -> str:
    """Return tables of all keys of the dataclass `target`, given as `module:Class`, below headings of a level."""
    module, _, name = target.partition(":")
    lines: list[str] = []
    for section in sections(getattr(import_module(module), name)):
        title = f"`{section.path}`" if section.path else "Top level"
        lines += [
            f"{heading} {title}" + (f", kind `{section.kind}`" if section.kind else ""),
            "",
            section.doc,
            "",
        ]
        if section.settings:
            lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
            lines += [
                f"| `{one.name}` | {one.type} | {one.default} | {one.doc} |"
                for one in section.settings
            ]
            lines.append("")
    return "\n".join(lines)


def commented(value: object) -> str:
    """Return the YAML text of a settings dataclass: every key with its meaning and default as a comment.

    A key has its comment only where it occurs first. Comments at the end list the keys of
    the kinds that `value` does not use, for example of the other motion models.
    """
    seen: set[type] = set()
    lines = _commented_lines(value, seen)
    for cls, section in _sections(type(value), "", None, set()):
        if cls in seen:
            continue
        kind = "" if section.kind is None else f", kind: {section.kind}"
        lines += ["", f"# {section.path}{kind}. {first_line(section.doc)}"]
        lines += [
            f"#   {one.name}: {one.type}{_meaning(one)}" for one in section.settings
        ]
    return "\n".join(lines) + "\n"


def _commented_lines(value: Any, seen: set[type]) -> list[str]:
    """Return the lines of the dataclass `value`; adds the classes whose keys have comments to `seen`."""
    cls = type(value)
    known = {one.name: one for one in _section(cls, "", None).settings}
    is_new = cls not in seen
    seen.add(cls)
    lines = []
    for field in dataclasses.fields(cls):
        inner = getattr(value, field.name)
        setting = known.get(field.name)
        comment = _meaning(setting) if is_new and setting else ""
        if dataclasses.is_dataclass(inner):
            below = [f"  {line}" for line in _commented_lines(inner, seen)]
            lines += [f"{field.name}:{comment}", *below]
        elif isinstance(inner, tuple) and inner and dataclasses.is_dataclass(inner[0]):
            lines.append(f"{field.name}:{comment}")
            for item in inner:
                first, *rest = _commented_lines(item, seen)
                lines += [f"  - {first}", *(f"    {line}" for line in rest)]
        else:
            lines.append(f"{field.name}: {json.dumps(plain(inner))}{comment}")
    return lines


def _meaning(one: Setting) -> str:
    default = one.default.strip("`")
    default = f"default {default}" if default not in ("", "required") else default
    texts = [one.doc.replace("\\|", "|").rstrip("."), default]
    return f"  # {'; '.join(filter(None, texts))}" if any(texts) else ""


def first_line(text: str) -> str:
    """Return the first paragraph of a docstring as one line."""
    return one_line(text.partition("\n\n")[0])
