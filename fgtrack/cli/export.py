"""`fgtrack export`: runs for Foxglove, Lichtblick, RViz."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from fgtrack.cli.arguments import Overwrite, Runs
from fgtrack.cli.show import progress, say
from fgtrack.evaluation.viewer.export import export as written
from fgtrack.pipeline.shipped import shipped_folder


def export(
    runs: Runs,
    out: Annotated[Path, typer.Option("-o", "--out", help="MCAP file; with --ros2 also a rosbag2 folder.")],
    ros2: Annotated[
        bool, typer.Option("--ros2", help="Write standard ROS 2 messages instead of Foxglove's own.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Export runs for Foxglove, Lichtblick or RViz."""
    with progress("export"):
        exported = written(runs, out, ros2=ros2, overwrite=overwrite)
    for note in exported.notes:
        logging.getLogger(__name__).warning(note)
    say(f"{out}: {sum(exported.counts.values())} messages on {len(exported.counts)} topics")
    if not ros2:
        say(f"layout to import: {shipped_folder() / 'foxglove_layout.json'}")
