"""Reads YAML files into validated dataclasses, and writes them; every error names the file and the key."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import CallError, did_you_mean
from fgtrack.core.files import open_text
from fgtrack.core.yaml_text import safe_yaml

T = TypeVar("T")
SMALLEST = 1e-12
"""Smallest magnitude of a configured number except 0, in any unit, so that squares and products stay finite."""
_UNKNOWN = "unexpected_keyword_argument"


def load(
    kind: type[T],
    path: Path | T | None,
    settings: Sequence[str] | Mapping[str, Any] = (),
) -> T:
    """Return an instance of `kind` from a YAML file, from another instance, or with the defaults (None).

    `settings` are values by dotted key, or texts a.b=value. Raises `CallError` with
    file and key.
    """
    if path is None:
        raw = {}
        origin = "defaults"
    elif isinstance(path, Path):
        raw = read_yaml(path)
        origin = str(path)
    else:
        raw = plain(path)
        origin = "the given configuration"
    changes = (
        settings
        if isinstance(settings, Mapping)
        else dict(map(key_and_value, settings))
    )
    return with_settings(kind, raw, changes, origin)


def with_settings(
    kind: type[T], raw: dict[str, Any], settings: Mapping[str, Any], origin: str
) -> T:
    """Return `raw` as an instance of `kind` after setting values by dotted keys.

    A key inside a section that `raw` does not contain changes a value of the section's default: a sensor among all
    sensors, or a value of the same `kind`.

    Raises `CallError` with the key.
    """
    if not settings:
        return validate(kind, raw, origin)
    defaults = validate(kind, {}, "defaults")
    for key, value in settings.items():
        try:
            raw = with_value(raw, names_of(key), value, defaults)
        except LookupError as error:
            raise CallError(f"--set {key}: {error.args[0]}") from error
    return validate(kind, raw, f"{origin} with --set")


def read_yaml(path: Path) -> dict[str, Any]:  # Any: validated later
    """Return the mapping in the YAML 1.2 file `path`; an empty file gives an empty mapping.

    Raises `CallError` if the file cannot be read, or contains no mapping.
    """
    try:
        with open_text(path) as file:
            value = _parse(file.read(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is no text file"
        raise CallError(f"{path}: configuration cannot be read ({reason})") from error
    if not isinstance(value, dict | None):
        raise CallError(
            f"{path}: must contain a mapping of keys to values, not {_short(value)}"
        )
    return value or {}


def _parse(text: str, origin: str) -> Any:
    try:
        return safe_yaml(text)
    except YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error)
        problem = problem.split("To suppress")[0]
        line = "" if mark is None else f":{mark.line + 1}"
        raise CallError(
            f"{origin}{line}: invalid YAML, {' '.join(problem.split())}"
        ) from error


def names_of(key: str) -> list[str]:
    """Return the names in the dotted path `key`; empty if it is malformed.

    A name that contains a dot is in double quotes: `sensors."cam.top".std.x_m`.
    """
    quoted = r'(?:"[^"]+"|[^".]+)'
    if not re.fullmatch(rf"{quoted}(?:\.{quoted})*", key):
        return []
    return [name.strip('"') for name in re.findall(quoted, key)]


def key_and_value(setting: str) -> tuple[str, Any]:
    """Return key and value of a setting `a.b=value`; raises `CallError` for another form."""
    key, equals, text = setting.partition("=")
    if not equals or not names_of(key.strip()):
        raise CallError(
            f"--set {setting}: must be key=value, with dots between the names of the key; a name that contains a dot "
            "is in double quotes (--set 'sensors.\"cam.top\".std.x_m=1')"
        )
    return key.strip(), _parse(text, f"--set {setting}")


def with_value(
    inside: Any, names: Sequence[str], value: Any, default: object = None
) -> Any:
    """Return a copy of `inside` with `value` at the path `names`.

    An entry of a list is selected by its index or its `name`. A mapping that is missing
    in `inside` is taken from `default`; a missing dataclass gets the `kind` of
    `default`. Raises `LookupError` for a path into a number or a text.
    """
    if not names:
        return value
    first = names[0]
    rest = names[1:]
    if inside is None:
        inside = plain(default) if isinstance(default, Mapping) else {}
        inside |= {"kind": default.kind} if hasattr(default, "kind") else {}
    if isinstance(inside, list):
        known = [
            str(item.get("name", k)) if isinstance(item, Mapping) else str(k)
            for k, item in enumerate(inside)
        ]
        known = known if first in known else [str(k) for k in range(len(inside))]
        if first not in known:
            raise LookupError(f"there is no entry {first!r} among {len(inside)}")
        index = known.index(first)
        return [
            *inside[:index],
            with_value(inside[index], rest, value),
            *inside[index + 1 :],
        ]
    if not isinstance(inside, Mapping):
        raise LookupError(f"there is no key {first!r} in the value {_short(inside)}")
    return {
        **inside,
        first: with_value(
            inside.get(first), rest, value, getattr(default, first, None)
        ),
    }


def validate(kind: type[T], raw: Mapping[str, Any], origin: str) -> T:
    """Return `raw` as an instance of the dataclass `kind`; raises `CallError` with `origin` and the key."""
    try:
        text = json.dumps(raw, default=_number)
    except (TypeError, ValueError) as error:
        raise CallError(
            f"{origin}: only plain YAML values and text keys are allowed ({error})"
        ) from error
    try:
        value: T = _adapter(kind).validate_json(text, strict=True, extra="forbid")  # type: ignore[arg-type]  # a class is hashable
    except ValidationError as error:
        raise CallError(f"{origin}: {_first_problem(error, kind, text)}") from error
    for where, scalar in _scalars(plain(value), ""):
        if (
            isinstance(scalar, float)
            and scalar
            and not SMALLEST <= abs(scalar) <= LARGEST
        ):
            raise CallError(
                f"{origin}: {where}: must be 0, or have a magnitude of {SMALLEST:g} to {LARGEST:g}, "
                f"not {_short(scalar)}"
            )
    return value


def texts_of(value: object) -> Iterator[str]:
    """Yield every text in plain `value`, including keys."""
    return (scalar for _, scalar in _scalars(value, "") if isinstance(scalar, str))


def _scalars(value: object, where: str) -> Iterator[tuple[str, float | str]]:
    """Yield every number and text in plain `value`, including keys, with its path."""
    if isinstance(value, float | int | str):
        yield where, value
    elif isinstance(value, (dict, list)):
        for name, item in (
            value.items() if isinstance(value, dict) else enumerate(value)
        ):
            yield where, name
            yield from _scalars(item, f"{where}.{name}" if where else str(name))


@lru_cache
def _adapter(kind: Any) -> TypeAdapter[Any]:  # Any: any dataclass
    # Cached, because pydantic takes long to create an adapter. `config` is not allowed for a class without `| None`.
    return TypeAdapter(kind | None, config=ConfigDict(allow_inf_nan=False))


def _number(value: object) -> object:
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} is not a plain value")


def _first_problem(error: ValidationError, kind: type[Any], text: str) -> str:
    """Return a line on the first error of pydantic; an unknown key takes precedence."""
    details = error.errors(include_url=False)
    first = next((item for item in details if item["type"] == _UNKNOWN), details[0])
    names = list[str]()
    inside = json.loads(text)
    part: Any
    for part in first["loc"]:  # the file does not contain tags of unions
        is_entry = (
            isinstance(inside, list) and isinstance(part, int) and part < len(inside)
        )
        if is_entry or (isinstance(inside, Mapping) and part in inside):
            names = [*names, str(part)]
            inside = inside[part]
    message = first["msg"].removeprefix("Value error, ")
    given = f", not {_short(first['input'])}"
    if first["type"] == _UNKNOWN:
        known = _known_keys(kind, text, names[:-1])
        hint = did_you_mean(names[-1], known).removesuffix("?")
        listed = f"; the keys are {', '.join(known)}" if known else ""
        message = f"unknown key{hint}{listed}"
        given = ""
    elif first["type"] == "missing":
        names.append(str(first["loc"][-1]))
        given = ""
    elif first["type"] == "union_tag_not_found":
        message = "the key `kind` is missing, which selects the form"
    elif first["type"] == "union_tag_invalid":
        given += did_you_mean(
            first["ctx"]["tag"],
            first["ctx"]["expected_tags"].replace("'", "").split(", "),
        )
    elif first["type"] == "value_error":
        given = ""
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    return f"{'.'.join(names) + ': ' if names else ''}{message}{given}{more}"


def _known_keys(kind: type[Any], text: str, names: Sequence[str]) -> list[str]:
    """Return the keys at the path `names`; empty if the rest of the document is invalid too."""
    try:
        inside = plain(_adapter(kind).validate_json(text, strict=True, extra="ignore"))  # type: ignore[arg-type]  # as above
    except ValidationError:
        return []
    for name in names:
        inside = inside[int(name)] if isinstance(inside, list) else inside[name]
    return list(inside)


def _short(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def plain(value: object) -> Any:  # Any: JSON values, as `validate` takes them
    """Return a dataclass as mappings, lists and scalars, with every key; `validate` converts them back."""
    if is_dataclass(value):
        return {
            field.name: plain(getattr(value, field.name)) for field in fields(value)
        }
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def dump(value: object) -> str:
    """Return the YAML text of a dataclass, with every key; `validate` reads it back to an equal value."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # ruamel declares it as None
    text = StringIO()
    yaml.dump(plain(value), text)
    return text.getvalue()
