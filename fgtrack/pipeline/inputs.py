"""What is read besides what is named: maps, areas, ticks, message definitions, tables beside a recording."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from fgtrack.core.errors import CallError
from fgtrack.io.ros.typestore import definition_files
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


def fingerprints(recording: Path | None, scenario: Scenario | None, config: Config) -> list[tuple[int, str, int, int]]:
    """Place, name, size and time of change of every file that a run reads, where it is there."""
    found = []
    tops = [recording, *_files_of(config, recording, scenario), *map(Path, config.input.message_definitions)]
    for place, top in enumerate(tops):
        if top is None:
            continue
        for file in _files_at(top, place == 0):
            stat = file.stat()
            found.append(
                (place, file.name if file == top else str(file.relative_to(top)), stat.st_size, stat.st_mtime_ns)
            )
    return found


def _files_of(config: Config | None, recording: Path | None, scenario: Scenario | None) -> list[Path | None]:
    """The files, each in a place of its own: of the scenario, of the configuration, and beside the recording."""
    found = [_map(None if scenario is None else scenario.map)]
    if config is not None:
        ticks = config.clock.ticks_file
        found += [_map(config.map.track), _map(config.map.pit), None if ticks is None else Path(ticks)]
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


def _files_at(top: Path, is_recording: bool) -> list[Path]:
    """A file alone; all files of a recording that is a folder, and the definitions in a folder of them."""
    if not top.is_dir():
        return [top] if top.is_file() else []
    if is_recording:
        return sorted(file for file in top.rglob("*") if file.is_file())
    with suppress(CallError):
        return definition_files(top)
    return []
