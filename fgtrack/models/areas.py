"""Places where no object of interest is, whatever a sensor sees there: shore, buildings, moorings."""

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Self

import numpy as np

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import read_whole
from fgtrack.core.geometry import in_polygon
from fgtrack.core.types import BoolArray, FloatArray

__all__ = ["ExclusionAreas"]

_LARGEST_MB = 10.0
_MOST_CORNERS = 20_000
_SMALLEST_M = 0.1  # across: a smaller one is in degrees
_PORTION = 1 << 20  # pairs of points and corners that are in memory at a time

Json = Any  # parsed JSON, checked while it is read


@dataclass(frozen=True, eq=False)
class ExclusionAreas:
    """Polygons in the map."""

    polygons_m: tuple[tuple[FloatArray, ...], ...]
    """Rings of corners of each area, (m, 2) each: the outline, and holes in it."""

    @classmethod
    def read(cls, paths: Iterable[str | Path]) -> Self:
        """The areas of GeoJSON files (Polygon and MultiPolygon, also in features) and of CSV files.

        Coordinates are metres in the map. A CSV file has the columns `x_m` and `y_m`, a corner a row, and `area`, the
        name of the polygon, where it has several; rows of one polygon follow each other.

        Raises
        ------
        CallError
            There is no such file.
        DataError
            A file is neither, or too large; the message says what is wrong.
        """
        polygons: list[tuple[FloatArray, ...]] = []
        for path in map(Path, paths):
            text = _text(path)
            rings = _of_geojson(path, text) if text.lstrip()[:1] in ("{", "[") else _of_csv(path, text)
            found = [tuple(_ring(path, ring) for ring in polygon) for polygon in rings]
            if not found or not all(found):
                raise DataError(f"{path}: holds {'a polygon without corners' if found else 'no polygon'}")
            polygons += found
            corners = sum(len(ring) for polygon in polygons for ring in polygon)
            if corners > _MOST_CORNERS:
                raise DataError(
                    f"{path}: {corners} corners in the exclusion areas, at most {_MOST_CORNERS}: simplify them"
                )
        return cls(tuple(polygons))

    def contain(self, points_m: FloatArray) -> BoolArray:
        """True for each of `points_m`, shape (n, 2), that lies in one of the areas, shape (n,); False for NaN."""
        inside = np.zeros(len(points_m), dtype=bool)
        for rings in self.polygons_m:
            low, high = rings[0].min(axis=0), rings[0].max(axis=0)
            near = np.flatnonzero(((points_m >= low) & (points_m <= high)).all(axis=1) & ~inside)
            for part in np.array_split(near, 1 + len(near) * max(map(len, rings)) // _PORTION):
                for ring in rings if len(part) else ():
                    inside[part] ^= in_polygon(points_m[part], ring)
        return inside


def _text(path: Path) -> str:
    if not path.is_file():
        raise CallError(f"{path}: there is no such file of exclusion areas (map.excluded)")
    try:
        return read_whole(path, _LARGEST_MB).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: is neither GeoJSON nor CSV (no text)") from error


def _ring(path: Path, corners: Sequence[Sequence[float]]) -> FloatArray:
    try:
        ring = np.array([(float(x), float(y)) for x, y, *_ in corners], dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(f"{path}: a corner is not two numbers ({str(error)[:80]})") from error
    if len(ring) > 1 and (ring[0] == ring[-1]).all():  # GeoJSON repeats the first corner
        ring = ring[:-1]
    if len(ring) < 3:
        raise DataError(f"{path}: a polygon has {len(ring)} corners, at least three are needed")
    if not (np.abs(ring) <= LARGEST).all():
        raise DataError(f"{path}: a corner is not finite, or beyond {LARGEST:g} m")
    if np.ptp(ring, axis=0).max() < _SMALLEST_M:
        raise DataError(
            f"{path}: a polygon is {np.ptp(ring, axis=0).max():.2g} m across: degrees? Metres in the map are needed"
        )
    ring.flags.writeable = False
    return ring


def _of_geojson(path: Path, text: str) -> list[list[Sequence[Sequence[float]]]]:
    try:
        return list(_polygons(json.loads(text)))
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError) as error:
        what = " ".join(f"{type(error).__name__}: {error}".split())[:100]
        raise DataError(f"{path}: is no GeoJSON with Polygon or MultiPolygon ({what})") from error


def _polygons(item: Json) -> Iterator[list[Sequence[Sequence[float]]]]:
    match item["type"]:
        case "FeatureCollection":
            for feature in item["features"]:
                yield from _polygons(feature)
        case "Feature":
            yield from _polygons(item["geometry"])
        case "GeometryCollection":
            for geometry in item["geometries"]:
                yield from _polygons(geometry)
        case "Polygon":
            yield list(item["coordinates"])
        case "MultiPolygon":
            yield from map(list, item["coordinates"])
        case other:
            raise ValueError(f"{str(other)[:40]!r} is no area")


def _of_csv(path: Path, text: str) -> list[list[Sequence[Sequence[float]]]]:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    delimiter = max(",;\t", key=(lines or [""])[0].count)
    try:
        rows = list(csv.DictReader(lines, delimiter=delimiter, skipinitialspace=True, strict=True))
        corners = [(row.get("area") or "", (float(row["x_m"]), float(row["y_m"]))) for row in rows]
    except (csv.Error, KeyError, TypeError, ValueError) as error:
        what = "the columns x_m and y_m are needed" if isinstance(error, KeyError) else str(error)[:100]
        raise DataError(f"{path}: is neither GeoJSON nor CSV of corners ({what})") from error
    return [[[corner for _, corner in polygon]] for _, polygon in groupby(corners, key=itemgetter(0))]
