"""YAML files to validated dataclasses and back; every error names the file and the key."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import lru_cache
from io import StringIO
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import CallError, did_you_mean
from fgtrack.core.files import open_text
from fgtrack.io.yaml_text import safe_yaml

T = TypeVar("T")

SMALLEST = 1e-12
"""No configured number but 0 is nearer to it, in any unit: squares and products stay finite."""
_LONGEST_VALUE = 4096  # of a path


def load(kind: type[T], path: Path | None, settings: Sequence[str] = ()) -> T:
    """An instance of the dataclass `kind` from the YAML file `path`, with `settings` of the form a.b=value on top.

    A setting below a key that the file leaves out changes that key's default: one sensor of all, the same `kind`.
    Without a file, from the defaults, which a `kind` that takes settings must have. Raises `CallError` for a missing
    file, wrong YAML, an unknown or repeated key, and a value of the wrong type or range.
    """
    raw = {} if path is None else read_yaml(path)
    return with_settings(kind, raw, settings, "defaults" if path is None else str(path))


def with_settings(kind: type[T], raw: dict[str, Any], settings: Sequence[str], origin: str) -> T:
    """`raw` as an instance of `kind`, as `load` reads it from a file."""
    if not settings:
        return validate(kind, raw, origin)
    defaults = validate(kind, {}, "defaults")
    for setting in settings:
        raw = _with_setting(raw, setting, defaults)
    return validate(kind, raw, f"{origin} with --set")


def read_yaml(path: Path) -> dict[str, Any]:  # Any: what YAML says is only known after validation
    """The mapping that the YAML 1.2 file `path` holds; empty for an empty file."""
    try:
        with open_text(path) as file:
            value = _parse(file.read(), str(path))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "is no text file"
        raise CallError(f"{path}: configuration cannot be read ({reason})") from error
    if not isinstance(value, dict | None):
        raise CallError(f"{path}: a mapping of keys to values is needed, this is {_name(value)}")
    return value or {}


def _parse(text: str, origin: str) -> Any:
    try:
        return safe_yaml(text)
    except MarkedYAMLError as error:
        line = "" if error.problem_mark is None else f":{error.problem_mark.line + 1}"
        problem = " ".join(str(error.problem or error.context).split())
        raise CallError(f"{origin}{line}: invalid YAML, {problem.split(' To suppress')[0]}") from error
    except YAMLError as error:
        raise CallError(f"{origin}: invalid YAML, {' '.join(str(error).split())}") from error


def names_of(key: str) -> list[str]:
    """Names of the path `key`; one that contains a dot stands in double quotes: `sensors."cam.top".std.x_m`.

    Empty where `key` is not a path.
    """
    quoted = r'(?:"[^"]+"|[^".]+)'
    if not re.fullmatch(rf"{quoted}(?:\.{quoted})*", key):
        return []
    return [name.strip('"') for name in re.findall(quoted, key)]


def key_and_value(setting: str) -> tuple[str, Any]:  # Any: what YAML says
    """The key and the value of a setting of the form a.b=value. Raises `CallError` for another form."""
    key, equals, text = setting.partition("=")
    if not equals or not names_of(key.strip()):
        raise CallError(
            f"--set {setting}: write key=value, with dots between the keys of a path and a name that contains a dot "
            "in double quotes (--set 'sensors.\"cam.top\".std.x_m=1')"
        )
    return key.strip(), _parse(text, f"--set {setting}")


def _with_setting(raw: dict[str, Any], setting: str, defaults: object) -> dict[str, Any]:
    key, value = key_and_value(setting)
    names = names_of(key)
    changed = dict(raw)
    inner = changed
    for name in names[:-1]:
        defaults = getattr(defaults, name, None)
        below = inner.get(name, _kept(defaults))
        if below is not None and not isinstance(below, dict):
            raise CallError(f"--set {setting}: {name} is a single value and has no keys below it")
        inner[name] = dict(below or {})
        inner = inner[name]
    inner[names[-1]] = value
    return changed


def _kept(default: object) -> dict[str, Any] | None:
    """What of a default stays where one key below it is set: the other names of a mapping, the form of a choice."""
    if isinstance(default, Mapping):
        kept: dict[str, Any] = plain(default)
        return kept
    return {"kind": default.kind} if hasattr(default, "kind") else None


def validate(kind: type[T], raw: Mapping[str, Any], origin: str) -> T:
    """`raw` as an instance of the dataclass `kind`; `origin` is named in errors."""
    try:
        text = json.dumps(raw)
    except (TypeError, ValueError) as error:
        raise CallError(f"{origin}: only plain YAML values and text keys are allowed ({error})") from error
    try:
        # What is unknown is found below, which says what is known.
        value: T = _adapter(kind).validate_json(text, strict=True, extra="ignore")  # type: ignore[arg-type]  # a class is hashable
    except ValidationError as error:
        raise CallError(f"{origin}: {_first(error)}{_meant(error, raw)}") from error
    for where, name, known in _unknown(raw, value, ""):
        hint = did_you_mean(name, known).removesuffix("?")
        raise CallError(f"{origin}: {where}{name}: unknown key{hint}, known here: {', '.join(known)}")
    for where, scalar in _scalars(plain(value), ""):
        if isinstance(scalar, str):
            if not scalar.isprintable():
                raise CallError(f"{origin}: {where}: {scalar!a} holds what is no letter or sign")
            if len(scalar) > _LONGEST_VALUE:
                raise CallError(
                    f"{origin}: {where}: {scalar[:50]} ... has {len(scalar)} letters, at most {_LONGEST_VALUE} are "
                    "allowed"
                )
        elif isinstance(scalar, int):
            if abs(scalar) >= 2**63:
                raise CallError(f"{origin}: {where}: {_name(scalar)} has more than 64 bits")
        elif scalar and not SMALLEST <= abs(scalar) <= LARGEST:
            raise CallError(
                f"{origin}: {where}: {_name(scalar)} is out of range, a magnitude of {SMALLEST:g} to {LARGEST:g} or 0 "
                "is needed"
            )
    return value


def _scalars(value: object, where: str) -> Iterator[tuple[str, float | str]]:
    """Every number and text in plain `value`, keys too, with its path."""
    if isinstance(value, float | int | str):
        yield where, value
    elif isinstance(value, (dict, list)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for name, item in items:
            yield where, name
            yield from _scalars(item, f"{where}.{name}" if where else str(name))


@lru_cache
def _adapter(kind: Any) -> TypeAdapter[Any]:  # Any: one for each dataclass, which takes pydantic a while to make
    return TypeAdapter(kind | None, config=ConfigDict(allow_inf_nan=False))  # a class by itself takes no `config`


def _first(error: ValidationError) -> str:
    """The first of pydantic's complaints in a line."""
    details = error.errors(include_url=False)
    first = details[0]
    where = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "union_tag_not_found":
        message = "needs the key `kind`, which says which of its forms is meant"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    given = "" if first["type"] in ("value_error", "missing") else f", not {_name(first.get('input'))}"
    return f"{where + ': ' if where else ''}{message}{given}{more}"


def _name(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _meant(error: ValidationError, raw: object) -> str:
    """What may have been meant: of a form that does not exist one that does; of a part that lacks something one beside.

    `sensors.radr.std` is missing where `sensors.radr` was not meant to be a new sensor.
    """
    first = error.errors(include_url=False)[0]
    if first["type"] == "union_tag_invalid":
        return did_you_mean(first["ctx"]["tag"], first["ctx"]["expected_tags"].replace("'", "").split(", "))
    if first["type"] != "missing" or len(first["loc"]) < 2:
        return ""
    for key in first["loc"][:-2]:
        raw = raw.get(key) if isinstance(raw, Mapping) else None
    name = first["loc"][-2]
    return did_you_mean(name, [key for key in raw if key != name]) if isinstance(raw, Mapping) else ""


def _unknown(raw: object, value: object, where: str) -> list[tuple[str, str, list[str]]]:
    """Keys of `raw` that the dataclasses in `value` do not have."""
    found = []
    if is_dataclass(value) and isinstance(raw, Mapping):
        known = [field.name for field in fields(value)]
        found = [(where, name, known) for name in raw if name not in known]
        for name in known:
            if name in raw:
                found += _unknown(raw[name], getattr(value, name), f"{where}{name}.")
    elif isinstance(value, Mapping) and isinstance(raw, Mapping):
        for name in raw:
            found += _unknown(raw[name], value.get(name), f"{where}{name}.")
    elif isinstance(raw, list) and isinstance(value, Sequence):
        for index, (item, inner) in enumerate(zip(raw, value, strict=False)):
            found += _unknown(item, inner, f"{where}{index}.")
    return found


def plain(value: object) -> Any:  # Any: JSON values, as `validate` takes them
    """A dataclass as mappings, lists and scalars, every key written out; `validate` reads it back to an equal value."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def dump(value: object) -> str:
    """YAML text of a dataclass, every key written out; `validate` reads it back to an equal value."""
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # ruamel declares it as None
    text = StringIO()
    yaml.dump(plain(value), text)
    return text.getvalue()
