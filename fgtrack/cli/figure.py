"""`fgtrack figure`: pictures of runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import DataError
from fgtrack.core.time import nanoseconds
from fgtrack.evaluation.plot import close_up, save, save_figures
from fgtrack.evaluation.runs import JudgedRun, judged, start_ns
from fgtrack.io.output import new_files
from fgtrack.pipeline.close_up import close_ups


def figure(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures.")],
    form: Annotated[Literal["png", "svg", "pdf"], typer.Option("--format", help="Format of the pictures.")] = "png",
    track: Annotated[int | None, typer.Option(help="Track of the close-up, in the first run.")] = None,
    stamp: Annotated[float | None, typer.Option(help="Stamp of the close-up: s after the first tick.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw runs: a late detection in close-up, map, residuals, delays, errors, lag, time per tick.

    The close-up replays the recording up to the late detection that moved the present of the first run most; where the
    recording is not there any more it is left out.
    """
    found = judged(runs)
    stamp_ns = None if stamp is None else start_ns(found) + nanoseconds(stamp)
    with progress("draw"), new_files(out, overwrite) as folder:
        files, missing = save_close_up(found, folder, form, track, stamp_ns)
        if missing is not None and (track is not None or stamp is not None):
            raise missing
        files += save_figures(found, folder, form)
    if missing is not None:
        say(f"no close-up: {missing}")
    for file in files:
        say(out / file.name)


def save_close_up(
    runs: Sequence[JudgedRun], folder: Path, form: str, track_id: int | None = None, stamp_ns: int | None = None
) -> tuple[list[Path], DataError | None]:
    """Write the close-up of `runs` into `folder`; the file, or none and why."""
    try:
        found = close_ups([one.run for one in runs], track_id, stamp_ns)
        return [save(close_up(runs, found), folder / f"close_up.{form}")], None
    except DataError as error:
        return [], error
