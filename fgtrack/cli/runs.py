"""Run folders named on the command line."""

from pathlib import Path

from fgtrack.core.errors import CallError
from fgtrack.io.run import Run, is_run_folder, read_run


def read_runs(paths: list[Path]) -> list[Run]:
    """The runs at `paths`; a folder that is none but holds some stands for all of them, by name."""
    runs = []
    for path in paths:
        if is_run_folder(path):
            runs.append(read_run(path))
            continue
        below = [child for child in sorted(path.iterdir()) if is_run_folder(child)] if path.is_dir() else []
        if not below:
            raise CallError(f"{path}: no run folder, make one with `fgtrack replay`")
        runs += [read_run(child) for child in below]
    return runs
