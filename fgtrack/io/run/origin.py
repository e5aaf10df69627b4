"""Where the recording of a run is."""

import os
from pathlib import Path

from fgtrack.io.run.reader import Run


def recording_of(run: Run) -> Path | None:
    """Path of the recording that `run` was made of; None where it is not there any more, or never was a file.

    As it lies from the run folder, so that both may be moved together and the working directory may be another; else as
    it was given to the command.
    """
    source = run.meta.get("input") or {}
    given = [source["path"]] if source.get("path") else []
    if run.path is not None and source.get("path_from_run"):
        given.insert(0, run.path / str(source["path_from_run"]))
    places = (Path(os.path.realpath(each)) for each in given)
    return next((place for place in places if place.exists()), None)


def path_from_run(origin: str, folder: Path) -> str | None:
    """The path `origin` as seen from the run folder `folder`; None where it is no path of anything."""
    if not origin or not Path(origin).exists():
        return None
    try:
        return os.path.relpath(os.path.realpath(origin), os.path.realpath(folder))
    except ValueError:  # another drive
        return None
