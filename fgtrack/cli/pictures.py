"""`fgtrack figure` and `report`: figures of runs and sweeps, and an HTML report of runs."""

from collections.abc import Iterable, Iterator, Sequence
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
        Path, Option("-o", "--out", help="Folder for the figures, or a .pdf file.")
    ],
    form: Annotated[
        Literal["png", "svg", "pdf", "eps"],
        Option("--format", help="Format of the figures."),
    ] = "png",
    stamp: Annotated[
        float | None,
        Option(min=0.0, max=1e9, help="Time of the close-up [s after the first tick]."),
    ] = None,
    width: Annotated[
        str | None,
        Option(metavar="3.4in", help="Width on paper (in, cm, mm); omits the title."),
    ] = None,
    font: Annotated[
        str | None, Option(metavar="NAME", help='Font, e.g. "Times New Roman".')
    ] = None,
    style: Annotated[
        str | None, Option(metavar="FILE", help="Matplotlib style (.mplstyle).")
    ] = None,
    log: Annotated[
        str | None,
        Option(metavar="AXES", help="Logarithmic axes of a sweep: x, y or xy."),
    ] = None,
    legend: Annotated[
        str | None,
        Option(
            metavar="POSITION", help="Legend of a sweep: above, or ends (of the lines)."
        ),
    ] = None,
    every: Annotated[
        bool, Option("--all", help="Draw all objects, runs and metrics.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Draw runs or a sweep: late detections, map, errors.

    Runs: a late detection in close-up, the map, residuals, NEES and NIS, arrivals, and
    errors over time and against lag. With many objects or runs, only the worst are
    drawn. A sweep: metrics over the grid, with mean and 95 % interval over the seeds.

    The close-up replays the recording of the first run up to a typical late detection
    that lowers the error of the present. It is left out if the recording does not exist
    any more.
    """
    one_file = out.suffix.lower() == ".pdf" and not out.is_dir()
    if out.suffix.lower() in (".png", ".svg") and not out.is_dir():
        raise CallError(
            f"{out}: a picture file cannot contain all figures, give a folder or a .pdf"
        )
    given = {
        "width": width,
        "font": font,
        "style": style,
        "log": log,
        "legend": legend,
    }
    paper = cast(
        Paper, {name: value for name, value in given.items() if value is not None}
    )
    settings(paper)  # raises for an invalid option
    # Other files in the folder stay.
    picture = out if one_file else out / f"figure.{form}"
    with progress("draw"):
        sweeps = [folder for folder in runs if (folder / SWEEP_FILE).is_file()]
        if not sweeps:
            first, plans, missing = _of_runs(runs, picture, stamp, paper)
        elif len(runs) == 1 and stamp is None:
            first = []
            plans = planned_sweep(read_sweep(sweeps[0]))
            missing = None
        else:
            raise CallError(
                f"{sweeps[0]}: is a sweep, give it alone and without --stamp"
            )
        captions: dict[str, str] = {}
        named = _with_captions(chain(first, drawn(plans, every, **paper)), captions)
        if one_file:
            with new_file(out, overwrite) as file:
                save_pages((each for _, each in named), file)
            files = [out]
        else:
            with new_files(out, overwrite) as folder:
                files = [out / file.name for file in save_named(named, folder, form)]
    if width is not None:
        for name, caption in captions.items():
            say(f"caption of {name}: {caption}")
    if missing is not None:
        say(f"no close-up: {missing}")
    for path in files:
        say(path)
    if not every and any(one.is_extra for one in plans):
        say(f"{sum(one.is_extra for one in plans)} more figures with --all")


def _with_captions(
    named: Iterable[tuple[str, Figure]], captions: dict[str, str]
) -> Iterator[tuple[str, Figure]]:
    """Yield figures with their names; their captions are added to `captions`."""
    for name, figure in named:
        if caption := getattr(figure, "caption", ""):
            captions[name] = " ".join(caption.split())
        yield name, figure


def _of_runs(
    folders: Sequence[Path], out: Path, stamp: float | None, paper: Paper
) -> tuple[list[tuple[str, Figure]], list[Planned], DataError | None]:
    """Return the close-up, the other figures, and the reason if there is no close-up."""
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

    The page opens with the verdict, a viewer that plays the runs, and three figures.
    Other tables and figures, and the configuration, are folded below. The page needs no
    network and no other files. Its close-up replays the recording, and is left out if
    the recording does not exist any more.
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
    say(f"{out}: {size / 1e6:.1f} MB, open the file in a browser")
