"""Fingerprints of what a run reads."""

import hashlib
from pathlib import Path

from fgtrack.core.errors import FgtrackError
from fgtrack.io.source import open_input
from fgtrack.models.oval import OVAL
from fgtrack.pipeline.config import Config
from fgtrack.sim.scenario import Scenario

__all__ = ["fingerprints"]


def fingerprints(recording: Path | None, scenario: Scenario | None, config: Config) -> list[object]:
    """Hashes of all messages of a recording, whatever files they come from, of its files and of maps."""
    found: list[object] = []
    if recording is not None:
        found += [_hash_of_messages(recording, config)]
        files = [recording] if recording.is_file() else sorted(one for one in recording.rglob("*") if one.is_file())
        found += [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]  # for what is no message
    maps = [None if scenario is None else scenario.map, config.map.track_file, config.map.pit, *config.map.excluded]
    paths = [None if name in (None, OVAL) else Path(name) for name in maps]
    return found + [path and path.is_file() and hashlib.sha256(path.read_bytes()).hexdigest() for path in paths]


def _hash_of_messages(recording: Path, config: Config) -> str:
    found = hashlib.sha256()
    try:
        for message in open_input(recording, config.input).messages():
            found.update(repr(message).encode())
    except FgtrackError as error:
        found.update(str(error).encode())
    return found.hexdigest()
