"""Replay and simulation in one call each, as `fgtrack.replay` and `fgtrack.simulate`."""

import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import overload

import numpy as np

from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError
from fgtrack.core.types import Message
from fgtrack.io.recording import Storage, check_recording, write_recording
from fgtrack.io.run import Run, load_run
from fgtrack.io.source import open_input
from fgtrack.pipeline import replay as pipeline
from fgtrack.pipeline.assumptions.assumed import assumed
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.recorded import recorded_of
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import simulate as simulated


def replay(
    recording: str | Path | Iterable[Message],
    config: str | Path | Config | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    estimator: str | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    out: str | Path | None = None,
    overwrite: bool = False,
) -> Run:
    """Replay a recording through the tracker.

    Gives the same numbers and the same digest as the command `fgtrack replay`. A recording that breaks off is replayed
    up to the break, with a `UserWarning`; the run's `meta["broken_off"]` says why.

    Parameters
    ----------
    recording
        Path of anything that fgtrack reads, or messages in the order of their receipt.
    config
        Name of a shipped configuration, path of a YAML file, or a `Config`; None for the defaults.
    map, pit_map
        CSV files of the track and of the pit lane, or `oval`; instead of those of the configuration.
    estimator
        Name of the estimator, instead of that of the configuration.
    set
        Values of single settings: `{"smoother.lag_s": 3.0}`.
    out
        Folder to write the run to; None keeps it in memory.
    overwrite
        Whether a run in `out` may be replaced.

    Raises
    ------
    CallError
        The configuration or `out` does not fit.
    DataError
        The recording cannot be read, or a sensor of it has no model.
    """
    resolved = read_config(config, set, track_map=map, pit_map=pit_map, estimator=estimator)
    check_paths(out=out)
    origin, kind = "", "messages"
    if isinstance(recording, (str, Path)):
        source = open_input(recording, resolved.input)
        resolved = assumed(resolved, source).config
        messages: Iterable[Message] = source.messages()
        origin, kind = str(recording), source.kind
    else:
        messages = _messages(recording)
    if out is None:
        run = pipeline.replay_in_memory(messages, resolved, origin=origin, kind=kind)
    else:
        repeatable = pipeline.repeatable(messages, resolved)
        folders = {resolved.estimator: Path(out)}
        pipeline.replay(repeatable, resolved, folders, origin=origin, kind=kind, overwrite=overwrite)
        run = load_run(out)
    if (broken := run.meta["broken_off"]) is not None:
        warnings.warn(f"the input broke off, replayed up to there: {broken}", stacklevel=2)
    return run


def _messages(recording: Iterable[Message]) -> Iterator[Message]:
    """The messages of `recording`. Raises `CallError` for what holds none."""
    if not isinstance(recording, Iterable):
        raise CallError(f"recording: must be a path or messages, is a {type(recording).__name__}")
    for message in recording:
        if not isinstance(message, Message):
            raise CallError(f"recording: a {type(message).__name__} is no message")
        yield message


@overload
def simulate(
    scenario: str | Path | Scenario = "default", *, seed: int = 0, duration_s: float | None = None, out: None = None
) -> Iterator[Message]: ...


@overload
def simulate(
    scenario: str | Path | Scenario = "default",
    *,
    seed: int = 0,
    duration_s: float | None = None,
    out: str | Path,
    storage: Storage = "mcap",
    overwrite: bool = False,
) -> Path: ...


def simulate(
    scenario: str | Path | Scenario = "default",
    *,
    seed: int = 0,
    duration_s: float | None = None,
    out: str | Path | None = None,
    storage: Storage = "mcap",
    overwrite: bool = False,
) -> Iterator[Message] | Path:
    """Simulate a scenario: messages in the order of their receipt, or the path of the recording written.

    Parameters
    ----------
    scenario
        Name of a shipped scenario, path of a YAML file, or a `Scenario`.
    seed
        Of the random generator; the same seed gives the same bits.
    duration_s
        Length, instead of the scenario's.
    out
        Stream (`.jsonl`, `.jsonl.gz`), else a rosbag2 folder; None gives the messages.
    storage
        Storage of a rosbag2 folder.
    overwrite
        Whether a recording at `out` may be replaced.

    Raises
    ------
    CallError
        The scenario or `out` does not fit.
    """
    check_paths(out=out)
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise CallError(f"seed: must be an integer of 0 or more, is {seed!r}")
    if out is not None:
        check_recording(Path(out), overwrite)
    resolved = read_scenario(scenario, duration_s=duration_s)
    messages = simulated(resolved, np.random.default_rng(seed))
    if out is None:
        return iter(messages)
    write_recording(Path(out), messages, storage, settings=recorded_of(resolved), overwrite=overwrite)
    return Path(out)
