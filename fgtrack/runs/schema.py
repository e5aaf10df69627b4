"""Tables of a run folder `fgtrack-run/1`, and their columns."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES

RUN_FORMAT = "fgtrack-run/1"
#: States of the covariance in the tables.
COVARIANCE_STATES = ("x", "y", "yaw", "speed", "yaw_rate")
#: Columns of the covariance's upper triangle, row by row.
COVARIANCE_COLUMNS = tuple(
    f"p_{a}_{b}" for i, a in enumerate(COVARIANCE_STATES) for b in COVARIANCE_STATES[i:]
)
#: Last column of tracks.csv: the existence probability, if the lifecycle estimates it.
SCORE = "score"
#: Columns of each table, in the order of the file.
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "tracks": (
        *("tick", "now_ns", "stamp_ns", "track_id", "status"),
        *STATE_NAMES,
        "num_measured",
        *COVARIANCE_COLUMNS,
        SCORE,
    ),
    "updates": (
        *(
            "tick",
            "sensor",
            "stamp_ns",
            "receipt_ns",
            "index",
            "disposition",
            "track_id",
            "nis",
        ),
        *(f"res_{name}" for name in MEASURABLE),
    ),
    "timing": ("tick", "now_ns", "process_ns", "num_tracks", "num_detections"),
    "smoothed": ("track_id", "stamp_ns", "kind", *STATE_NAMES, *COVARIANCE_COLUMNS),
    "lagged": (
        "tick",
        "now_ns",
        "lag_s",
        "track_id",
        "stamp_ns",
        *STATE_NAMES,
        *COVARIANCE_COLUMNS,
    ),
    "revisions": (
        "tick",
        "sensor",
        "stamp_ns",
        "receipt_ns",
        "index",
        "old_track_id",
        "track_id",
    ),
    "final_tracks": (
        "track_id",
        "first_stamp_ns",
        "last_stamp_ns",
        "is_confirmed",
        "probability",
    ),
    "truth": ("stamp_ns", "object_id", *STATE_NAMES),
    "ignored": ("stamp_ns", "object_id", "x_m", "y_m", "outline_m"),
    "ego": ("stamp_ns", "receipt_ns", *STATE_NAMES),
    "objects": (
        "track_id",
        "class_name",
        "class_share",
        "length_m",
        "width_m",
        "height_m",
        "id",
    ),
    "detections": (
        "sensor",
        "stamp_ns",
        "receipt_ns",
        "index",
        "frame",
        *MEASURABLE,
        *DESCRIBING,
    ),
}
#: Tables without a file if they have no rows.
OPTIONAL_TABLES = (
    "smoothed",
    "lagged",
    "revisions",
    "final_tracks",
    "truth",
    "ignored",
    "ego",
    "objects",
    "detections",
)
ADDED_COLUMNS: Mapping[str, str | float] = {"id": "", SCORE: math.nan}
"""Columns that older runs lack, and the value of their cells."""
NO_TRACK = -1
"""Track id of an update without a track."""

Column = npt.NDArray[Any]
"""Values of a column, shape (rows,): floats, integers or text, depending on the name (`column_type`)."""
_TEXT = frozenset(
    {
        "status",
        "sensor",
        "disposition",
        "kind",
        "frame",
        "class_name",
        "id",
        "outline_m",
    }
)
_INTEGERS = frozenset(
    {
        *(
            "tick",
            "now_ns",
            "stamp_ns",
            "receipt_ns",
            "process_ns",
            "track_id",
            "old_track_id",
            "first_stamp_ns",
            "last_stamp_ns",
            "is_confirmed",
            "object_id",
        ),
        *("index", "num_measured", "num_tracks", "num_detections"),
    }
)


def written_columns(table: str, is_scored: bool) -> tuple[str, ...]:
    """Names of the columns in the file of `table`; `is_scored` as in `RunSink`."""
    names = COLUMNS[table]
    return names if is_scored or table != "tracks" else names[:-1]


#: Largest number of a column, whose square is finite; no measurement and no state exceeds it.
_LARGEST = 1e60


def column_type(name: str) -> type:
    """Type of the values of the column `name`: `str`, `int` or `float`."""
    return str if name in _TEXT else int if name in _INTEGERS else float


def column(name: str, cells: Sequence[Any] | Column) -> Column:
    """Return the column `name`, shape (rows,), from `cells`.

    None is an empty cell, and a number beyond 1e60 becomes NaN.
    """
    kind = column_type(name)
    if kind is int and isinstance(cells, np.ndarray) and cells.dtype == np.int64:
        return cells
    if kind is str:
        return np.array(["" if cell is None else cell for cell in cells], dtype=np.str_)
    if kind is int:
        return np.array(
            [NO_TRACK if cell is None else cell for cell in cells], dtype=np.int64
        )
    numbers = np.array(cells, dtype=np.float64)
    numbers[np.abs(numbers) > _LARGEST] = np.nan
    return numbers
