"""Recordings in a folder."""

from collections.abc import Sequence
from pathlib import Path

from fgtrack.core.errors import CallError, DataError
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


def recordings_by_name(
    given: Sequence[Path], config: InputConfig | None = None
) -> dict[str, Path]:
    """Return the recordings `given`, or those in a single given folder, by name.

    The name is the file's name without its ending, or with it if names are equal
    otherwise. Raises `CallError` for equal names, and the exceptions of `recordings_in`.
    """
    paths = recordings_in(given[0], config) if len(given) == 1 else given
    stems = [path.name if path.is_dir() else path.name.split(".")[0] for path in paths]
    names = [
        stem if stems.count(stem) == 1 else path.name
        for path, stem in zip(paths, stems, strict=True)
    ]
    if len(set(names)) < len(names):
        raise CallError("two recordings have the same name: give them one by one")
    return dict(zip(names, paths, strict=True))


def _is_recording(path: Path) -> bool:
    if path.name.startswith("."):
        return False
    try:
        input_kind(path)
    except DataError:
        return path.name.endswith(_ENDINGS)
    return True
