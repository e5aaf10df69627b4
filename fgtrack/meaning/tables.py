"""Roles and columns of the tables of an unknown recording, guessed from names and values."""

import math
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.types import DESCRIBING, MEASURABLE, STATE_NAMES
from fgtrack.inputs.formats.fields import paths_of
from fgtrack.inputs.formats.tables import rows
from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.inputs.settings import CsvTable
from fgtrack.meaning.guess import agreeing_with_motion, guesses, words_of
from fgtrack.meaning.parts import (
    EGO_WORDS,
    FULL_EGO,
    NEEDED,
    POSITIONS,
    TRUTH_WORDS,
    InputPart,
    sensor_name,
    spreads,
    unused,
)
from fgtrack.meaning.stamps import stamps, with_receipt, with_stamp

__all__ = ["table_part"]

#: Number of rows of a table on which a guess is based.
_ROWS = 20_000
#: Words in the name of a table of the ego's poses.
_EGO_TABLES = frozenset(
    (
        "odom",
        "odometry",
        "pose",
        "poses",
        "trajectory",
        "traj",
        "gnss",
        "gps",
        "localization",
    )
)


def table_part(
    file: Path, columns: Sequence[str], is_folder: bool, parts: Sequence[InputPart]
) -> InputPart:
    """Return the guess for a table in addition to the other `parts`.

    Raises `DataError` with the ranges of its columns if the table cannot be used.
    """
    cells = [cells for _, cells in islice(rows(file), 1, _ROWS)]
    values = {
        name: [_number(item[name]) for item in cells]
        for name in columns
        if any(item[name] for item in cells)
    }
    own = guesses(
        {
            name: [value for value in result if math.isfinite(value)]
            for name, result in values.items()
        }
    )
    words = set(words_of(file.stem))
    is_truth = bool(words & TRUTH_WORDS and not words & EGO_WORDS)
    is_ego = bool(words & EGO_WORDS)
    if not (is_truth or "object_id" in own or "id" in own):
        is_named = bool(words & _EGO_TABLES) and NEEDED["ego"] <= own.keys()
        is_ego |= is_named or own.keys() >= FULL_EGO
    role = "ego" if is_ego else "truth" if is_truth else sensor_name(file.stem, parts)
    own = with_receipt(with_stamp(own, cells), values)
    if "stamp" not in own:
        raise DataError(f"no column of times among {spreads(values)}")
    times, unit, why = stamps(own["stamp"], cells)
    values[paths_of(own["stamp"].path)[0]] = times
    if is_ego:
        own = agreeing_with_motion(
            own, {name: np.array(result) for name, result in values.items()}, unit
        )
    have = own.keys() | ({"x_m", "y_m"} if own.keys() >= set(GEODETIC) else set())
    missing = NEEDED.get(role, set()) - have
    if missing or not any(wanted <= own.keys() for wanted in POSITIONS):
        raise DataError(
            f"no column for {', '.join(sorted(missing)) or 'a position'} among {spreads(values)}"
        )
    is_sensor = not (is_ego or is_truth)
    known = (
        "stamp",
        "receipt",
        *GEODETIC,
        *((*MEASURABLE, *DESCRIBING) if is_sensor else STATE_NAMES),
    )
    used = {
        key: item
        for key, item in own.items()
        if key in known or (key == "object_id" and not is_ego)
    }
    named = [str(own[key].path) for key in ("x_m", "y_m") if key in own and is_sensor]
    in_map = bool(named) and all(
        set(words_of(name)) & {"east", "easting", "north", "northing"} for name in named
    )
    table = CsvTable(
        {key: item.path for key, item in used.items()},
        file.name if is_folder else None,
        unit,  # type: ignore[arg-type]  # a name of NS_PER_UNIT
        frame="map" if in_map else None,
    )
    reasons = {
        **{key: item.reason for key, item in used.items()},
        "time_unit": why,
        "frame": "east and north",
    }
    return InputPart(role, table, reasons, unused(values, used))


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
