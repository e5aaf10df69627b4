"""A tuned configuration as a file: that of the configuration, comments and all, with other numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import CommentMark
from ruamel.yaml.tokens import CommentToken

from fgtrack.core.errors import printable
from fgtrack.io.output import new_file
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import plain, validate
from fgtrack.pipeline.shipped import find_file, read_config

_TUNED_MARK, _ADVISED_MARK = "(fgtrack tune)", "(fgtrack advise)"


def write_tuned(path: Path, base: str | Path | None, config: Config, comments: Sequence[str], overwrite: bool) -> None:
    """Write `config` to `path` as changes of the configuration file `base` (or shipped name, or None for the defaults).

    The maps of `config` are left out: they belong to a recording. `comments` are put before the rest. Raises
    `CallError` where `path` exists and must not be replaced, or cannot be written.
    """
    text = tuned_text(base, config, comments)
    with new_file(path, overwrite) as file:
        file.write(text.encode())


def write_advised(
    path: Path, base: str | Path | None, config: Config, comments: Sequence[str], overwrite: bool
) -> None:
    """The same for settings that belong to a recording: with its maps."""
    text = _text(base, config, comments, "Settings for a recording, from {}", _ADVISED_MARK)
    with new_file(path, overwrite) as file:
        file.write(text.encode())


def tuned_text(base: str | Path | None, config: Config, comments: Sequence[str]) -> str:
    """The text that `write_tuned` writes."""
    origin = read_config(base)
    return _text(base, replace(config, map=origin.map), comments, "The noise of {}, fitted to recordings", _TUNED_MARK)


def _text(base: str | Path | None, wanted: Config, comments: Sequence[str], title: str, mark: str) -> str:
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 120
    document, name = CommentedMap(), "the defaults"
    if base is not None:
        source = find_file("configuration", base)
        name = source.stem
        document = yaml.load(source.read_text(encoding="utf-8")) or document
    origin = validate(Config, document, name)
    _change(document, origin, wanted)
    text = StringIO()
    yaml.dump(document, text)
    head = [f"{title.format(name)} {mark}.", "", *comments, ""]
    return "\n".join([*(f"# {printable(line)}".rstrip() for line in head), text.getvalue()])


def _change(document: Any, origin: object, wanted: object) -> None:  # Any: a mapping of ruamel's
    """Set in `document`, which was read as `origin`, what is different in `wanted`."""
    for name, before, after in _entries(origin, wanted):
        if plain(before) == plain(after):
            continue
        inner = document.get(name)
        if isinstance(inner, Mapping) and type(before) is type(after) and not isinstance(after, (list, tuple)):
            _change(inner, before, after)
        else:
            _put(document, name, _short(after))


def _put(document: CommentedMap, name: str, value: object) -> None:
    """Set `name` in `document`; what is written between it and the next key stays in front of that.

    ruamel.yaml knows the lines before a key as the end of the comment on the value before it, however deep that stands.
    """
    follows = name if name in document else next(reversed(document), None)
    lines = "" if follows is None else _cut_lines_after(document, follows)
    document[name] = value
    if lines:
        inner, key = _last_value(document, name)
        token = inner.ca.items.setdefault(key, [None] * 4)
        on_line = "\n" if token[2] is None else token[2].value
        token[2] = CommentToken(on_line + lines, CommentMark(0), None)


def _cut_lines_after(document: CommentedMap, name: str) -> str:
    """Take off the comment lines after the value of `name`; a comment on its own line stays."""
    inner, key = _last_value(document, name)
    place = 2 if isinstance(inner, CommentedMap) else 0
    token = inner.ca.items.get(key, [None] * 4)[place]
    if token is None:
        return ""
    on_line, _, lines = token.value.partition("\n")
    token.value = f"{on_line}\n"
    return str(lines)


def _last_value(document: Any, name: Any) -> tuple[Any, Any]:  # Any: collections of ruamel's and their keys
    """The collection and the key in it of what is written last of the value of `name` in `document`."""
    inner = document[name]
    if isinstance(inner, (CommentedMap, CommentedSeq)) and len(inner) and not inner.fa.flow_style():
        return _last_value(inner, next(reversed(inner)) if isinstance(inner, CommentedMap) else len(inner) - 1)
    return document, name


def _entries(origin: object, wanted: object) -> list[tuple[str, object, object]]:
    if isinstance(wanted, Mapping):
        before = origin if isinstance(origin, Mapping) else {}
        return [(name, before.get(name), value) for name, value in wanted.items()]
    return [(one.name, getattr(origin, one.name), getattr(wanted, one.name)) for one in fields(wanted)]  # type: ignore[arg-type]  # a dataclass


def _short(value: object) -> Any:  # Any: JSON values
    """`plain` without the fields that are at their defaults; `kind` stays, it says which form is meant."""
    if is_dataclass(value):
        value = {one.name: getattr(value, one.name) for one in fields(value) if not _is_default(one, value)}
    if isinstance(value, Mapping):
        inner = CommentedMap((name, _short(item)) for name, item in value.items())
        if not any(isinstance(item, Mapping) for item in inner.values()):
            inner.fa.set_flow_style()
        return inner
    items = plain(value)
    if isinstance(items, list):
        items = CommentedSeq(items)
        items.fa.set_flow_style()
    return items


def _is_default(one: Any, value: object) -> bool:  # Any: a field of any type
    if one.name == "kind":
        return False
    default = one.default_factory() if one.default_factory is not MISSING else one.default
    return default is not MISSING and plain(getattr(value, one.name)) == plain(default)
