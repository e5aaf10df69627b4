"""From a sweep file to jobs: one for each point of the grid and each seed."""

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from fgtrack.core.errors import CallError
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load, plain, read_yaml, validate
from fgtrack.pipeline.replay import versions
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.pipeline.sweep_config import (
    DELAYS,
    SCENARIO,
    Axis,
    SweepConfig,
    Value,
    with_value,
)
from fgtrack.sim.redelay import SensorDelays
from fgtrack.sim.scenario import Scenario

_CONFIG = "config"


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
    """Hash of all that decides the result: settings, seed, estimators, versions, and the files that are read."""
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


def load_plan(path: Path) -> Plan:
    """The plan of the sweep file `path`.

    A grid point with settings that do not fit is a job with a problem.

    Raises
    ------
    CallError
        The file is wrong, something that it names is missing, or no grid point can be run.
    """
    sweep = load(SweepConfig, path)
    try:
        sweep = replace(sweep, estimators=tuple(ESTIMATORS.resolve(name) for name in sweep.estimators))
    except CallError as error:
        raise CallError(f"{path}: estimators: {error}") from error
    axes = sweep.axes()
    base = _with_keys(_base(sweep, path), sweep.set, f"{path}: set")
    recording = None if sweep.input is None else (path.parent / sweep.input).resolve()
    jobs = tuple(job for point in _grid(axes) for job in _jobs(sweep, base, point, recording))
    if all(job.recipe is None for job in jobs):
        raise CallError(f"{path}: {jobs[0].problem}")
    columns = tuple(column for axis in axes for column in axis.columns)
    return Plan(columns, jobs, sweep.estimators, sweep.metrics)


@dataclass(frozen=True)
class _Point:
    """A point of the grid."""

    cells: tuple[Value, ...]
    """Content of the axes' columns."""
    changes: Mapping[str, Value]
    """Changed keys."""
    description: str
    """The point in a few words."""


def _grid(axes: Sequence[Axis]) -> Iterator[_Point]:
    for steps in itertools.product(*(range(len(axis.steps)) for axis in axes)):
        at = list(zip(axes, steps, strict=True))
        yield _Point(
            cells=tuple(cell for axis, step in at for cell in axis.cells(step)),
            changes={key: value for axis, step in at for key, value in zip(axis.keys, axis.steps[step], strict=True)},
            description=", ".join(axis.described(step) for axis, step in at),
        )


def _base(sweep: SweepConfig, path: Path) -> dict[str, Value]:
    """Scenario, delays and configuration before anything is varied, with every key written out."""
    folder = path.parent
    config = read_config(sweep.config, folder=folder)
    if sweep.input is not None:
        open_input(folder / sweep.input, config.input)  # raises where it is none
    delays = {} if sweep.delays is None else read_yaml(folder / sweep.delays)
    base = {_CONFIG: plain(config), DELAYS: delays}
    if sweep.scenario is not None:
        base[SCENARIO] = plain(read_scenario(sweep.scenario, folder, sweep.duration_s))
    return base


def _jobs(sweep: SweepConfig, base: Mapping[str, Value], point: _Point, recording: Path | None) -> Iterator[Job]:
    """The jobs of one grid point, one for each seed."""
    try:
        values = _with_keys(base, point.changes, "vary")
        config = plain(validate(Config, values[_CONFIG], "configuration"))
        delays = plain(validate(dict[str, SensorDelays], values[DELAYS], DELAYS))
        scenario = plain(validate(Scenario, values[SCENARIO], SCENARIO)) if SCENARIO in values else None
    except CallError as error:
        problem = f"{point.description}: {error}" if point.description else str(error)
        yield from (Job(point.cells, seed, "", None, problem) for seed in sweep.seeds)
        return
    files = _fingerprints(recording, scenario, config)
    for seed in sweep.seeds:
        name = None if recording is None else str(recording)
        recipe = Recipe(scenario, name, delays, config, seed, sweep.estimators)
        yield Job(point.cells, seed, job_key(recipe, files), recipe)


def job_key(recipe: Recipe, files: Sequence[Value]) -> str:
    """Hash of what decides the cells of a job, in hex; `files` are the fingerprints of what it reads."""
    content = {**plain(recipe), "recording": None, "files": files, "versions": versions()}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:32]


def _fingerprints(recording: Path | None, scenario: Value, config: Value) -> list[Value]:
    """Size and time of change of every file that a job reads: the recording, maps, ticks; missing ones have none."""
    names = [recording, None if scenario is None else scenario["map"]]
    names += [config["map"]["track"], config["map"]["pit"], config["clock"]["ticks_file"]]
    found: list[Value] = []
    for place, name in enumerate(names):
        top = None if name is None else Path(name)
        if top is None or not top.exists():
            continue
        for file in [top] if top.is_file() else sorted(item for item in top.rglob("*") if item.is_file()):
            stat = file.stat()
            found.append([place, str(file.relative_to(top)), stat.st_size, stat.st_mtime_ns])
    return found


def _with_keys(base: Mapping[str, Value], changes: Mapping[str, Value], where: str) -> dict[str, Value]:
    """`base` with `changes`: dotted keys, those of the configuration without its name in front."""
    changed = dict(base)
    for key, value in changes.items():
        names = key.split(".")
        if names[0] not in (SCENARIO, DELAYS):
            names = [_CONFIG, *names]
        try:
            changed = with_value(changed, names, value)
        except LookupError as error:
            raise CallError(f"{where}.{key}: {error.args[0]}") from error
    return changed
