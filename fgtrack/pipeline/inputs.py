"""What is read besides what is named: maps, areas, ticks, message definitions, tables beside a recording."""

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from fgtrack.core.errors import FgtrackError
from fgtrack.io.source import open_input
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import find_file
from fgtrack.sim.scenario import Scenario

__all__ = ["fingerprints", "inputs"]


def inputs(
    config: Config | None = None,
    recordings: Sequence[Path] = (),
    *,
    config_file: str | Path | None = None,
    scenario: Scenario | None = None,
    others: Iterable[Path | None] = (),
) -> list[Path]:
    """The files and folders that are there of what a command reads: its output must be none of them.

    `config_file` is a file or a shipped name; `others` are read as well.
    """
    named = [*recordings, *others, *(() if config_file is None else [find_file("configuration", config_file)])]
    for recording in recordings or (None,):
        named += _files_of(config, recording, scenario)
    named += _folders_of(config, recordings)
    return [path for path in dict.fromkeys(named) if path is not None and path.exists()]


def fingerprints(recording: Path | None, scenario: Scenario | None, config: Config) -> list[object]:
    """Hashes of what a run reads: of all messages of its recording, whatever files they come from, and of its files."""
    found: list[object] = []
    if recording is not None:
        found += [_hash_of_messages(recording, config)]
        files = [recording] if recording.is_file() else sorted(one for one in recording.rglob("*") if one.is_file())
        found += [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]  # for what is no message
    tops = _files_of(config, None, scenario)
    return found + [None if top is None else hashlib.sha256(top.read_bytes()).hexdigest() for top in tops]


def _hash_of_messages(recording: Path, config: Config) -> str:
    found = hashlib.sha256()
    try:
        for message in open_input(recording, config.input).messages():
            found.update(repr(message).encode())
    except FgtrackError as error:
        found.update(str(error).encode())
    return found.hexdigest()


def _files_of(config: Config | None, recording: Path | None, scenario: Scenario | None) -> list[Path | None]:
    """The files, each in a place of its own: of the scenario, of the configuration, and beside the recording."""
    found = [_map(None if scenario is None else scenario.map)]
    if config is not None:
        found += [_map(config.map.track_file), _map(config.map.pit)]
        found += map(Path, config.map.excluded)
        if recording is not None:
            folder, tables = recording if recording.is_dir() else recording.parent, config.input.csv
            every = (tables.ego, tables.truth, *tables.detections.values())
            found += [folder / one.file if one is not None and one.file else None for one in every]
    return [path if path is not None and path.is_file() else None for path in found]


def _folders_of(config: Config | None, recordings: Sequence[Path]) -> list[Path]:
    """What may be folders: message definitions, and the tables of nuScenes."""
    if config is None:
        return []
    tables = config.input.nuscenes.tables
    beside = [] if tables is None else [recording.parent / tables for recording in recordings]
    return [*map(Path, config.input.message_definitions), *beside]


def _map(name: str | None) -> Path | None:
    return None if name is None or name == OVAL else Path(name)
