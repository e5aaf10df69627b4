"""From a sweep file `fgtrack-sweep/1` to jobs: one for each point of the grid and each seed."""

import hashlib
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator

from fgtrack.core.errors import CallError
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.inputs import fingerprints
from fgtrack.pipeline.load import key_and_value, load, names_of, plain, read_yaml, validate
from fgtrack.pipeline.replay import versions
from fgtrack.pipeline.shipped import find_file, read_config, read_scenario
from fgtrack.sim.redelay import SensorDelays
from fgtrack.sim.scenario import Scenario

#: What a key may be set to: JSON, of which only the dataclass that has the key knows more.
Value = Any

#: Columns that every table of a sweep has behind those of its axes.
KEY_COLUMNS = ("seed", "estimator")

#: Key of a group of keys that names its values, in a column of the group's own name.
LABEL = "label"

#: More jobs than this are a slip of the pen.
MOST_JOBS = 100_000

#: Columns of `one_at_a_time`: which setting is changed, and to what; in the row without a change, this and nothing.
CHANGED, TO, BASE = "changed", "to", "base"

#: Roots of keys; those of the configuration have none.
CONFIG, SCENARIO, DELAYS = "config", "scenario", "delays"


def _seeds(given: Value) -> Value:
    """A number of seeds as 0, 1, 2, ...; anything else is left to the validation."""
    if isinstance(given, int) and not isinstance(given, bool):
        if given > MOST_JOBS:
            raise ValueError(f"no sweep has more than {MOST_JOBS}, not {given}")
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
    set: Mapping[str, Value] = field(default_factory=dict)
    """Keys that are changed for all runs alike."""
    vary: Mapping[str, Value] = field(default_factory=dict)
    """Axes of the grid: a key and its values, or a name and a group of keys with equally many values each."""
    one_at_a_time: Mapping[str, Value] = field(default_factory=dict)
    """Written as `vary`: the base, and then every value alone, all other keys as in the base."""
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
        num_points = math.prod(len(axis.points) for axis in self.axes())
        if num_points * len(self.seeds) > MOST_JOBS:
            raise ValueError(f"vary, seeds: {num_points} points by {len(self.seeds)} seeds, more than {MOST_JOBS} jobs")

    @property
    def _redelays(self) -> bool:
        varied = (key for axis in self.axes() for point in axis.points for key in point.changes)
        return self.delays is not None or any(key.startswith(f"{DELAYS}.") for key in (*self.set, *varied))

    def axes(self) -> "tuple[Axis, ...]":
        """The axes of the grid; raises `ValueError` with the key's path."""
        axes = tuple(_axis("vary", name, values) for name, values in self.vary.items())
        if self.one_at_a_time:
            axes = (_one_at_a_time(self.one_at_a_time), *axes)
        columns = [*KEY_COLUMNS, *(column for axis in axes for column in axis.columns)]
        for column in columns:
            if columns.count(column) > 1:
                raise ValueError(f"vary: {column!r} is named twice, or is a column that every table has")
        changes = [(axis.name, point.changes) for axis in axes for point in axis.points]
        for where, keys in (("set", self.set), *changes):
            for key in keys:
                self._check_key(where, key)
        return axes

    def grid(self) -> "Iterator[Point]":
        """The points of the grid; the last axis changes fastest."""
        for points in itertools.product(*(axis.points for axis in self.axes())):
            yield Point(
                cells=tuple(cell for point in points for cell in point.cells),
                changes={key: value for point in points for key, value in point.changes.items()},
                description=", ".join(point.description for point in points if point.description),
            )

    def _check_key(self, where: str, key: str) -> None:
        names = names_of(key)
        if not names:
            raise ValueError(f"{where}: {key!r} is not a key, write names with dots between them")
        root = names[0]
        if root == "estimator":
            raise ValueError(f"{where}: name estimators under `estimators`")
        if (root == SCENARIO and self.scenario is None) or (root == DELAYS and self.input is None):
            raise ValueError(f"{where}: {key} changes the {root}, of which this sweep has none")


@dataclass(frozen=True)
class Point:
    """A point of the grid, or of one of its axes."""

    cells: tuple[Value, ...]
    """Content of the columns."""
    changes: Mapping[str, Value]
    """Changed keys."""
    description: str
    """The point in a few words."""


@dataclass(frozen=True)
class Axis:
    """One direction of the grid."""

    name: str
    """Its path in the file."""
    columns: tuple[str, ...]
    """Columns of the tables that identify a point."""
    points: tuple[Point, ...]


def _axis(section: str, name: str, given: Value) -> Axis:
    """The axis under `section.name`; raises `ValueError` with the key's path."""
    where = f"{section}.{name}"
    if isinstance(given, (list, tuple)):
        lists = {name: _values(where, given)}
    elif isinstance(given, Mapping) and set(given) - {LABEL}:
        lists = {key: _values(f"{where}.{key}", values) for key, values in given.items()}
    else:
        raise ValueError(f"{where}: a list of values is needed, or a mapping of keys to lists of values")
    lengths = {key: len(values) for key, values in lists.items()}
    if len(set(lengths.values())) > 1:
        lengths_text = ", ".join(f"{key} has {length}" for key, length in lengths.items())
        raise ValueError(f"{where}: its keys change together and need equally many values, {lengths_text}")
    labels = {name: lists.pop(LABEL)} if LABEL in lists else {}
    points = []
    for cells in zip(*labels.values(), *lists.values(), strict=True):
        changes = dict(zip(lists, cells[len(labels) :], strict=True))
        shown = dict(zip(labels or lists, cells, strict=False))
        description = ", ".join(f"{column}={_short(cell)}" for column, cell in shown.items())
        points.append(Point(cells, changes, description))
    return Axis(where, (*labels, *lists), tuple(points))


def _one_at_a_time(given: Mapping[str, Value]) -> Axis:
    """The axis whose points are the base and every value alone; raises `ValueError` with the key's path."""
    section = "one_at_a_time"
    points = [Point((BASE, None), {}, "")]
    for name, values in given.items():
        axis = _axis(section, name, values)
        alike = len(axis.columns) == 1 or axis.columns[0] == name  # one key, or a label: the first cell says it all
        points += [replace(one, cells=(name, one.cells[0] if alike else list(one.cells))) for one in axis.points]
    return Axis(section, (CHANGED, TO), tuple(points))


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


@dataclass(frozen=True)
class Recipe:
    """All that decides the cells of one job, as plain values that any process can read."""

    scenario: Mapping[str, Value] | None
    """None where a recording is replayed."""
    recording: str | None
    """Path of the recording."""
    delays: Mapping[str, Value]
    """By sensor of the recording, what `redelay` takes; empty where it keeps its delays."""
    config: Mapping[str, Value]
    seed: int
    estimators: tuple[str, ...]


@dataclass(frozen=True)
class Job:
    """A grid point and a seed: one stream, and every estimator on it."""

    cells: tuple[Value, ...]
    """Content of the axes' columns."""
    seed: int
    key: str
    """Hash of all that decides the result: settings, seed, estimators, versions, plug-ins, and what is read."""
    recipe: Recipe | None
    problem: str | None = None
    """Why the grid point cannot be run, where there is no recipe."""


@dataclass(frozen=True)
class Plan:
    """The jobs of a sweep in the order of the grid: the last axis changes fastest, then the seed."""

    columns: tuple[str, ...]
    """Columns of the axes."""
    jobs: tuple[Job, ...]
    estimators: tuple[str, ...]
    metrics: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    """Files and folders that it was made of, and that its jobs read."""


def load_plan(path: Path, recording: Path | None = None, settings: Sequence[str] = ()) -> Plan:
    """The plan of the sweep file `path`, on `recording` instead of what it names, with `settings` a.b=value for all.

    A grid point with settings that do not fit is a job with a problem. A recording has one seed, the first.

    Raises
    ------
    CallError
        The file is wrong, something that it names is missing, or no grid point can be run.
    """
    sweep = load(SweepConfig, path)
    changes: dict[str, Value] = {"set": {**sweep.set, **dict(map(key_and_value, settings))}}
    if recording is not None:
        of_scenario = {"scenario": None, "duration_s": None, "delays": None}
        changes |= {**of_scenario, "input": str(recording.resolve()), "seeds": sweep.seeds[:1]}
    try:
        sweep = replace(sweep, **changes)
    except ValueError as error:
        raise CallError(f"{path}: {error}") from error
    try:
        sweep = replace(sweep, estimators=tuple(ESTIMATORS.resolve(name) for name in sweep.estimators))
    except CallError as error:
        raise CallError(f"{path}: estimators: {error}") from error
    base = _with_keys(_base(sweep, path), sweep.set, f"{path}: set")
    source = None if sweep.input is None else (path.parent / sweep.input).resolve()
    reads = _Reads(source)
    jobs = tuple(job for point in sweep.grid() for job in _jobs(sweep, base, point, reads))
    if all(job.recipe is None for job in jobs):
        raise CallError(f"{path}: {jobs[0].problem}")
    columns = tuple(column for axis in sweep.axes() for column in axis.columns)
    return Plan(columns, jobs, sweep.estimators, sweep.metrics, (path, *_inputs(sweep, base, path)))


def _base(sweep: SweepConfig, path: Path) -> dict[str, Value]:
    """Scenario, delays and configuration before anything is varied, with every key written out."""
    folder = path.parent
    config = read_config(sweep.config, folder=folder)
    if sweep.input is not None:
        open_input(folder / sweep.input, config.input)  # raises where it is none
    delays = {} if sweep.delays is None else read_yaml(folder / sweep.delays)
    base = {CONFIG: plain(config), DELAYS: delays}
    if sweep.scenario is not None:
        base[SCENARIO] = plain(read_scenario(sweep.scenario, folder, sweep.duration_s))
    return base


def _inputs(sweep: SweepConfig, base: Mapping[str, Value], path: Path) -> list[Path]:
    """What the sweep file names, and what is named there; a value of an axis may name more."""
    folder = path.parent
    others = [] if sweep.delays is None else [folder / sweep.delays]
    others += [] if sweep.scenario is None else [find_file("scenario", sweep.scenario, folder)]
    others += [] if sweep.config is None else [find_file("configuration", sweep.config, folder)]
    others += [] if sweep.input is None else [folder / sweep.input]
    return others


class _Reads:
    """What decides the results of jobs besides their settings; `recording` is read once for each way to read it."""

    def __init__(self, recording: Path | None) -> None:
        self.recording = recording
        self._plugins: list[Value] = [ESTIMATORS.sources(), MOTION_MODELS.sources()]
        self._known: dict[str, list[Value]] = {}

    def __call__(self, scenario: Scenario | None, config: Config) -> list[Value]:
        """Fingerprints of what such a job reads and runs."""
        key = compact(plain([config.input, config.map, config.clock, scenario and scenario.map]))
        if key not in self._known:
            self._known[key] = [*fingerprints(self.recording, scenario, config), *self._plugins]
        return self._known[key]


def _jobs(sweep: SweepConfig, base: Mapping[str, Value], point: Point, reads: _Reads) -> Iterator[Job]:
    """The jobs of one grid point, one for each seed."""
    try:
        values = _with_keys(base, point.changes, "vary")
        config = validate(Config, values[CONFIG], "configuration")
        delays = validate(dict[str, SensorDelays], values[DELAYS], DELAYS)
        scenario = validate(Scenario, values[SCENARIO], SCENARIO) if SCENARIO in values else None
    except CallError as error:
        problem = f"{point.description}: {error}" if point.description else str(error)
        yield from (Job(point.cells, seed, "", None, problem) for seed in sweep.seeds)
        return
    files = reads(scenario, config)
    for seed in sweep.seeds:
        name = None if reads.recording is None else str(reads.recording)
        recipe = Recipe(plain(scenario), name, plain(delays), plain(config), seed, sweep.estimators)
        yield Job(point.cells, seed, job_key(recipe, files), recipe)


def job_key(recipe: Recipe, files: Sequence[Value]) -> str:
    """Hash of what decides the cells of a job, in hex; `files` are the fingerprints of what it reads and runs."""
    content = {**plain(recipe), "recording": None, "files": files, "versions": versions()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def _with_keys(base: Mapping[str, Value], changes: Mapping[str, Value], where: str) -> dict[str, Value]:
    """`base` with `changes`: dotted keys, those of the configuration without its name in front."""
    changed = dict(base)
    for key, value in changes.items():
        names = names_of(key)
        if names[0] not in (SCENARIO, DELAYS):
            names = [CONFIG, *names]
        try:
            changed = with_value(changed, names, value)
        except LookupError as error:
            raise CallError(f"{where}.{key}: {error.args[0]}") from error
    return changed
