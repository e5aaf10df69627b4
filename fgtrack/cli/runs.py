"""`fgtrack compare` and `export`: tables of runs, and runs in formats of other programs."""

from pathlib import Path
from typing import Annotated

from typer import Option

from fgtrack.cli.arguments import All, FormOption, Json, Overwrite, Runs
from fgtrack.cli.show import progress, say, show, warn
from fgtrack.config.shipped import shipped_folder
from fgtrack.core.errors import CallError, FgtrackError
from fgtrack.evaluation.diagnostics import diagnostics
from fgtrack.evaluation.kitti_result import write_kitti_result
from fgtrack.evaluation.runs import evaluated, recordings_warning
from fgtrack.evaluation.tables.compare import compare as tables_of
from fgtrack.runs import load_run, write_metrics
from fgtrack.show.export import export as written
from fgtrack.show.geojson import write_geojson


def compare(
    runs: Runs,
    as_json: Json = False,
    form: FormOption = None,
    everything: All = False,
    streaming: Annotated[
        bool,
        Option(
            "--streaming", help="Also judge each output from the time it was ready."
        ),
    ] = False,
) -> None:
    """Compare runs in tables, and write metrics.json into each."""
    form = "json" if as_json else form
    every = evaluated(runs)
    lines = dict.fromkeys(
        f"{one.label}: {line}" for one in every for line in diagnostics(one.run)
    )
    for line in (*recordings_warning(every), *lines):
        warn(line)
    tables = tables_of(*every, streaming=streaming)
    for one in every:
        if one.run.path is not None:
            try:
                write_metrics(one.run.path, one.metrics.as_dict())
            except FgtrackError as error:
                warn(f"{error}; metrics.json is missing, the tables are complete")
    show(tables.in_full() if everything else tables, form)
    if form is None and not everything:
        say("\nall tables and columns: --all")


def export(
    runs: Runs,
    out: Annotated[
        Path,
        Option(
            "-o",
            "--out",
            help="MCAP file (--ros2: or rosbag2 folder, --kitti: text file).",
        ),
    ],
    ros2: Annotated[
        bool,
        Option(
            "--ros2", help="Write standard ROS 2 messages instead of Foxglove's own."
        ),
    ] = False,
    geojson: Annotated[
        bool,
        Option(
            "--geojson",
            help="Export tracks in latitude and longitude (.geojson, .csv).",
        ),
    ] = False,
    kitti: Annotated[
        Path | None,
        Option(metavar="OXTS", help="Write a KITTI result for this oxts/NNNN.txt."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Export runs for Foxglove, Lichtblick, RViz, maps, KITTI."""
    if (kitti is not None or geojson) and len(runs) != 1:
        raise CallError(
            f"--{'geojson' if geojson else 'kitti'}: exports a single run, but {len(runs)} are given"
        )
    if geojson:
        say(
            f"{out}: {write_geojson(load_run(runs[0]), out, overwrite=overwrite)} tracks"
        )
        return
    if kitti is not None:
        boxes, tracks, without_size = write_kitti_result(
            load_run(runs[0]), kitti, out, overwrite=overwrite
        )
        if without_size:
            warn(
                f"{without_size} tracks are left out, because none of their detections has a size"
            )
        say(f"{out}: {boxes} boxes of {tracks} tracks")
        return
    with progress("export"):
        counts, notes = written(runs, out, ros2=ros2, overwrite=overwrite)
    for note in notes:
        warn(note)
    say(f"{out}: {sum(counts.values())} messages on {len(counts)} topics")
    if not ros2:
        say(f"layout to import: {shipped_folder() / 'foxglove_layout.json'}")
