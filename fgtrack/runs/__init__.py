"""The run folder `fgtrack-run/1`, through which the evaluation gets the tracker's results: writer, reader, columns."""

from fgtrack.runs.columns import Columns
from fgtrack.runs.memory import MemoryRun
from fgtrack.runs.reader import Run, load_run
from fgtrack.runs.schema import (
    COLUMNS,
    COVARIANCE_COLUMNS,
    NO_TRACK,
    OPTIONAL_TABLES,
    RUN_FORMAT,
)
from fgtrack.runs.timing import Node, ready_times
from fgtrack.runs.writer import (
    RunWriter,
    TableFormat,
    TruthStorage,
    check_run,
    digest,
    is_run_folder,
    path_from_run,
    write_metrics,
)

__all__ = [
    "COLUMNS",
    "COVARIANCE_COLUMNS",
    "MemoryRun",
    "NO_TRACK",
    "Node",
    "OPTIONAL_TABLES",
    "RUN_FORMAT",
    "Run",
    "RunWriter",
    "TableFormat",
    "TruthStorage",
    "Columns",
    "check_run",
    "digest",
    "is_run_folder",
    "load_run",
    "path_from_run",
    "ready_times",
    "write_metrics",
]
