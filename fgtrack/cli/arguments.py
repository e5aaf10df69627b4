"""Arguments that several commands share."""

from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from fgtrack.inputs.recording import Storage
from fgtrack.runs import TableFormat, TruthStorage

Input = Annotated[
    Path,
    Argument(
        metavar="INPUT",
        help="Recording: rosbag2, .mcap, .db3, .bag, stream, CSV or data set.",
    ),
]
Inputs = Annotated[
    list[Path],
    Argument(
        metavar="INPUT...",
        help="Recordings, or a folder: rosbag2, .mcap, .db3, .bag, stream, CSV or data set.",
    ),
]
ConfigFile = Annotated[
    str | None,
    Option("-c", "--config", help="Configuration: a file (YAML) or a shipped name."),
]
TrackMap = Annotated[
    str | None,
    Option("--map", help="Map of the track (CSV), or `oval` for the built-in map."),
]
PitMap = Annotated[
    str | None, Option("--pit-map", help="Map of the pit lane (CSV), or `oval`.")
]
Settings = Annotated[
    list[str] | None,
    Option(
        "--set", metavar="KEY=VALUE", help="Override a configuration key; repeatable."
    ),
]
Overwrite = Annotated[
    bool, Option("--overwrite", help="Replace an existing output of this command.")
]
Seed = Annotated[int, Option(min=0, help="Seed of the random generator.")]
Reference = Annotated[
    str | None,
    Option(
        "--reference", help="Sensor with the correct clock, if two sensors disagree."
    ),
]
Jobs = Annotated[
    int | None,
    Option(min=1, help="Number of processes; default: one for each core."),
]
Dask = Annotated[
    str | None, Option(metavar="ADDRESS", help="Address of a dask cluster.")
]
Runs = Annotated[
    list[Path],
    Argument(metavar="RUN...", help="Run folders, or folders that contain runs."),
]
Json = Annotated[bool, Option("--json", help="Print JSON instead of tables.")]
StorageOption = Annotated[
    Storage, Option("--storage", help="Storage of a rosbag2 folder.")
]
TableFormatOption = Annotated[
    TableFormat,
    Option(
        "--format",
        help="Tables of the run folder: csv, or parquet (pyarrow) for hours.",
    ),
]
TruthOption = Annotated[
    TruthStorage | None,
    Option(
        "--truth",
        help="Truth of the run: a copy, or only in the recording (a stream; default for parquet).",
    ),
]
Form = Literal["md", "csv", "latex", "json"]
FormOption = Annotated[
    Form | None, Option("--format", help="Print this format instead of text tables.")
]
All = Annotated[
    bool, Option("--all", help="Show all tables and columns, not only the main ones.")
]
