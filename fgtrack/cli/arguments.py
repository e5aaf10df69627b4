"""Arguments that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from fgtrack.io.recording import Storage

Input = Annotated[
    Path,
    typer.Argument(help="Recording: rosbag2, .mcap, .db3, .bag, stream, CSV or data set."),
]
ConfigFile = Annotated[
    str | None,
    typer.Option("-c", "--config", help="Configuration: a file (YAML) or a shipped name; without it the defaults."),
]
TrackMap = Annotated[str | None, typer.Option("--map", help="Map of the track (CSV), or `oval` for the built-in one.")]
PitMap = Annotated[str | None, typer.Option("--pit-map", help="Map of the pit lane (CSV), or `oval`.")]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override one key of the configuration; may be repeated."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what such a command wrote there before.")]
Runs = Annotated[list[Path], typer.Argument(help="Run folders, or folders that hold run folders.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
StorageOption = Annotated[Storage, typer.Option("--storage", help="Storage of a rosbag2 folder.")]
