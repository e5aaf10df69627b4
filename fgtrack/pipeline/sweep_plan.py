"""From a sweep file `fgtrack-sweep/1` to jobs: one for each point of the grid and each seed."""

import hashlib
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, NonNegativeInt

from fgtrack.config.reading import read_config, read_scenario
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import (
    key_and_value,
    load,
    names_of,
    plain,
    read_yaml,
    texts_of,
    validate,
    with_value,
)
from fgtrack.core.errors import CallError, DataError, FgtrackError
from fgtrack.estimation.registry import ESTIMATORS, MOTION_MODELS
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import open_input
from fgtrack.pipeline.replay import versions
from fgtrack.sim.redelay import SensorDelays
from fgtrack.sim.scenario import Scenario

#: Value of a key: JSON, which is validated by the dataclass that has the key.
Value = Any
#: Columns of every table of a sweep behind those of its axes.
KEY_COLUMNS = ("seed", "estimator")
#: Key of a group of keys that names its values, in a column of the group's own name.
LABEL = "label"
_MOST_JOBS = 100_000  # more are a slip of the pen
#: Roots of keys; those of the configuration have none.
CONFIG, SCENARIO, DELAYS = "config", "scenario", "delays"
_KINDS: Mapping[str, Any] = {
    CONFIG: Config,
    SCENARIO: Scenario,
    DELAYS: dict[str, SensorDelays],
}


class Point(NamedTuple):
    """A point of the grid, or of one of its axes: cells by column, and values of the changed keys."""

    cells: Mapping[str, Value]
    changes: Mapping[str, Value]


def _seeds(given: Value) -> Value:
    """Return a number of seeds as 0, 1, 2, ...; other forms are left to the validation."""
    listed = range(given) if type(given) is int else given
    return tuple(listed) if isinstance(listed, range | list) else given


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
    seeds: Annotated[tuple[NonNegativeInt, ...], BeforeValidator(_seeds)] = (0,)
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
        object.__setattr__(
            self, "estimators", tuple(map(ESTIMATORS.resolve, self.estimators))
        )
        is_recorded, changed = (
            self.input is not None,
            [self.set, *(point.changes for point in self.grid())],
        )
        redelays = self.delays is not None or any(
            key.startswith(f"{DELAYS}.") for keys in changed for key in keys
        )
        for name, values in (("estimators", self.estimators), ("seeds", self.seeds)):
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}: name at least one, and each once")
        for wrong, text in (
            (
                is_recorded == (self.scenario is not None),
                "scenario, input: name one of them",
            ),
            (
                is_recorded and self.duration_s is not None,
                "duration_s: a recording has its own length",
            ),
            (
                not is_recorded and self.delays is not None,
                "delays: a scenario has its own, vary scenario.sensors",
            ),
            (
                is_recorded and len(self.seeds) > 1 and not redelays,
                "seeds: a recording with its own delays has one",
            ),
        ):
            if wrong:
                raise ValueError(text)

    def grid(self) -> Iterator[Point]:
        """Yield the points of the grid, the last axis changes fastest; raises `ValueError` with the key's path."""
        axes = [
            _axis(f"vary.{name}", name, values) for name, values in self.vary.items()
        ]
        if self.one_at_a_time:
            axes.insert(0, _one_at_a_time(self.one_at_a_time))
        if (count := math.prod(map(len, axes)) * len(self.seeds)) > _MOST_JOBS:
            raise ValueError(
                f"vary: {count} combinations of values and seeds, at most {_MOST_JOBS}"
            )
        for points in itertools.product(*axes):
            cells = {
                column: cell for point in points for column, cell in point.cells.items()
            }
            yield Point(
                cells,
                {
                    key: value
                    for point in points
                    for key, value in point.changes.items()
                },
            )


def _axis(where: str, name: str, given: Value) -> list[Point]:
    """Return the points of the axis at the path `where`."""
    lists = given if isinstance(given, Mapping) else {name: given}
    lengths = {
        len(values) if isinstance(values, (list, tuple)) else 0
        for values in lists.values()
    }
    if not set(lists) - {LABEL} or len(lengths) > 1 or 0 in lengths:
        raise ValueError(
            f"{where}: a list of values is needed, or a mapping of keys to equally long lists"
        )
    points = []
    for values in zip(*lists.values(), strict=True):
        changes = dict(zip(lists, values, strict=True))
        label = {name: changes.pop(LABEL)} if LABEL in changes else {}
        points.append(Point({**label, **changes}, changes))
    return points


def _one_at_a_time(given: Mapping[str, Value]) -> list[Point]:
    """Return the points of the base and of every value alone."""
    points = [Point({"changed": "base", "to": None}, {})]
    for name, values in given.items():
        for point in _axis(f"one_at_a_time.{name}", name, values):
            cells = list(point.cells.values())
            alone = len(cells) == 1 or name in point.cells  # one key, or a label
            points.append(
                Point(
                    {"changed": name, "to": cells[0] if alone else cells}, point.changes
                )
            )
    return points


def compact(value: Value) -> str:
    """Return `value` as JSON without spaces."""
    return json.dumps(value, separators=(",", ":"))


#: All that decides the cells of one job, as plain values: `config`, `seed`, `estimators`, the `scenario` or the path
#: `recording` with its `delays` by sensor; hashes of its `messages`, of `files` and of the `code`.
Recipe = Mapping[str, Value]


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
    is_data_bad: bool = False
    """True if the problem is a file that cannot be read, and not a setting."""


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


def load_plan(
    path: Path, recording: Path | None = None, settings: Sequence[str] = ()
) -> Plan:
    """Return the plan of the sweep file `path`, with `settings` a.b=value for all its runs.
    `recording` replaces the input of the file, with the first seed alone. Raises `CallError` for an invalid file, and
    where no grid point can be run; a single point that cannot be run is a job with a problem.
    """
    sweep, folder = load(SweepConfig, path), path.parent
    changes: dict[str, Value] = {
        "set": {**sweep.set, **dict(map(key_and_value, settings))}
    }
    if recording is not None:
        of_scenario = {"scenario": None, "duration_s": None, "delays": None}
        changes |= {
            **of_scenario,
            "input": str(recording.resolve()),
            "seeds": sweep.seeds[:1],
        }
    try:
        sweep = replace(sweep, **changes)
    except ValueError as error:
        raise CallError(f"{path}: {error}") from error
    config = read_config(sweep.config, folder=folder)
    base = {CONFIG: plain(config)}
    code = [ESTIMATORS.sources(), MOTION_MODELS.sources(), versions()]
    recipe: dict[str, Value] = {
        "estimators": sweep.estimators,
        "recording": None,
        "code": code,
    }
    recorded = None
    if sweep.input is None:
        base[SCENARIO] = plain(
            read_scenario(str(sweep.scenario), folder, sweep.duration_s)
        )
    else:
        base[DELAYS] = {} if sweep.delays is None else read_yaml(folder / sweep.delays)
        recorded = _Recorded((folder / sweep.input).resolve())
        recipe["recording"] = str(recorded.path)
    base = _with_keys(base, sweep.set, f"{path}: set")
    points = list(sweep.grid())
    jobs = tuple(
        job
        for point in points
        for job in _jobs(base, recipe, point, sweep.seeds, recorded)
    )
    if all(job.recipe is None and not job.is_data_bad for job in jobs):
        raise CallError(f"{path}: {jobs[0].problem}")
    named = (sweep.input, sweep.delays, sweep.config, sweep.scenario)
    inputs = (path, *(folder / name for name in named if name is not None))
    return Plan(tuple(points[0].cells), jobs, sweep.estimators, sweep.metrics, inputs)


class _Recorded:
    """The recording of a sweep, which each point reads by its own configuration of the input."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, tuple[str, Mapping[str, object]] | FgtrackError] = {}

    def read(self, config: InputConfig) -> tuple[str, Mapping[str, object]]:
        """Return the hash of the settings and messages that this configuration gives, and the settings.

        The hash is that of the content of all files that are read. Raises `CallError` where the configuration does not
        fit the recording, and `DataError` where one of these files cannot be read.
        """
        name = repr(config)
        if name not in self._known:
            try:
                self._known[name] = self._read(config)
            except FgtrackError as error:
                self._known[name] = error
        known = self._known[name]
        if isinstance(known, FgtrackError):
            raise known
        return known

    def _read(self, config: InputConfig) -> tuple[str, Mapping[str, object]]:
        source = open_input(self.path, config)
        settings = source.settings()
        result = hashlib.sha256(repr(settings).encode())
        for message in source.messages():
            result.update(repr(message).encode())
        return result.hexdigest(), settings


def _jobs(
    base: Mapping[str, Value],
    recipe: Recipe,
    point: Point,
    seeds: Sequence[int],
    recorded: _Recorded | None,
) -> list[Job]:
    """Return the jobs of one grid point, one for each seed."""
    cells = tuple(point.cells.values())
    try:
        values = _with_keys(base, point.changes, "vary")
        valid = {
            name: validate(_KINDS[name], value, name) for name, value in values.items()
        }
        values = {name: plain(value) for name, value in valid.items()}
        read: dict[str, Value] = {}
        texts = list(texts_of(values))
        if recorded is not None:
            read["messages"], settings = recorded.read(valid[CONFIG].input)
            texts += texts_of(plain(settings))
        read["files"] = {
            text: _sha256(_content(text)) for text in texts if os.path.isfile(text)
        }
    except (CallError, DataError) as error:
        where = ", ".join(f"{name}={cell!s:.80}" for name, cell in point.cells.items())
        problem = f"{where}: {error}" if cells else str(error)
        return [
            Job(cells, seed, "", None, problem, isinstance(error, DataError))
            for seed in seeds
        ]
    jobs = []
    for seed in seeds:
        seeded = {**recipe, **values, **read, "seed": seed}
        content = json.dumps({**seeded, "recording": None}, sort_keys=True)
        jobs.append(Job(cells, seed, _sha256(content.encode())[:32], seeded))
    return jobs


def _content(name: str) -> bytes:
    """Return the content of a file that a job reads. Raises `DataError`."""
    try:
        return Path(name).read_bytes()
    except OSError as error:
        raise DataError(f"{name}: cannot be read ({error.strerror})") from error


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _with_keys(
    base: Mapping[str, Value], changes: Mapping[str, Value], where: str
) -> dict[str, Value]:
    """Return `base` with `changes`: dotted keys, those of the configuration without its name in front."""
    changed = dict(base)
    for key, value in changes.items():
        names = names_of(key)
        if (
            not names
            or names[0] == "estimator"
            or names[0] in {SCENARIO, DELAYS} - base.keys()
        ):
            raise CallError(f"{where}.{key}: is not a key of the runs of this sweep")
        try:
            changed = with_value(
                changed,
                names if names[0] in (SCENARIO, DELAYS) else [CONFIG, *names],
                value,
            )
        except LookupError as error:
            raise CallError(f"{where}.{key}: {error.args[0]}") from error
    return changed
