"""`fgtrack figure`: pictures of runs."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import typer
from matplotlib.figure import Figure

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.time import nanoseconds
from fgtrack.evaluation.figures.style import save_pages
from fgtrack.evaluation.plot import close_up, named_figures, save_named
from fgtrack.evaluation.runs import JudgedRun, judged, start_ns
from fgtrack.io.output import Kind, new_file, new_files
from fgtrack.pipeline.close_up import close_ups

PDF = Kind("a PDF file", lambda path: path.is_file() and path.read_bytes()[:4] == b"%PDF")


def figure(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pictures, or one .pdf.")],
    form: Annotated[Literal["png", "svg", "pdf"], typer.Option("--format", help="Format of the pictures.")] = "png",
    track: Annotated[int | None, typer.Option(help="Track of the close-up, in the first run.")] = None,
    stamp: Annotated[float | None, typer.Option(help="Stamp of the close-up: s after the first tick.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw runs: late detections, map, residuals, errors, time.

    A late detection in close-up, map, residuals, arrivals, delays, errors over time and against lag, time per tick.

    The close-up replays the recording up to the late detection that moved the present of the first run most; where the
    recording is not there any more it is left out.
    """
    found = judged(runs)
    stamp_ns = None if stamp is None else start_ns(found) + nanoseconds(stamp)
    one_file = out.suffix.lower() == ".pdf" and not out.is_dir()
    if out.suffix.lower() in (".png", ".svg") and not out.is_dir():
        raise CallError(f"{out}: one picture cannot hold all figures, name a folder or a .pdf")
    with progress("draw"):
        first, missing = drawn_close_up(found, track, stamp_ns)
        if missing is not None and (track is not None or stamp is not None):
            raise missing
        named = chain(first, named_figures(found))
        if one_file:
            with new_file(out, PDF, overwrite) as file:
                save_pages((each for _, each in named), file)
            files = [out]
        else:
            with new_files(out, overwrite) as folder:
                files = [out / file.name for file in save_named(named, folder, form)]
    if missing is not None:
        say(f"no close-up: {missing}")
    for path in files:
        say(path)


def drawn_close_up(
    runs: Sequence[JudgedRun], track_id: int | None = None, stamp_ns: int | None = None
) -> tuple[list[tuple[str, Figure]], DataError | None]:
    """The close-up of `runs` by its name; none where there is none, and why."""
    try:
        return [("close_up", close_up(runs, close_ups([one.run for one in runs], track_id, stamp_ns)))], None
    except DataError as error:
        return [], error
