"""Pages that are generated from the code: settings, estimators, delay models, the public names.

Everything here gives Markdown and needs Python alone; `setup` makes Sphinx directives of it.
"""

import ast
import dataclasses
import inspect
import textwrap
import types
from collections.abc import Callable, Iterator, Mapping
from enum import Enum
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
    """The dataclass `root` and all dataclasses that its fields hold, each once, in the order of the fields."""
    yield from _sections(root, path, None, set())


def _sections(cls: type, path: str, kind: str | None, seen: set[type]) -> Iterator[Section]:
    if cls in seen:
        return
    seen.add(cls)
    hints, docs = get_type_hints(cls, include_extras=True), _attribute_docs(cls)
    fields = [field for field in dataclasses.fields(cls) if field.name != "kind" or _kind(cls) is None]
    settings = [
        Setting(f.name, _type(hints[f.name]), _default(f), docs.get(f.name) or _summary(hints[f.name])) for f in fields
    ]
    yield Section(path, kind, inspect.getdoc(cls) or "", tuple(settings))
    for field in fields:
        inner = f"{path}.{field.name}" if path else field.name
        for below, choice, named in _dataclasses(hints[field.name]):
            yield from _sections(below, f"{inner}.{named}" if named else inner, choice, seen)


def _dataclasses(hint: Any, named: str = "") -> Iterator[tuple[type, str | None, str]]:
    """The dataclasses in a type, each with its `kind` where it has one, and NAME in a mapping or list."""
    origin = get_origin(hint)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        yield hint, _kind(hint), named
    elif origin is Annotated:
        yield from _dataclasses(get_args(hint)[0], named)
    elif origin in (Union, types.UnionType):
        for one in get_args(hint):
            yield from _dataclasses(one, named)
    elif origin in (tuple, list, Mapping, dict) or (isinstance(origin, type) and issubclass(origin, Mapping)):
        for one in get_args(hint):
            yield from _dataclasses(one, "NAME" if origin not in (tuple, list) else "N")


def _summary(hint: Any) -> str:
    """The first line about a value that has keys of its own."""
    found = list(_dataclasses(hint))
    if len(found) > 1:
        return "Keys of each kind below."
    return _one_line((inspect.getdoc(found[0][0]) or "").partition("\n\n")[0]) if found else ""


def _kind(cls: type) -> str | None:
    """The value of `kind` that chooses this dataclass; None where there is no such choice."""
    hint = get_type_hints(cls).get("kind")
    return str(get_args(hint)[0]) if get_origin(hint) is Literal and len(get_args(hint)) == 1 else None


def _type(hint: Any) -> str:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _type(arguments[0])
    if origin is Literal:
        return " / ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        kinds = [_kind(one) if isinstance(one, type) and dataclasses.is_dataclass(one) else None for one in arguments]
        if all(kinds):
            return "by `kind`: " + " / ".join(f"`{kind}`" for kind in kinds)
        return " / ".join(dict.fromkeys(_type(one) for one in arguments))
    if origin is tuple:
        inner = [one for one in arguments if one is not Ellipsis]
        return f"list of {_type(inner[0])}" if Ellipsis in arguments else f"{len(inner)} x {_type(inner[0])}"
    if origin is not None and len(arguments) == 2:
        return f"{_type(arguments[0])} to {_type(arguments[1])}"
    if origin is not None:
        return f"list of {_type(arguments[0])}"
    if hint is type(None):
        return "null"
    if dataclasses.is_dataclass(hint):
        return "keys below"
    return {"str": "text", "float": "number", "int": "integer", "bool": "true / false"}.get(hint.__name__, "value")


def _default(field: "dataclasses.Field[Any]") -> str:
    value = field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    if value is dataclasses.MISSING:
        return "required"
    if dataclasses.is_dataclass(value):
        kind = _kind(type(value))
        return f"`{kind}`" if kind else ""
    if isinstance(value, Mapping) and any(dataclasses.is_dataclass(one) for one in value.values()):
        return ", ".join(f"`{name}`" for name in value)
    return f"`{_yaml(value)}`"


def _yaml(value: Any) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {_yaml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_yaml(one) for one in value) + "]"
    text = f"{value:.12g}" if isinstance(value, float) else str(value)
    return _FORMULAS.get(text, text)


@cache
def _attribute_docs(cls: type) -> dict[str, str]:
    """The strings below the fields of a class and of those that it extends."""
    found: dict[str, str] = {}
    for one in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(one):
            continue
        [tree] = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        for field, below in pairwise(tree.body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                found[field.target.id] = _one_line(ast.literal_eval(below.value))
    return found


def _one_line(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def settings_page(target: str) -> str:
    """Tables of all keys of the dataclass `target`, as `module:Class`."""
    module, _, name = target.partition(":")
    lines: list[str] = []
    for section in sections(getattr(import_module(module), name)):
        title = f"`{section.path}`" if section.path else "Top level"
        lines += [f"## {title}" + (f", kind `{section.kind}`" if section.kind else ""), "", section.doc, ""]
        if section.settings:
            lines += ["| key | value | default | meaning |", "|---|---|---|---|"]
            lines += [f"| `{one.name}` | {one.type} | {one.default} | {one.doc} |" for one in section.settings]
            lines.append("")
    return "\n".join(lines)


def estimators_page() -> str:
    """A table of all estimators that come with fgtrack."""
    from fgtrack.estimation.registry import ESTIMATORS, Claims

    lines = ["| name | method | exact in a linear model for |", "|---|---|---|"]
    for name in ESTIMATORS:
        if name not in ESTIMATORS.sources():
            factory = ESTIMATORS.load(name)
            summary = _one_line((inspect.getdoc(factory) or "").partition("\n\n")[0])
            lines.append(f"| `{name}` | {summary} | {Claims.of(factory).exact or '-'} |")
    return "\n".join(lines)


def motion_models_page() -> str:
    """A table of all motion models that come with fgtrack."""
    from fgtrack.estimation.registry import MOTION_MODELS

    lines = ["| name | model | state | noise densities |", "|---|---|---|---|"]
    for name in MOTION_MODELS:
        if name not in MOTION_MODELS.sources():
            model = MOTION_MODELS.load(name)
            summary = _one_line((inspect.getdoc(model) or "").partition("\n\n")[0])
            entries, densities = (", ".join(f"`{each}`" for each in names) for names in (
                model.state_names, model.density_names()
            ))
            lines.append(f"| `{name}` | {summary} | {entries} | {densities or '-'} |")
    return "\n".join(lines)


_GROUPS = {
    "Recordings, runs, live use": ("inputs", "meaning", "runs", "pipeline", "config", "sim"),
    "Evaluation, figures, reports": ("evaluation", "show", "recording_study"),
    "Advice and noise": ("advice", "noise", "clocks"),
    "Messages, reports, errors": ("core",),
    "Estimators": ("estimation", "testing"),
    "Motion, measurement and sensor models": ("models",),
}


def public_names() -> str:
    """Autodoc directives of what `import fgtrack` offers."""
    import fgtrack

    values = {name: getattr(fgtrack, name) for name in dir(fgtrack) if not name.startswith("_")}
    lines = []
    for title, packages in _GROUPS.items():
        lines += [f"## {title}", ""]
        for name, value in values.items():
            if f"{fgtrack._HOMES[name]}.{name}".split(".")[1] in packages:
                lines += ["```{eval-rst}", _autodoc(name, value), "```", ""]
    return "\n".join(lines)


def _autodoc(name: str, value: Any) -> str:
    if isinstance(value, type):
        return f".. autoclass:: fgtrack.{name}\n   :members:" + "\n   :undoc-members:" * issubclass(value, Enum)
    if isinstance(value, types.ModuleType):
        import fgtrack

        own = [one for one in value.__all__ if one not in dir(fgtrack)]  # a public name has an entry of its own
        members = {one: getattr(value, one) for one in own}
        return "\n\n".join(_autodoc(f"{name}.{one}", member) for one, member in members.items() if callable(member))
    if getattr(get_origin(value), "__name__", "") == "ndarray":
        numbers = get_args(get_args(value)[1])[0].__name__
        return f".. py:data:: fgtrack.{name}\n\n   Type of a NumPy array of `{numbers}`."
    if callable(value):
        return f".. autofunction:: fgtrack.{name}"
    return f".. py:data:: fgtrack.{name}\n\n   " + " or ".join(f"`{one.__name__}`" for one in get_args(value))


def _whole_sentences(app: Any, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Break the line behind a colon: what stands before it is no type, as Napoleon has it for an attribute."""
    if what in ("attribute", "property") and lines:
        before, colon, behind = lines[0].partition(": ")
        lines[:1] = [before + colon.strip(), behind] if colon else [before]


def setup(app: Any) -> dict[str, bool]:
    """Directives `settings`, `estimators`, `motion-models` and `public-names` for Sphinx."""
    from docutils.nodes import Node
    from sphinx.util.docutils import SphinxDirective

    def directive(page: Callable[..., str], num_arguments: int) -> type[SphinxDirective]:
        class Generated(SphinxDirective):
            required_arguments = num_arguments

            def run(self) -> list[Node]:
                return self.parse_text_to_nodes(page(*self.arguments), allow_section_headings=True)

        return Generated

    app.add_directive("settings", directive(settings_page, 1))
    app.add_directive("estimators", directive(estimators_page, 0))
    app.add_directive("motion-models", directive(motion_models_page, 0))
    app.add_directive("public-names", directive(public_names, 0))
    app.connect("autodoc-process-docstring", _whole_sentences, priority=100)  # before Napoleon
    return {"parallel_read_safe": True}
