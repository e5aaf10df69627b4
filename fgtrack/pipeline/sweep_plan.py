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

from fgtrack.core.errors import CallError, FgtrackError
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import key_and_value, load, names_of, plain, read_yaml, texts_of, validate, with_value
from fgtrack.pipeline.replay import versions
from fgtrack.pipeline.shipped import find_file, read_config, read_scenario
from fgtrack.sim.redelay import SensorDelays
from fgtrack.sim.scenario import Scenario

#: What a key may be set to: JSON, which is checked by the dataclass that has the key.
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
    """Return a number of seeds as 0, 1, 2, ...; anything else is left to the validation."""
    if type(given) is int:
        return tuple(range(min(given, MOST_JOBS + 1)))
    return tuple(given) if isinstance(given, list) else given


@dataclass(frozen=True)
class Point:
    """A point of the grid, or of one of its axes."""

    cells: Mapping[str, Value]
    """Content of the columns by name."""
    changes: Mapping[str, Value]
    """Values of the changed keys."""

    def __str__(self) -> str:
        texts = (f"{name}={cell if isinstance(cell, str) else compact(cell)}" for name, cell in self.cells.items())
        return ", ".join(text if len(text) <= 80 else text[:77] + "..." for text in texts)


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
        object.__setattr__(self, "estimators", tuple(map(ESTIMATORS.resolve, self.estimators)))
        recorded, axes = self.input is not None, self.axes()
        keys = [("set", key) for key in self.set]
        keys += [("vary", key) for axis in axes for point in axis for key in point.changes]
        absent = SCENARIO if recorded else DELAYS
        for where, key in keys:
            root = (names_of(key) or [""])[0]
            if root in ("", "estimator", absent):
                why = {"": "is not a key, write names with dots between them", "estimator": "belongs to `estimators`"}
                raise ValueError(f"{where}: {key} {why.get(root, f'changes the {root}, which this sweep lacks')}")
        redelays = self.delays is not None or any(key.startswith(f"{DELAYS}.") for _, key in keys)
        columns = [*KEY_COLUMNS, *(column for axis in axes for column in axis[0].cells)]
        num_jobs = math.prod(map(len, axes)) * len(self.seeds)
        for wrong, text in (
            (recorded == (self.scenario is not None), "scenario, input: name one of them"),
            (not self.estimators, "estimators: name at least one"),
            (len(set(self.estimators)) < len(self.estimators), "estimators: one is named twice"),
            (not self.seeds or min(self.seeds) < 0, "seeds: a number of seeds, or a list of numbers of 0 or more"),
            (len(set(self.seeds)) < len(self.seeds), "seeds: one is named twice"),
            (recorded and self.duration_s is not None, "duration_s: a recording has its own length"),
            (not recorded and self.delays is not None, "delays: a scenario has its own, vary scenario.sensors"),
            (recorded and len(self.seeds) > 1 and not redelays, "seeds: a recording with its own delays has one"),
            (len(set(columns)) < len(columns), f"vary: a column is named twice in {', '.join(columns)}"),
            (num_jobs > MOST_JOBS, f"vary, seeds: {num_jobs} jobs, at most {MOST_JOBS} are possible"),
        ):
            if wrong:
                raise ValueError(text)

    def axes(self) -> list[list[Point]]:
        """Points of each axis of the grid; raises `ValueError` with the key's path."""
        axes = [_axis(f"vary.{name}", name, values) for name, values in self.vary.items()]
        return [_one_at_a_time(self.one_at_a_time), *axes] if self.one_at_a_time else axes

    def grid(self) -> Iterator[Point]:
        """Yield the points of the grid; the last axis changes fastest."""
        for points in itertools.product(*self.axes()):
            cells = {column: cell for point in points for column, cell in point.cells.items()}
            yield Point(cells, {key: value for point in points for key, value in point.changes.items()})


def _axis(where: str, name: str, given: Value) -> list[Point]:
    """Points of the axis at the path `where`; raises `ValueError` with that path."""
    lists = given if isinstance(given, Mapping) else {name: given}
    lengths = {key: len(values) if isinstance(values, (list, tuple)) else 0 for key, values in lists.items()}
    if not set(lists) - {LABEL} or not all(lengths.values()):
        raise ValueError(f"{where}: a list of values is needed, or a mapping of keys to such lists")
    if len(set(lengths.values())) > 1:
        raise ValueError(f"{where}: its keys change together and need equally many values, not {compact(lengths)}")
    points = []
    for values in zip(*lists.values(), strict=True):
        changes = dict(zip(lists, values, strict=True))
        label = {name: changes.pop(LABEL)} if LABEL in changes else {}
        points.append(Point({**label, **changes}, changes))
    return points


def _one_at_a_time(given: Mapping[str, Value]) -> list[Point]:
    """Points of the base and of every value alone; raises `ValueError` with the key's path."""
    points = [Point({CHANGED: BASE, TO: None}, {})]
    for name, values in given.items():
        for point in _axis(f"one_at_a_time.{name}", name, values):
            cells = list(point.cells.values())
            alone = len(cells) == 1 or name in point.cells  # one key, or a label
            points.append(Point({CHANGED: name, TO: cells[0] if alone else cells}, point.changes))
    return points


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
    """Files and folders that the sweep file names, and itself."""


def load_plan(path: Path, recording: Path | None = None, settings: Sequence[str] = ()) -> Plan:
    """Return the plan of the sweep file `path`, with `settings` a.b=value for all its runs.

    `recording` replaces what the file names, with the first seed alone. A grid point with settings that do not fit is a
    job with a problem.

    Raises
    ------
    CallError
        The file is wrong, something that it names is missing, or no grid point can be run.
    """
    sweep, folder = load(SweepConfig, path), path.parent
    changes: dict[str, Value] = {"set": {**sweep.set, **dict(map(key_and_value, settings))}}
    if recording is not None:
        of_scenario = {"scenario": None, "duration_s": None, "delays": None}
        changes |= {**of_scenario, "input": str(recording.resolve()), "seeds": sweep.seeds[:1]}
    try:
        sweep = replace(sweep, **changes)
    except ValueError as error:
        raise CallError(f"{path}: {error}") from error
    config = read_config(sweep.config, folder=folder)
    named = [folder / one for one in (sweep.input, sweep.delays) if one is not None]
    base = {CONFIG: plain(config), DELAYS: {} if sweep.delays is None else read_yaml(folder / sweep.delays)}
    if sweep.config is not None:
        named.append(find_file("configuration", sweep.config, folder))
    if sweep.scenario is not None:
        named.append(find_file("scenario", sweep.scenario, folder))
        base[SCENARIO] = plain(read_scenario(sweep.scenario, folder, sweep.duration_s))
    if sweep.input is not None:
        open_input(folder / sweep.input, config.input)  # raises where it is none
    base = _with_keys(base, sweep.set, f"{path}: set")
    known: dict[str, str] = {}
    jobs = tuple(job for point in sweep.grid() for job in _jobs(sweep, folder, base, point, known))
    if all(job.recipe is None for job in jobs):
        raise CallError(f"{path}: {jobs[0].problem}")
    columns = tuple(column for axis in sweep.axes() for column in axis[0].cells)
    return Plan(columns, jobs, sweep.estimators, sweep.metrics, (path, *named))


def _jobs(
    sweep: SweepConfig, folder: Path, base: Mapping[str, Value], point: Point, known: dict[str, str]
) -> Iterator[Job]:
    """Yield the jobs of one grid point, one for each seed; `known` are fingerprints by what they depend on."""
    cells = tuple(point.cells.values())
    try:
        values = _with_keys(base, point.changes, "vary")
        config = validate(Config, values[CONFIG], "configuration")
        delays = validate(dict[str, SensorDelays], values[DELAYS], DELAYS)
        scenario = validate(Scenario, values[SCENARIO], SCENARIO) if SCENARIO in values else None
    except CallError as error:
        yield from (Job(cells, seed, "", None, f"{point}: {error}" if cells else str(error)) for seed in sweep.seeds)
        return
    source = None if sweep.input is None else (folder / sweep.input).resolve()
    recipe = Recipe(
        plain(scenario), None if source is None else str(source), plain(delays), plain(config), 0, sweep.estimators
    )
    files = sorted(text for text in texts_of([recipe.config, recipe.scenario]) if _is_file(text))
    read = compact([files, recipe.config["input"]])
    if read not in known:
        known[read] = fingerprint(source, config, files)
    for seed in sweep.seeds:
        seeded = replace(recipe, seed=seed)
        content = {**plain(seeded), "recording": None, "files": known[read], "versions": versions()}
        yield Job(cells, seed, hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32], seeded)


def fingerprint(recording: Path | None, config: Config, files: Sequence[str]) -> str:
    """Hash of all messages and settings of `recording`, of the content of `files`, and of the code of all plug-ins."""
    found = hashlib.sha256(repr([ESTIMATORS.sources(), MOTION_MODELS.sources()]).encode())
    for file in files:
        found.update(file.encode() + hashlib.sha256(Path(file).read_bytes()).digest())
    try:
        if recording is not None:
            source = open_input(recording, config.input)
            found.update(repr(source.settings()).encode())
            for message in source.messages():
                found.update(repr(message).encode())
    except FgtrackError as error:
        found.update(str(error).encode())
    return found.hexdigest()


def _is_file(text: str) -> bool:
    try:
        return Path(text).is_file()
    except (OSError, ValueError):  # longer than a path
        return False


def _with_keys(base: Mapping[str, Value], changes: Mapping[str, Value], where: str) -> dict[str, Value]:
    """Return `base` with `changes`: dotted keys, those of the configuration without its name in front."""
    changed = dict(base)
    for key, value in changes.items():
        names = names_of(key)
        try:
            changed = with_value(changed, names if names[0] in (SCENARIO, DELAYS) else [CONFIG, *names], value)
        except LookupError as error:
            raise CallError(f"{where}.{key}: {error.args[0]}") from error
    return changed
