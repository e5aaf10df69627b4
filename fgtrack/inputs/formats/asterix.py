"""ASTERIX recordings of air traffic surveillance (EUROCONTROL): categories 010, 020, 021, 048 and 062.

The specifications come from libasterix (extra `asterix`), which contains every edition.
Times are seconds of the UTC day; a recording has no date. Category 021 has two times of
a position, the stamp and the receipt. For the other categories the receipt is the
newest stamp up to the record in its file, a lower bound. Records of one sensor with
equal times make one list. Records with wrong times are left out and counted.
Extrapolated positions (010, 020: bits CST of item 170) are no measurements and are left
out.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from heapq import merge
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import open_file
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, Message
from fgtrack.inputs.errors import TruncatedInput, UntilBreak
from fgtrack.inputs.formats.asterix_records import Record, RecordReader
from fgtrack.inputs.formats.time_outliers import WRONG_TIME, with_outliers
from fgtrack.inputs.formats.time_texts import on_nearest_day
from fgtrack.inputs.geodetic import LocalPlane, warn_once
from fgtrack.inputs.settings import AsterixInput, InputConfig, Origin
from fgtrack.inputs.source import FileFormat

#: A report that is so far behind its neighbours has a wrong time.
_BEHIND_S = 3600.0
_NM_M = 1852.0
_FOOT_M = 0.3048
#: Radius that contains 95 % of a circular Gaussian, in standard deviations.
_PER_95 = 2.4477
#: 95 % radius of the position in m by NACp: DO-260B (RTCA, 2009), table 2-71.
_NACP_M = {
    11: 3.0,
    10: 10.0,
    9: 30.0,
    8: 92.6,
    7: 185.2,
    6: 555.6,
    5: 926.0,
    4: 1852.0,
    3: 3704.0,
    2: 7408.0,
    1: 18520.0,
}
#: 95 % radius of the position in m by NUCp of version 0: DO-260 (2000), table 2-11.
_NUCP_M = {
    9: 3.0,
    8: 10.0,
    7: 92.6,
    6: 185.2,
    5: 463.0,
    4: 926.0,
    3: 1852.0,
    2: 9260.0,
    1: 18520.0,
}
#: 95 % bound of the velocity in m/s by NACv: DO-260B, table 2-22.
_NACV_MPS = {4: 0.3, 3: 1.0, 2: 3.0, 1: 10.0}
_UNKNOWN_MPS = 10.0
_KINDS = {0: "mlat", 1: "mlat", 2: "adsb", 3: "smr", 5: "mlat"}
"""Sensor by the report type of category 010: multilateration, ADS-B, surface movement RADAR."""
_TARGET_REPORT = 1
_COMMON = (
    "000",
    "010/SIC",
    "020/TYP",
    "170/CST",
    "210/VN",
    "090/NACP",
    "090/NUCPNIC",
    "090/NUCRNACV",
)


class _Category(NamedTuple):
    """Items of a category, as number or number/part; of several alternatives the first in the record is read."""

    sensor: str
    """Name of the sensor; empty if the type of the report determines it (`_KINDS`)."""
    stamp: tuple[str, ...]
    """Items with the stamp."""
    receipt: tuple[str, ...]
    """Items with the receipt; empty if the category has no second time."""
    address: str
    """Item with the address of the target."""
    positions: tuple[tuple[str, str, str], ...]
    """Items with a position, each with its two parts: LAT and LON, X and Y, or RHO and THETA."""
    velocity: tuple[str, str, str]
    """Item with the velocity, with its two parts: VX and VY, or speed and direction."""
    height: str
    """Item with the flight level."""
    unit_m: float = 1.0
    """Unit of X and Y in m."""
    lsb: Mapping[str, float] = {}
    """Least significant bits by item/part, where libasterix has wrong ones."""


_ENDING = ".ast"
#: Other endings of names in a folder; the content decides.
_ENDINGS = (".raw", ".asterix", ".bin", ".dat", ".rec")
#: Numbers of categories of the standard, and bytes of a file by which it is recognised.
_NUMBERS = frozenset(
    (
        *range(1, 5),
        *range(7, 12),
        *range(15, 22),
        23,
        25,
        32,
        34,
        48,
        62,
        63,
        65,
        240,
        247,
    )
)
_FEWEST_BLOCKS = 3
_HEAD_BYTES = 1 << 16
_WGS84 = ("041", "LAT", "LON")
_CARTESIAN = ("042", "X", "Y")
_POLAR = ("040", "RHO", "THETA")
_GNSS = (("131", "LAT", "LON"), ("130", "LAT", "LON"))
_SYSTEM = (("105", "LAT", "LON"), ("100", "X", "Y"))
_CATEGORIES = {
    # Edition 1.1, 5.2.20: +-8192 m/s in 16 bits, so 0.25 m/s; libasterix 1.1 has 1/16 m/s.
    10: _Category(
        "",
        ("140",),
        (),
        "220",
        (_WGS84, _CARTESIAN, _POLAR),
        ("202", "VX", "VY"),
        "090/FL",
        lsb={"202/VX": 0.25, "202/VY": 0.25},
    ),
    20: _Category(
        "mlat", ("140",), (), "220", (_WGS84, _CARTESIAN), ("202", "VX", "VY"), "090/FL"
    ),
    21: _Category(
        "adsb",
        ("073", "071", "030"),
        ("077",),
        "080",
        _GNSS,
        ("160", "GS", "TA"),
        "145",
    ),
    48: _Category(
        "radar",
        ("140",),
        (),
        "220",
        (_POLAR, _CARTESIAN),
        ("200", "GSP", "HDG"),
        "090/FL",
        _NM_M,
    ),
    62: _Category(
        "system", ("070",), (), "380/ADR", _SYSTEM, ("185", "VX", "VY"), "136"
    ),
}


def _recognises(path: Path) -> bool:
    return bool(_files(path)) if path.is_dir() else _is_recording(path)


def _files(path: Path) -> list[Path]:
    """Return the files at `path` with ASTERIX records, sorted by name."""
    if not path.is_dir():
        return [path]
    usual = [each for each in path.iterdir() if each.suffix in (_ENDING, *_ENDINGS)]
    return sorted(file for file in usual if file.is_file() and _is_recording(file))


def _is_recording(file: Path) -> bool:
    """True for the usual ending of the name, or for a file that is a chain of ASTERIX blocks."""
    if file.suffix == _ENDING:
        return True
    if file.suffix not in _ENDINGS:
        return False
    with open_file(file) as blocks:
        head = blocks.read(_HEAD_BYTES)
    numbers = list[int]()
    at = 0
    while at + 3 <= len(head):
        length = int.from_bytes(head[at + 1 : at + 3], "big")
        if length <= 3 or head[at] not in _NUMBERS:
            return False
        numbers.append(head[at])
        at += length
    is_chain = at == len(head) or len(numbers) >= _FEWEST_BLOCKS
    return is_chain and not _CATEGORIES.keys().isdisjoint(numbers)


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    try:
        from asterix.generated import manifest
    except ImportError as error:
        raise CallError(
            f"{path}: is an ASTERIX file, install the reader: pip install 'fgtrack[asterix]'"
        ) from error
    # Any: editions by category, which libasterix types as objects.
    known: Any = manifest["CATS"]
    readers = {
        number: _reader(known[number], number, config.asterix) for number in _CATEGORIES
    }
    files = _files(path)
    plane = LocalPlane(
        config.origin or next(iter(config.asterix.stations.values()), None)
    )
    return partial(_merged, files, readers, config.asterix, plane)


def _reader(
    known: Iterable[Any], number: int, given: AsterixInput
) -> RecordReader:  # Any: a class of libasterix
    """Return the record reader for the configured edition of category `number`, by default the newest edition.

    Raises `CallError` for an unknown edition.
    """
    by_name = {".".join(map(str, each.cv_edition)): each for each in known}
    name = given.editions.get(number, next(reversed(by_name)))
    if name not in by_name:
        raise CallError(
            f"input.asterix.editions: category {number} has no edition {name}, choose from {', '.join(by_name)}"
        )
    category = _CATEGORIES[number]
    pairs = [
        f"{item}/{part}"
        for item, *parts in (*category.positions, category.velocity)
        for part in parts
    ]
    times = (
        *category.stamp,
        *category.receipt,
        *(each[number] for each in (given.stamp, given.receipt) if number in each),
    )
    return RecordReader(
        by_name[name],
        [*_COMMON, *pairs, *times, category.address, category.height],
        category.lsb,
    )


FORMAT = FileFormat("ASTERIX (.ast, .raw, or a folder of them)", _recognises, _open)


def _merged(
    files: list[Path],
    readers: Mapping[int, RecordReader],
    given: AsterixInput,
    plane: LocalPlane,
) -> Iterator[Message]:
    sites = {
        float(number): _Site(plane, station)
        for number, station in given.stations.items()
    }
    readable = [
        UntilBreak(_reports(file, readers, given, plane, sites)) for file in files
    ]
    ordered = merge(*readable, key=attrgetter("receipt_ns"))
    for _, group in groupby(
        ordered, key=attrgetter("sensor", "stamp_ns", "receipt_ns")
    ):
        lists = list(group)
        yield replace(
            lists[0],
            objects=tuple(item for each in lists for item in each.objects),
            left_out=tuple(reason for each in lists for reason in each.left_out),
        )
    unknown = [f"{number:g}" for number, site in sites.items() if site.misplaces]
    if len(unknown) > 1:
        warn_once(
            f"the stations {' and '.join(unknown)} (SIC) report positions relative to the station, but all stations "
            "are assumed at the origin: set their positions in `input.asterix.stations`"
        )
    for each in readable:
        each.raise_error()


def _reports(
    file: Path,
    readers: Mapping[int, RecordReader],
    given: AsterixInput,
    plane: LocalPlane,
    sites: dict[float, "_Site"],
) -> Iterator[DetectionList]:
    """Yield the target reports of `file`, each as a list of one object, in the order of the file.

    Stations without a configured position are added to `sites`, by SIC.
    """
    readable = UntilBreak(_timed(file, readers, given))
    newest_ns: int | None = None
    left_out: list[str] = []
    last: DetectionList | None = None
    checked = with_outliers(
        readable, lambda each: max(each.stamp_ns, each.receipt_ns) * 1e-9, _BEHIND_S
    )
    for (number, record, stamp_ns, receipt_ns), is_wrong in checked:
        if is_wrong:
            left_out.append(WRONG_TIME)
            continue
        category = _CATEGORIES[number]
        station = record.get("010/SIC", 0.0)
        if station not in sites:
            sites[station] = _Site(plane, None)
        item = _detection(record, number, category, sites[station], plane)
        if item is None:
            continue
        newest_ns = receipt_ns if newest_ns is None else max(newest_ns, receipt_ns)
        sensor = category.sensor or _KINDS.get(int(record.get("020/TYP", 0)), "other")
        at = sensor, stamp_ns, newest_ns
        counted = tuple(left_out)
        left_out = []
        last = DetectionList(*at, (item,), "map", counted, plane.origin_deg)
        yield last
    if left_out and last is not None:
        yield replace(last, objects=(), left_out=tuple(left_out))
    readable.raise_error()


class _Timed(NamedTuple):
    """A target report and its times."""

    category: int
    record: Record
    stamp_ns: int
    receipt_ns: int


def _timed(
    file: Path, readers: Mapping[int, RecordReader], given: AsterixInput
) -> Iterator[_Timed]:
    """Yield the target reports of `file` that have a stamp and are measured, in the order of the file.

    A time of day gets the day on which it is nearest to the stamp of the report before. A receipt gets the day on which
    it is nearest to its stamp. The receipt may lie before the stamp, because both are rounded.
    """
    before_ns: int | None = None
    for number, record in _records(file, readers):
        category = _CATEGORIES[number]
        if number == 10 and record.get("000") != _TARGET_REPORT:
            continue
        stamp_s = _first(
            record, (given.stamp[number],) if number in given.stamp else category.stamp
        )
        receipt_s = _first(
            record,
            (given.receipt[number],) if number in given.receipt else category.receipt,
        )
        if stamp_s is None or (number in (10, 20) and record.get("170/CST")):
            continue
        stamp_ns = round(stamp_s * NS_PER_S)
        if before_ns is not None:
            stamp_ns = on_nearest_day(stamp_ns, before_ns)
        receipt_ns = stamp_ns
        if receipt_s is not None:
            receipt_ns = on_nearest_day(round(receipt_s * NS_PER_S), stamp_ns)
        before_ns = stamp_ns
        yield _Timed(number, record, stamp_ns, receipt_ns)


def _records(
    file: Path, readers: Mapping[int, RecordReader]
) -> Iterator[tuple[int, Record]]:
    """Yield category and record of each record in `file` with a reader; raises `TruncatedInput` and `DataError`."""
    at = 0
    with open_file(file) as blocks:
        while head := blocks.read(3):
            number = head[0]
            length = int.from_bytes(head[1:], "big")
            content = blocks.read(max(length - 3, 0))
            if len(head) < 3 or len(content) != length - 3:
                raise TruncatedInput(f"{file}: breaks off in the block at byte {at}")
            try:
                records = list(readers[number](content)) if number in readers else []
            except (ValueError, IndexError) as error:
                raise DataError(
                    f"{file}: cannot decode category {number} at byte {at}: "
                    f"set its edition as input.asterix.editions: {{{number}: ...}}"
                ) from error
            for record in records:
                yield number, record
            at += length


class _Site:
    """Position of a station in the plane, and the direction of its north there, because meridians converge."""

    def __init__(self, plane: LocalPlane, station: Origin | None) -> None:
        self._x_m = self._y_m = self._turn_rad = 0.0
        self._given = station is not None
        self.misplaces = False
        """True if a relative position was converted although the station's position is unknown."""
        if station is not None:
            self._x_m, self._y_m = plane.position_m(
                station.latitude_deg, station.longitude_deg
            )
            x_m, y_m = plane.position_m(
                min(station.latitude_deg + 0.01, 90.0), station.longitude_deg
            )
            self._turn_rad = math.atan2(x_m - self._x_m, y_m - self._y_m)

    def position_m(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the position in the plane, `x_m` to the east and `y_m` to the north of the station."""
        self.misplaces = not self._given
        c = math.cos(self._turn_rad)
        s = math.sin(self._turn_rad)
        return self._x_m + c * x_m + s * y_m, self._y_m - s * x_m + c * y_m


def _detection(
    record: Record, number: int, category: _Category, site: _Site, plane: LocalPlane
) -> Detection | None:
    """Return the object of a target report; None if the report has no position."""
    position = next(
        (
            at
            for name in category.positions
            if (at := _position_m(record, *name, category.unit_m, site, plane))
        ),
        None,
    )
    if position is None:
        return None
    speed_mps, yaw_rad = _velocity(record, *category.velocity)
    address = record.get(category.address)
    level = record.get(category.height)
    return Detection(
        *position,
        yaw_rad,
        speed_mps,
        covariance=_accuracy(record, speed_mps) if number == 21 else None,
        z_m=None if level is None else 100.0 * _FOOT_M * level,
        id=None if address is None else f"{int(address):06X}",
    )


def _position_m(
    record: Record,
    item: str,
    first: str,
    second: str,
    unit_m: float,
    site: _Site,
    plane: LocalPlane,
) -> tuple[float, float] | None:
    a = record.get(f"{item}/{first}")
    b = record.get(f"{item}/{second}")
    if a is None or b is None:
        return None
    if first == "LAT":
        return plane.position_m(a, b)
    if first == "RHO":
        a, b = a * math.sin(math.radians(b)), a * math.cos(math.radians(b))
    return site.position_m(unit_m * a, unit_m * b)


def _velocity(
    record: Record, item: str, first: str, second: str
) -> tuple[float | None, float | None]:
    """Return speed over ground and course; both None if not reported. The course of an object at rest is None."""
    a = record.get(f"{item}/{first}")
    b = record.get(f"{item}/{second}")
    if a is None or b is None:
        return None, None
    if first == "VX":
        return math.hypot(a, b), math.atan2(b, a) if a or b else None
    return a * _NM_M, wrap_angle(math.radians(90.0 - b)) if a else None


def _accuracy(record: Record, speed_mps: float | None) -> tuple[float, ...] | None:
    """Return the covariance of the measured components from the accuracy categories; None if the record has no position
    accuracy.
    """
    radius_m = _NACP_M.get(int(record.get("090/NACP", 0)))
    if not radius_m and record.get("210/VN") == 0:
        radius_m = _NUCP_M.get(int(record.get("090/NUCPNIC", 0)))
    if radius_m is None:
        return None
    variances = [(radius_m / _PER_95) ** 2] * 2
    if speed_mps is not None:
        std_mps = (
            _NACV_MPS.get(int(record.get("090/NUCRNACV", 0)), _UNKNOWN_MPS) / _PER_95
        )
        variances += [(std_mps / max(speed_mps, std_mps)) ** 2] * bool(speed_mps) + [
            std_mps**2
        ]
    size = len(variances)
    return tuple(
        variances[row] if row == column else 0.0
        for row in range(size)
        for column in range(size)
    )


def _first(record: Record, names: Iterable[str]) -> float | None:
    return next(
        (value for name in names if (value := record.get(name)) is not None), None
    )
