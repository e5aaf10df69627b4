"""The layout of a run folder `fgtrack-run/1`: its tables and their columns."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES

RUN_FORMAT = "fgtrack-run/1"
#: States whose covariance is written.
COVARIANCE_STATES = ("x", "y", "yaw", "speed", "yaw_rate")
#: Upper triangle of the covariance, row by row.
COVARIANCE_COLUMNS = tuple(
    f"p_{a}_{b}" for i, a in enumerate(COVARIANCE_STATES) for b in COVARIANCE_STATES[i:]
)
#: Last column of tracks.csv, the existence probability, where the lifecycle gives one.
SCORE = "score"
#: Columns of every table of a run folder, in their order.
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
#: Tables that are written only when there is something to write.
OPTIONAL_TABLES = (
    "smoothed",
    "lagged",
    "truth",
    "ignored",
    "ego",
    "objects",
    "detections",
)
ADDED_COLUMNS: Mapping[str, str | float] = {"id": "", SCORE: math.nan}
"""Columns that older runs may lack, and their cells then."""
NO_TRACK = -1
"""Track id of an update that belongs to no track."""

# A column holds floats, integers or text, as its name specifies; which its reader specifies.
Column = npt.NDArray[Any]
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
            "object_id",
        ),
        *("index", "num_measured", "num_tracks", "num_detections"),
    }
)
_LARGEST = 1e60  # its square is a number; more is no measurement, and no state


def column_type(name: str) -> type:
    """Type of the values of the column `name`: `str`, `int` or `float`."""
    return str if name in _TEXT else int if name in _INTEGERS else float


def column(name: str, cells: Sequence[Any] | Column) -> Column:
    """The column `name` of `cells`, shape (rows,); None is an empty cell, and a number beyond 1e60 is NaN."""
    kind = column_type(name)
    if kind is str:
        return np.array(["" if cell is None else cell for cell in cells], dtype=np.str_)
    if kind is int:
        return np.array(
            [NO_TRACK if cell is None else cell for cell in cells], dtype=np.int64
        )
    numbers = np.array(cells, dtype=np.float64)
    numbers[np.abs(numbers) > _LARGEST] = np.nan
    return numbers
