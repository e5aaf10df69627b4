"""`fgtrack figure` and `report`: pictures of runs and sweeps, and one page of runs to look at."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal, cast

from matplotlib.figure import Figure
from typer import Argument, Option

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.output import check_no_overlap, check_output, new_file, new_files
from fgtrack.core.time import nanoseconds
from fgtrack.evaluation.runs import evaluated, start_ns
from fgtrack.evaluation.tables.compare import compare
from fgtrack.evaluation.tables.seeds import SWEEP_FILE, read_sweep
from fgtrack.recording_study import head_at
from fgtrack.show.figures.late_detection import drawn_close_up
from fgtrack.show.figures.paper import Paper, settings
from fgtrack.show.figures.plot import Planned, drawn, planned, planned_sweep, save_named
from fgtrack.show.figures.style import png, save_pages
from fgtrack.show.report import write_report


def figure(
    runs: Annotated[
        list[Path],
        Argument(
            metavar="RUN...", help="Run folders, folders of runs, or one sweep folder."
        ),
    ],
    out: Annotated[
        Path, Option("-o", "--out", help="Folder for the pictures, or one .pdf.")
    ],
    form: Annotated[
        Literal["png", "svg", "pdf"], Option("--format", help="Format of the pictures.")
    ] = "png",
    stamp: Annotated[
        float | None,
        Option(min=0.0, max=1e9, help="Close-up so many s after the first tick."),
    ] = None,
    width: Annotated[
        str | None,
        Option(metavar="3.4in", help="Width on paper (in, cm, mm), without title."),
    ] = None,
    font: Annotated[
        str | None, Option(metavar="NAME", help='Font, as "Times New Roman".')
    ] = None,
    style: Annotated[
        str | None, Option(metavar="FILE", help="Style of matplotlib (.mplstyle).")
    ] = None,
    every: Annotated[
        bool, Option("--all", help="Draw every object, run and metric, not the few.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Draw runs or a sweep: late detections, map, errors.

    Of runs: a late detection in close-up, the map, residuals, NEES and NIS, arrivals, errors over time and against
    lag. Of many objects or runs the worst few. Of a sweep: its metrics over the grid, mean and 95 % interval over the
    seeds.

    The close-up replays the recording up to a late detection that is typical of those that lower the error of the first
    run's present; where the recording is not there any more it is left out.
    """
    one_file = out.suffix.lower() == ".pdf" and not out.is_dir()
    if out.suffix.lower() in (".png", ".svg") and not out.is_dir():
        raise CallError(
            f"{out}: one picture cannot hold all figures, name a folder or a .pdf"
        )
    given = {"width": width, "font": font, "style": style}
    paper = cast(
        Paper, {name: value for name, value in given.items() if value is not None}
    )
    settings(paper)  # raises where one is not usable
    picture = (
        out if one_file else out / f"figure.{form}"
    )  # what else is in the folder stays
    with progress("draw"):
        sweeps = [folder for folder in runs if (folder / SWEEP_FILE).is_file()]
        if not sweeps:
            first, plans, missing = _of_runs(runs, picture, stamp, paper)
        elif len(runs) == 1 and stamp is None:
            first, plans, missing = [], planned_sweep(read_sweep(sweeps[0])), None
        else:
            raise CallError(
                f"{sweeps[0]}: is a sweep, name it alone and without --stamp"
            )
        named = chain(first, drawn(plans, every, **paper))
        if one_file:
            with new_file(out, overwrite) as file:
                save_pages((each for _, each in named), file)
            files = [out]
        else:
            with new_files(out, overwrite) as folder:
                files = [out / file.name for file in save_named(named, folder, form)]
    if missing is not None:
        say(f"no close-up: {missing}")
    for path in files:
        say(path)
    if not every and any(one.is_extra for one in plans):
        say(f"{sum(one.is_extra for one in plans)} more with --all")


def _of_runs(
    folders: Sequence[Path], out: Path, stamp: float | None, paper: Paper
) -> tuple[list[tuple[str, Figure]], list[Planned], DataError | None]:
    """The close-up, the other figures, and why there is no close-up."""
    result = evaluated(folders)
    check_no_overlap(out, [item.run.path for item in result])
    stamp_ns = None if stamp is None else start_ns(result) + nanoseconds(stamp)
    first, late = drawn_close_up(result, stamp_ns, **paper)
    missing = late if isinstance(late, DataError) else None
    if missing is not None and stamp is not None:
        raise missing
    return first, planned(result), missing


def report(
    runs: Runs,
    out: Annotated[Path, Option("-o", "--out", help="HTML file.")],
    overwrite: Overwrite = False,
) -> None:
    """Write one HTML file: verdict, viewer, figures, tables.

    It opens with the verdict, a viewer that plays the runs, and three figures; all tables and figures and the
    configuration are folded below. The file needs no network and no other file. Its close-up replays the recording;
    where that is not there any more it is left out.
    """
    check_output(out, overwrite)
    every = evaluated(runs)
    check_no_overlap(out, [item.run.path for item in every])
    with progress("report"):
        close_up, late = drawn_close_up(every)
        pictures = (
            (name, png(figure))
            for name, figure in chain(close_up, drawn(planned(every)))
        )
        size = write_report(
            every, compare(*every), pictures, out, head_at(late), overwrite
        )
    say(f"{out}: {size / 1e6:.1f} MB, open it in a browser")
