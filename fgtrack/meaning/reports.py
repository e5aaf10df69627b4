"""Mapping of a table of position reports, such as AIS and ADS-B, from the names of its columns."""

from collections.abc import Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path

from fgtrack.inputs.formats.tables import headers, rows
from fgtrack.inputs.geodetic import GEODETIC
from fgtrack.inputs.settings import CsvTable, FieldPath
from fgtrack.meaning.guess import guesses, words_of
from fgtrack.meaning.parts import InputPart
from fgtrack.meaning.stamps import stamps, with_stamp
from fgtrack.models.sensors import Filter

__all__ = ["report_part"]

#: Number of rows on which the guess of the columns is based.
_SAMPLES = 200
_IN_MAP = frozenset(("east", "easting", "north", "northing", "utm"))
_OF_AIRCRAFT = frozenset(("icao", "icao24", "hex", "address"))
#: Column of Flightradar24's granular ADS-B data: P for a message with a position, N for a repeated position.
_HAS_POSITION = {"no_position": Filter(one_of=("P",))}


def report_part(path: Path) -> InputPart | None:
    """Return a guessed mapping of the only table at `path`; None if it is not a table of position reports.

    Times, positions in the map (latitude and longitude, or east and north) and
    identities are read. The sensor is named `adsb` or `ais` after the column of
    identities, else `reports`. Raises `DataError` for a table that cannot be read.
    """
    tables = headers(path)
    if len(tables) != 1:
        return None
    [(file, names)] = tables.items()
    cells = [each for _, each in islice(rows(file), 1, _SAMPLES)]
    guessed = with_stamp(
        guesses(
            {name: _numbers(each[name] for each in cells) for name in names if name}
        ),
        cells,
    )
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
    table = CsvTable(columns, name, unit, frame="map", filters=filters)  # type: ignore[arg-type]  # a key of NS_PER_UNIT
    reasons = {key: guessed[key].reason for key in columns}
    return InputPart(sensor, table, reasons)


def _numbers(texts: Iterable[str]) -> list[float]:
    numbers = []
    for text in texts:
        with suppress(ValueError):
            numbers.append(float(text))
    return numbers
