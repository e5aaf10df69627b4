"""The run folder `fgtrack-run/1`, the interface of tracking and evaluation: writer, reader, layout; runs in memory."""

from fgtrack.io.run.judging import EvaluationConfig, evaluation_config
from fgtrack.io.run.memory import MemoryRun
from fgtrack.io.run.origin import path_from_run, recording_of
from fgtrack.io.run.reader import NO_TRACK, Run, Table, load_run
from fgtrack.io.run.schema import COLUMNS, COVARIANCE_COLUMNS, OPTIONAL_TABLES, RUN_FORMAT
from fgtrack.io.run.timing import Node, ready_times
from fgtrack.io.run.writer import RUN, RunWriter, digest, is_run_folder, write_metrics

__all__ = [
    "COLUMNS",
    "COVARIANCE_COLUMNS",
    "EvaluationConfig",
    "MemoryRun",
    "NO_TRACK",
    "Node",
    "OPTIONAL_TABLES",
    "RUN",
    "RUN_FORMAT",
    "Run",
    "RunWriter",
    "Table",
    "digest",
    "evaluation_config",
    "is_run_folder",
    "load_run",
    "path_from_run",
    "ready_times",
    "recording_of",
    "write_metrics",
]
