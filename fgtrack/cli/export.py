"""`fgtrack export`: runs for Foxglove, Lichtblick, RViz."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.core.errors import CallError
from fgtrack.evaluation.kitti_result import write_kitti_result
from fgtrack.io.run import load_run
from fgtrack.pipeline.shipped import shipped_folder
from fgtrack.viewers.export import export as written


def export(
    runs: Runs,
    out: Annotated[
        Path, typer.Option("-o", "--out", help="MCAP file; --ros2: or a rosbag2 folder; --kitti: a text file.")
    ],
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Write standard ROS 2 messages instead of Foxglove's own.")
    ] = False,
    kitti: Annotated[
        Path | None,
        typer.Option("--kitti", metavar="OXTS", help="Write a KITTI result; names the sequence's oxts/NNNN.txt."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Export runs for Foxglove, Lichtblick, RViz; or a KITTI result."""
    if kitti is not None:
        _export_kitti(runs, kitti, out, overwrite)
        return
    with progress("export"):
        exported = written(runs, out, ros2=ros2, overwrite=overwrite)
    for note in exported.notes:
        logging.getLogger(__name__).warning(note)
    say(f"{out}: {sum(exported.counts.values())} messages on {len(exported.counts)} topics")
    if not ros2:
        say(f"layout to import: {shipped_folder() / 'foxglove_layout.json'}")


def _export_kitti(runs: list[Path], sequence: Path, out: Path, overwrite: bool) -> None:
    if len(runs) != 1:
        raise CallError(f"--kitti: writes one run, these are {len(runs)}")
    boxes, tracks, without_size = write_kitti_result(load_run(runs[0]), sequence, out, overwrite=overwrite)
    if without_size:
        log = logging.getLogger(__name__)
        log.warning(f"{without_size} tracks are left out: none of their detections has a size")
    say(f"{out}: {boxes} boxes of {tracks} tracks")
