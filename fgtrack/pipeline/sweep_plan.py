"""Plans a sweep: from a sweep file `fgtrack-sweep/1` to jobs, one for each point of the grid and each seed."""

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
from fgtrack.meaning.draft import opened
from fgtrack.pipeline.replay import versions
from fgtrack.pipeline.simulation import path_files
from fgtrack.sim.new_delays import SensorDelays
from fgtrack.sim.scenario import Scenario

#: Value of a key: JSON values, which the dataclass with this key validates.
Value = Any
#: Columns of every table of a sweep after the columns of the axes.
KEY_COLUMNS = ("seed", "estimator")
#: Column of the axis of recordings.
RECORDING = "recording"
#: Key in a group of keys that contains names for the group's values; the names are in the column of the group.
LABEL = "label"
#: Most jobs of a sweep; more are probably a mistake in the file.
_MOST_JOBS = 100_000
#: First names of the keys; keys of the configuration are written without it.
CONFIG = "config"
SCENARIO = "scenario"
DELAYS = "delays"
_KINDS: Mapping[str, Any] = {
    CONFIG: Config,
    SCENARIO: Scenario,
    DELAYS: dict[str, SensorDelays],
}


class Point(NamedTuple):
    """A point of the grid, or of one axis: cells by column, and the values of the changed keys."""

    cells: Mapping[str, Value]
    changes: Mapping[str, Value]


def _seeds(given: Value) -> Value:
    """Return the seeds 0, 1, 2 ... for a number of seeds; other values stay, for the validation."""
    listed = range(given) if type(given) is int else given
    return tuple(listed) if isinstance(listed, range | list) else given


@dataclass(frozen=True)
class SweepConfig:
    """Content of a sweep file; paths are relative to the file's folder."""

    format: Literal["fgtrack-sweep/1"]
    estimators: tuple[str, ...]
    """Estimators, which run on the same streams."""
    scenario: str | None = None
    """Name or file of a scenario; either this or `input` is required."""
    input: str | tuple[str, ...] | None = None
    """Path of a recording, instead of a scenario; a list of paths is an axis of the grid, in the column `recording`."""
    delays: str | None = None
    """File with new delays by sensor for the recording (see `fgtrack convert --delays`)."""
    config: str | None = None
    """Configuration file; null for the defaults."""
    duration_s: float | None = None
    """Duration of the simulated runs, instead of the scenario's."""
    seeds: Annotated[tuple[NonNegativeInt, ...], BeforeValidator(_seeds)] = (0,)
    """List of seeds, or the number of seeds from 0."""
    set: Mapping[str, Value] = field(default_factory=dict)
    """Keys and values that are changed in all runs."""
    vary: Mapping[str, Value] = field(default_factory=dict)
    """Axes of the grid: a key with its values, or a name with a group of keys that have equally many values."""
    one_at_a_time: Mapping[str, Value] = field(default_factory=dict)
    """As `vary`, but each value alone: the base, and then every value with all other keys as in the base."""
    metrics: tuple[str, ...] = ()
    """Columns of the metrics, where `*` matches any text; empty for all."""

    @property
    def recordings(self) -> tuple[str, ...]:
        """Paths of the recordings; empty for a scenario."""
        if self.input is None:
            return ()
        return (self.input,) if isinstance(self.input, str) else self.input

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "estimators", tuple(map(ESTIMATORS.resolve, self.estimators))
        )
        is_recorded = self.input is not None
        changed = [self.set, *(point.changes for point in self.grid())]
        redelays = self.delays is not None or any(
            key.startswith(f"{DELAYS}.") for keys in changed for key in keys
        )
        listed = [("estimators", self.estimators), ("seeds", self.seeds)]
        listed += [("input", self.recordings)] if is_recorded else []
        for name, values in listed:
            if not values or len(set(values)) < len(values):
                raise ValueError(f"{name}: give at least one, and each only once")
        for wrong, text in (
            (
                is_recorded == (self.scenario is not None),
                "scenario, input: give exactly one of these keys",
            ),
            (
                is_recorded and self.duration_s is not None,
                "duration_s: applies to a scenario only, remove the key",
            ),
            (
                not is_recorded and self.delays is not None,
                "delays: applies to a recording only, vary scenario.sensors instead",
            ),
            (
                is_recorded and len(self.seeds) > 1 and not redelays,
                "seeds: a recording with its recorded delays needs a single seed",
            ),
        ):
            if wrong:
                raise ValueError(text)

    def grid(self) -> Iterator[Point]:
        """Yield the points of the grid; the last axis changes fastest. Raises `ValueError` with the path of the key."""
        axes = [
            _axis(f"vary.{name}", name, values) for name, values in self.vary.items()
        ]
        if self.one_at_a_time:
            axes.insert(0, _one_at_a_time(self.one_at_a_time))
        streams = len(self.seeds) * max(len(self.recordings), 1)
        if (count := math.prod(map(len, axes)) * streams) > _MOST_JOBS:
            raise ValueError(
                f"vary: {count} combinations of values, seeds and recordings, at most {_MOST_JOBS}"
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
    """Return the points of the axis `name`, whose key has the path `where`."""
    lists = given if isinstance(given, Mapping) else {name: given}
    lengths = {
        len(values) if isinstance(values, (list, tuple)) else 0
        for values in lists.values()
    }
    if not set(lists) - {LABEL} or len(lengths) > 1 or 0 in lengths:
        raise ValueError(
            f"{where}: must be a list of values, or a mapping of keys to equally long lists"
        )
    points = []
    for values in zip(*lists.values(), strict=True):
        changes = dict(zip(lists, values, strict=True))
        label = {name: changes.pop(LABEL)} if LABEL in changes else {}
        points.append(Point({**label, **changes}, changes))
    return points


def _one_at_a_time(given: Mapping[str, Value]) -> list[Point]:
    """Return the point of the base, and a point for every value alone."""
    points = [Point({"changed": "base", "to": None}, {})]
    for name, values in given.items():
        for point in _axis(f"one_at_a_time.{name}", name, values):
            cells = list(point.cells.values())
            has_one_cell = len(cells) == 1 or name in point.cells  # one key, or a label
            points.append(
                Point(
                    {"changed": name, "to": cells[0] if has_one_cell else cells},
                    point.changes,
                )
            )
    return points


def compact(value: Value) -> str:
    """JSON text of `value`, without spaces."""
    return json.dumps(value, separators=(",", ":"))


#: Plain values that determine the cells of one job: `config`, `seed`, `estimators`, the `scenario` or the path
#: `recording` with its `delays` by sensor; hashes of the `messages`, of `files` and of the `code`.
Recipe = Mapping[str, Value]


@dataclass(frozen=True)
class Job:
    """A point of the grid and a seed: one stream, on which every estimator runs."""

    cells: tuple[Value, ...]
    """Values of the point of the grid, in the order of the axes' columns."""
    seed: int
    key: str
    """Hash of everything that determines the result: settings, seed, estimators, versions, plug-ins, read files."""
    recipe: Recipe | None
    """Everything that determines the result; None if the point of the grid cannot be run."""
    problem: str | None = None
    """Reason why the point of the grid cannot be run, if there is no recipe."""
    is_data_bad: bool = False
    """True if a file cannot be read; False if a setting is wrong."""


@dataclass(frozen=True)
class Plan:
    """The jobs of a sweep in the order of the grid: the seed changes fastest, then the last axis."""

    columns: tuple[str, ...]
    """Columns of the axes."""
    jobs: tuple[Job, ...]
    estimators: tuple[str, ...]
    metrics: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    """The sweep file, and the files and folders that it names."""


def load_plan(
    path: Path, recording: Path | None = None, settings: Sequence[str] = ()
) -> Plan:
    """Return the plan of the sweep file `path`; `settings` contains settings `a.b=value` for all runs.

    `recording` replaces the file's input, and is run with the first seed only. Raises
    `CallError` for an invalid file, and if no point of the grid can be run because of
    its settings. A single point that cannot be run becomes a job with a problem.
    """
    sweep = load(SweepConfig, path)
    folder = path.parent
    changes: dict[str, Value] = {
        "set": {**sweep.set, **dict(map(key_and_value, settings))}
    }
    if recording is not None:
        changes |= {
            "scenario": None,
            "duration_s": None,
            "delays": None,
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
    streams: list[tuple[dict[str, Value], _Recorded | None]] = [({}, None)]
    if sweep.input is None:
        base[SCENARIO] = plain(
            read_scenario(str(sweep.scenario), folder, sweep.duration_s)
        )
    else:
        base[DELAYS] = {} if sweep.delays is None else read_yaml(folder / sweep.delays)
        is_axis = not isinstance(sweep.input, str)
        streams = [
            ({RECORDING: name} if is_axis else {}, _Recorded((folder / name).resolve()))
            for name in sweep.recordings
        ]
    base = _with_keys(base, sweep.set, f"{path}: set")
    points = [
        (Point({**cells, **point.cells}, point.changes), recorded)
        for cells, recorded in streams
        for point in sweep.grid()
    ]
    jobs = tuple(
        job
        for point, recorded in points
        for job in _jobs(base, recipe, point, sweep.seeds, recorded)
    )
    if all(job.recipe is None and not job.is_data_bad for job in jobs):
        raise CallError(f"{path}: {jobs[0].problem}")
    named = (*sweep.recordings, sweep.delays, sweep.config, sweep.scenario)
    inputs = (path, *(folder / name for name in named if name is not None))
    return Plan(
        tuple(points[0][0].cells), jobs, sweep.estimators, sweep.metrics, inputs
    )


class _Recorded:
    """The recording of a sweep; each point of the grid reads it with its own input settings."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, tuple[str, Mapping[str, object]] | FgtrackError] = {}

    def read(self, config: InputConfig) -> tuple[str, Mapping[str, object]]:
        """Return a hash of settings and messages, and the settings, of the recording read with `config`.

        The hash covers the content of all files that are read. Raises `CallError` if
        `config` does not fit the recording, and `DataError` if a file cannot be read.
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
        source = opened(self.path, Config(input=config)).source
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
    """Return the jobs of one point of the grid, one for each seed."""
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
        else:
            # A recording's folder is hashed by its messages, a file by its content.
            read["paths"] = {
                name: _Recorded(Path(name)).read(InputConfig())[0]
                for name in path_files(valid[SCENARIO])
                if os.path.isdir(name)
            }
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
        if recorded is not None:
            seeded["recording"] = str(recorded.path)
        content = json.dumps({**seeded, "recording": None}, sort_keys=True)
        jobs.append(Job(cells, seed, _sha256(content.encode())[:32], seeded))
    return jobs


def _content(name: str) -> bytes:
    """Return the content of a file that a job reads; raises `DataError`."""
    try:
        return Path(name).read_bytes()
    except OSError as error:
        raise DataError(f"{name}: cannot be read ({error.strerror})") from error


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _with_keys(
    base: Mapping[str, Value], changes: Mapping[str, Value], where: str
) -> dict[str, Value]:
    """Return `base` with `changes`; keys of the configuration are written without the first name `config`."""
    changed = dict(base)
    for key, value in changes.items():
        names = names_of(key)
        if (
            not names
            or names[0] == "estimator"
            or names[0] in {SCENARIO, DELAYS} - base.keys()
        ):
            raise CallError(
                f"{where}.{key}: cannot be changed in this sweep, remove the key"
            )
        try:
            changed = with_value(
                changed,
                names if names[0] in (SCENARIO, DELAYS) else [CONFIG, *names],
                value,
            )
        except LookupError as error:
            raise CallError(f"{where}.{key}: {error.args[0]}") from error
    return changed
