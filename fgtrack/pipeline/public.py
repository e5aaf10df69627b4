"""Replay and simulation as functions: `fgtrack.replay` and `fgtrack.simulate`."""

import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import overload

import numpy as np

from fgtrack.config.reading import ConfigLike, read_config, read_scenario
from fgtrack.config.recorded import recorded_of
from fgtrack.core.checks import check_paths
from fgtrack.core.errors import CallError
from fgtrack.core.types import Message
from fgtrack.inputs.recording import Storage, check_recording, write_recording
from fgtrack.inputs.validation import InvalidMessageError, validated_message
from fgtrack.meaning.draft import drafted
from fgtrack.pipeline import replay as pipeline
from fgtrack.pipeline.simulation import simulated
from fgtrack.runs import Run, TableFormat, TruthStorage, load_run
from fgtrack.sim.scenario import Scenario


def replay(
    recording: str | Path | Iterable[Message],
    config: ConfigLike | None = None,
    *,
    map: str | Path | None = None,  # noqa: A002 - the name of the option
    pit_map: str | Path | None = None,
    estimator: str | None = None,
    set: Mapping[str, object] | None = None,  # noqa: A002 - the name of the option
    out: str | Path | None = None,
    overwrite: bool = False,
    table_format: TableFormat = "csv",
    truth: TruthStorage | None = None,
) -> Run:
    """Replay a recording and return the run, which equals the run of the command `fgtrack replay`.

    If the recording breaks off, the messages before the break are replayed. Then a
    `UserWarning` is issued, and `meta["broken_off"]` contains the reason.

    Parameters
    ----------
    recording
        Path of a recording, or messages in the order of their receipt.
    config
        Name of a shipped configuration, path of a YAML file, a `Config`, or a mapping such as `run.config`. None stands
        for the defaults.
    map, pit_map
        CSV files of the track and of the pit lane, or `oval`.
    estimator
        Name of the estimator.
    set
        Values of single settings: `{"smoother.lag_s": 3.0}`. This argument and the three before replace settings of
        `config`.
    out
        Folder for the run; None keeps the run in memory.
    overwrite
        True to replace an existing run in `out`.
    table_format
        Format of the tables in `out`: `csv` or `parquet`.
    truth
        `copy` writes the truth into `out`. `recording` leaves it in the recording, an fgtrack stream. None copies it
        into CSV tables, and leaves it in the recording for Parquet tables.
    """
    resolved = read_config(
        config, set, track_map=map, pit_map=pit_map, estimator=estimator
    )
    check_paths(out=out)
    origin = ""
    kind = "messages"
    if isinstance(recording, (str, Path)):
        draft = drafted(recording, resolved)
        resolved = draft.config
        messages: Iterable[Message] = draft.source.messages()
        origin = str(recording)
        kind = draft.source.kind
        if draft.problem is not None:
            warnings.warn(draft.problem, stacklevel=2)
    else:
        messages = _messages(recording)
    if out is None:
        run = pipeline.replay_in_memory(messages, resolved, origin=origin, kind=kind)
    else:
        repeatable = pipeline.repeatable(messages, resolved)
        folders = {resolved.estimator: Path(out)}
        pipeline.replay(
            repeatable,
            resolved,
            folders,
            origin=origin,
            kind=kind,
            overwrite=overwrite,
            table_format=table_format,
            truth=truth,
        )
        run = load_run(out)
    if (broken := run.meta["broken_off"]) is not None:
        warnings.warn(
            f"the input broke off, and the messages before are replayed: {broken}",
            stacklevel=2,
        )
    return run


def _messages(recording: Iterable[Message]) -> Iterator[Message]:
    """Yield the messages of `recording`; raises `CallError` for other objects."""
    if not isinstance(recording, Iterable):
        raise CallError(
            f"recording: must be a path or messages, is a {type(recording).__name__}"
        )
    for count, message in enumerate(recording, 1):
        try:
            yield validated_message(message)
        except InvalidMessageError as error:
            raise CallError(f"recording: message {count}: {error}") from error


@overload
def simulate(
    scenario: str | Path | Scenario = "default",
    *,
    seed: int | np.random.Generator = 0,
    duration_s: float | None = None,
    out: None = None,
) -> Iterator[Message]: ...


@overload
def simulate(
    scenario: str | Path | Scenario = "default",
    *,
    seed: int | np.random.Generator = 0,
    duration_s: float | None = None,
    out: str | Path,
    storage: Storage = "mcap",
    overwrite: bool = False,
) -> Path: ...


def simulate(
    scenario: str | Path | Scenario = "default",
    *,
    seed: int | np.random.Generator = 0,
    duration_s: float | None = None,
    out: str | Path | None = None,
    storage: Storage = "mcap",
    overwrite: bool = False,
) -> Iterator[Message] | Path:
    """Simulate a scenario and return its messages in the order of receipt.

    With `out`, the messages are written to a recording, whose path is returned.

    Parameters
    ----------
    scenario
        Name of a shipped scenario, path of a YAML file, or a `Scenario`.
    seed
        Seed of the random generator, or a generator, which is advanced. Equal seeds give the same bits.
    duration_s
        Duration, instead of the scenario's.
    out
        Stream (`.jsonl`, `.jsonl.gz`) or rosbag2 folder to write; None returns the messages.
    storage
        Storage of a rosbag2 folder.
    overwrite
        True to replace an existing recording at `out`.
    """
    check_paths(out=out)
    is_generator = isinstance(seed, np.random.Generator)
    if not is_generator and not (isinstance(seed, (int, np.integer)) and seed >= 0):
        raise CallError(f"seed: must be a non-negative integer, is {seed!r}")
    if out is not None:
        check_recording(Path(out), overwrite)
    resolved = read_scenario(scenario, duration_s=duration_s)
    messages = simulated(resolved, np.random.default_rng(seed))
    if out is None:
        return messages
    write_recording(
        Path(out),
        messages,
        storage,
        settings=recorded_of(resolved),
        overwrite=overwrite,
    )
    return Path(out)
