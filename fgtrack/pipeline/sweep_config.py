"""Sweep files `fgtrack-sweep/1`: what is varied."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

#: What a key may be set to: JSON, of which only the dataclass that has the key knows more.
Value = Any

#: Name of a scenario that needs no file.

#: Columns that every table of a sweep has behind those of its axes.
KEY_COLUMNS = ("seed", "estimator")

#: Key of a group of keys that names its values, in a column of the group's own name.
LABEL = "label"

#: Roots of keys; those of the configuration have none.
SCENARIO, DELAYS = "scenario", "delays"


def _seeds(given: Value) -> Value:
    """A number of seeds as 0, 1, 2, ...; anything else is left to the validation."""
    if isinstance(given, int) and not isinstance(given, bool):
        return tuple(range(given))
    return tuple(given) if isinstance(given, list) else given


@dataclass(frozen=True)
class SweepConfig:
    """The content of a sweep file. Paths are relative to its folder."""

    format: Literal["fgtrack-sweep/1"]
    estimators: tuple[str, ...]
    """Run on the same stream each."""
    scenario: str | None = None
    """A scenario file or `default`; it or `input` is needed."""
    input: str | None = None
    """A recording, instead of a scenario."""
    delays: str | None = None
    """A file of delays by sensor that the recording is given (see `fgtrack convert --delays`)."""
    config: str | None = None
    """A configuration file; null for the defaults."""
    duration_s: float | None = None
    """Length of the simulated runs, instead of the scenario's."""
    seeds: Annotated[tuple[int, ...], BeforeValidator(_seeds)] = (0,)
    """Seeds, or how many from 0 on."""
    set: Mapping[str, Value] = field(default_factory=lambda: MappingProxyType({}))
    """Keys that are changed for all runs alike."""
    vary: Mapping[str, Value] = field(default_factory=lambda: MappingProxyType({}))
    """Axes of the grid: a key and its values, or a name and a group of keys with equally many values each."""
    metrics: tuple[str, ...] = ()
    """Columns of metrics, `*` matches anything; all of them where none is named."""

    def __post_init__(self) -> None:
        if (self.scenario is None) == (self.input is None):
            raise ValueError("scenario, input: name one of them")
        if not self.estimators:
            raise ValueError("estimators: name at least one")
        for name, values in (("estimators", self.estimators), ("seeds", self.seeds)):
            if len(set(values)) < len(values):
                raise ValueError(f"{name}: one is named twice")
        if not self.seeds or min(self.seeds) < 0:
            raise ValueError("seeds: a positive number of them, or a list of numbers that are not negative")
        if self.input is not None and self.duration_s is not None:
            raise ValueError("duration_s: a recording is as long as it is")
        if self.scenario is not None and self.delays is not None:
            raise ValueError("delays: a scenario has delays of its own, vary scenario.sensors.NAME.delay")
        if self.input is not None and len(self.seeds) > 1 and not self._redelays:
            raise ValueError("seeds: nothing is drawn where a recording keeps its delays, leave them out")
        self.axes()

    @property
    def _redelays(self) -> bool:
        return self.delays is not None or any(key.startswith(f"{DELAYS}.") for axis in self.axes() for key in axis.keys)

    def axes(self) -> "tuple[Axis, ...]":
        """The axes of the grid; raises `ValueError` with the key's path."""
        axes = tuple(_axis(name, values) for name, values in self.vary.items())
        columns = [*KEY_COLUMNS, *(column for axis in axes for column in axis.columns)]
        for column in columns:
            if columns.count(column) > 1:
                raise ValueError(f"vary: {column!r} is named twice, or is a column that every table has")
        for where, keys in (("set", self.set), *((f"vary.{axis.name}", axis.keys) for axis in axes)):
            for key in keys:
                self._check_key(where, key)
        return axes

    def _check_key(self, where: str, key: str) -> None:
        root = key.split(".")[0]
        if not all(key.split(".")):
            raise ValueError(f"{where}: {key!r} is no key, write names with dots between them")
        if root == "estimator":
            raise ValueError(f"{where}: name estimators under `estimators`")
        if (root == SCENARIO and self.scenario is None) or (root == DELAYS and self.input is None):
            raise ValueError(f"{where}: {key} changes the {root}, of which this sweep has none")


@dataclass(frozen=True)
class Axis:
    """One direction of the grid."""

    name: str
    keys: tuple[str, ...]
    steps: tuple[tuple[Value, ...], ...]
    """The value of every key at each step."""
    labels: tuple[Value, ...] | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the tables that identify the step."""
        return self.keys if self.labels is None else (self.name, *self.keys)

    def cells(self, step: int) -> tuple[Value, ...]:
        """Content of `columns` at a step."""
        return self.steps[step] if self.labels is None else (self.labels[step], *self.steps[step])

    def described(self, step: int) -> str:
        """The step in a few words."""
        columns = self.columns if self.labels is None else self.columns[:1]
        return ", ".join(f"{name}={_short(cell)}" for name, cell in zip(columns, self.cells(step), strict=False))


def _axis(name: str, given: Value) -> Axis:
    """The axis under `vary.name`; raises `ValueError` with the key's path."""
    if isinstance(given, (list, tuple)):
        return Axis(name, (name,), tuple((value,) for value in _values(f"vary.{name}", given)))
    if not isinstance(given, Mapping) or not set(given) - {LABEL}:
        raise ValueError(f"vary.{name}: a list of values is needed, or a mapping of keys to lists of values")
    lists = {key: _values(f"vary.{name}.{key}", values) for key, values in given.items()}
    lengths = {key: len(values) for key, values in lists.items()}
    if len(set(lengths.values())) > 1:
        lengths_text = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise ValueError(f"vary.{name}: its keys change together and need equally many values, {lengths_text}")
    labels = lists.pop(LABEL, None)
    return Axis(name, tuple(lists), tuple(zip(*lists.values(), strict=True)), labels)


def _values(where: str, given: Value) -> tuple[Value, ...]:
    if not isinstance(given, (list, tuple)) or not given:
        raise ValueError(f"{where}: a list of at least one value is needed")
    return tuple(given)


def with_value(inside: Value, names: Sequence[str], value: Value) -> Value:
    """A copy of `inside` in which the entry at the path `names` is `value`.

    An entry of a list is addressed by its index or by its `name`. Raises `LookupError` where there is no such path;
    what is left out of a mapping may be set, its reader knows the keys.
    """
    if not names:
        return value
    first, rest = names[0], names[1:]
    if isinstance(inside, list):
        place = _place(inside, first)
        return [with_value(item, rest, value) if index == place else item for index, item in enumerate(inside)]
    if not isinstance(inside, Mapping):
        raise LookupError(f"there is no {first!r} in {compact(inside)}")
    return {**inside, first: with_value(inside.get(first, {}) if rest else None, rest, value)}


def _place(items: list[Value], name: str) -> int:
    """Index of the item of this name, or index."""
    named = [item.get("name") if isinstance(item, Mapping) else None for item in items]
    if name in named:
        return named.index(name)
    if name.isdecimal() and int(name) < len(items):
        return int(name)
    known = ", ".join(str(one) for one in named if one is not None)
    raise LookupError(f"there is no {name!r} among {len(items)} entries{f' ({known})' if known else ''}")


def _short(value: Value) -> str:
    text = value if isinstance(value, str) else compact(value)
    return text if len(text) <= 60 else text[:57] + "..."


def compact(value: Value) -> str:
    """`value` as JSON without spaces."""
    return json.dumps(value, separators=(",", ":"))
