"""Recordings in a folder."""

from pathlib import Path

from fgtrack.core.errors import DataError
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import file_format, input_kind

#: Endings of files that are recordings, although a damaged one is not recognised by its content.
_ENDINGS = (".jsonl", ".jsonl.gz", ".mcap", ".db3", ".bag", ".ast")


def recordings_in(path: Path, config: InputConfig | None = None) -> list[Path]:
    """Return the recordings in the folder `path`, in the order of their names; `path` itself for a recording.

    A data set with several sequences counts as a folder. A file with the ending of a
    recording is returned even if it is damaged. Other files are left out.

    Raises the exceptions of `input_kind` if there is no recording.
    """
    try:
        return [
            *file_format(input_kind(path)).recordings(path, config or InputConfig())
        ]
    except DataError:
        found = [
            each
            for each in (sorted(path.iterdir()) if path.is_dir() else ())
            if _is_recording(each)
        ]
        if not found:
            raise
        return found


def _is_recording(path: Path) -> bool:
    if path.name.startswith("."):
        return False
    try:
        input_kind(path)
    except DataError:
        return path.name.endswith(_ENDINGS)
    return True
