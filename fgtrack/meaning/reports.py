"""Mapping of a table of position reports, such as AIS and ADS-B, from the names of its columns."""

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from fgtrack.core.time import NS_PER_S, NS_PER_UNIT
from fgtrack.inputs.formats.fields import paths_of
from fgtrack.inputs.formats.table_times import Cells
from fgtrack.inputs.formats.tables import headers, rows
from fgtrack.inputs.geodetic import GEODETIC, LocalPlane
from fgtrack.inputs.settings import CsvTable, Field, FieldPath
from fgtrack.meaning.courses import motion_of, with_velocity
from fgtrack.meaning.guess import Guess, guesses, words_of
from fgtrack.meaning.parts import InputPart
from fgtrack.meaning.single_reports import NO_ID
from fgtrack.meaning.stamps import stamps, with_stamp
from fgtrack.models.sensors import Filter

__all__ = ["report_part"]

#: Number of rows on which the guess of the columns is based.
_SAMPLES = 200
#: Number of rows on which speeds and courses are tested.
_MOTION_ROWS = 20_000
_IN_MAP = frozenset(("east", "easting", "north", "northing", "utm"))
_OF_AIRCRAFT = frozenset(("icao", "icao24", "hex", "address"))
#: Column of Flightradar24's granular ADS-B data: P for a message with a position, N for a repeated position.
_HAS_POSITION = {"no_position": Filter(one_of=("P",))}


def report_part(path: Path) -> InputPart | None:
    """Return a guessed mapping of the only table at `path`; None if it is not a table of position reports.

    Times, positions in the map (latitude and longitude, or east and north), identities,
    and speeds and courses that agree with the motion are read. The sensor is named `adsb` or `ais` after the column of
    identities, else `reports`. Raises `DataError` for a table that cannot be read.
    """
    tables = headers(path)
    if len(tables) != 1:
        return None
    [(file, names)] = tables.items()
    cells = [each for _, each in islice(rows(file), 1, _SAMPLES)]
    samples = {name: _numbers(each[name] for each in cells) for name in names if name}
    guessed = with_stamp(guesses(samples), cells)
    known = ("stamp", "receipt", *GEODETIC, "id")
    columns: dict[str, FieldPath] = {
        key: guessed[key].path for key in known if key in guessed
    }
    if not {*GEODETIC} <= columns.keys():
        columns |= {key: guessed[key].path for key in ("x_m", "y_m") if key in guessed}
        if not all(
            set(words_of(str(columns.get(key, "")))) & _IN_MAP for key in ("x_m", "y_m")
        ):
            return None
    if "stamp" not in columns:
        return None
    _, unit, _ = stamps(guessed["stamp"], cells)
    words = set(words_of(str(columns.get("id", ""))))
    sensor = "ais" if "mmsi" in words else "adsb" if words & _OF_AIRCRAFT else "reports"
    filters = {name: rule for name, rule in _HAS_POSITION.items() if name in names}
    name = file.name if path.is_dir() else None
    guessed |= _velocity(file, guessed, columns, samples)
    velocity = [key for key in ("speed_mps", "yaw_rad") if key in guessed]
    columns |= {key: guessed[key].path for key in velocity}
    table = CsvTable(columns, name, unit, frame="map", filters=filters)  # type: ignore[arg-type]  # a key of NS_PER_UNIT
    reasons = {key: guessed[key].reason for key in columns}
    return InputPart(sensor, table, reasons)


def _velocity(
    file: Path,
    guessed: dict[str, Guess],
    columns: Mapping[str, FieldPath],
    samples: Mapping[str, Sequence[float]],
) -> dict[str, Guess]:
    """Return the guesses of speed and course that agree with the motion, and remove the others from `guessed`."""
    for key in ("speed_mps", "yaw_rad"):
        guessed.pop(key, None)
    by_name = {name: guesses({name: samples[name]}) for name in samples}
    speeds = [name for name, each in by_name.items() if "speed_mps" in each]
    courses = [name for name, each in by_name.items() if "yaw_rad" in each]
    if not speeds or "id" not in columns:
        return {}
    cells = [each for _, each in islice(rows(file), 1, _MOTION_ROWS)]
    times, unit, _ = stamps(guessed["stamp"], cells)
    places = ("x_m", "y_m") if "x_m" in columns else GEODETIC
    plane = LocalPlane(warns=False)
    points_m = np.array(
        [
            plane.position_m(*at) if places == GEODETIC else at
            for at in zip(
                *(_column(cells, columns[key]) for key in places), strict=True
            )
        ]
    ).reshape(-1, 2)
    numbers: dict[str, int] = {}
    names = [each[paths_of(columns["id"])[0]] for each in cells]
    ids = np.array(
        [numbers.setdefault(each, len(numbers)) if each else NO_ID for each in names]
    )
    times_s = np.array(times) * NS_PER_UNIT[unit] / NS_PER_S
    kept = np.isfinite(times_s) & np.isfinite(points_m).all(axis=1)
    values = {
        name: np.array(_column(cells, name))[kept] for name in (*speeds, *courses)
    }
    motion = motion_of(times_s[kept], points_m[kept], ids[kept])
    return with_velocity(values, speeds, courses, motion)


def _column(cells: Sequence[Cells], path: FieldPath) -> list[float]:
    """Return the numbers of a column, converted as `path` specifies, and NaN for other texts."""
    name = paths_of(path)[0]
    values = []
    for each in cells:
        [raw] = _numbers([each[name]]) or [math.nan]
        values.append(path.value(raw) if isinstance(path, Field) else raw)
    return values


def _numbers(texts: Iterable[str]) -> list[float]:
    numbers = []
    for text in texts:
        with suppress(ValueError):
            numbers.append(float(text))
    return numbers
