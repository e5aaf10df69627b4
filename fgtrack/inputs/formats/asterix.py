"""ASTERIX recordings of air traffic surveillance (EUROCONTROL): categories 010, 020, 021, 048 and 062.

The specifications come from libasterix (extra `asterix`), which contains every edition.
Times are seconds of the UTC day; a recording has no date. Category 021 has two times of
a position, the stamp and the receipt. For the other categories the receipt is the
newest stamp up to the record in its file, a lower bound. Records of one sensor with
equal times make one list. Records with wrong times are left out and counted.
Extrapolated positions (010, 020: bits CST of item 170) are no measurements and are left
out.
"""

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
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import DetectionList, Message
from fgtrack.inputs.errors import TruncatedInput, UntilBreak
from fgtrack.inputs.formats.asterix_records import Record, RecordReader
from fgtrack.inputs.formats.asterix_reports import CATEGORIES, Site, detection
from fgtrack.inputs.formats.time_outliers import WRONG_TIME, with_outliers
from fgtrack.inputs.formats.time_texts import on_nearest_day
from fgtrack.inputs.geodetic import LocalPlane, warn_once
from fgtrack.inputs.settings import AsterixInput, InputConfig
from fgtrack.inputs.source import FileFormat

#: A report that is so far behind its neighbours has a wrong time.
_BEHIND_S = 3600.0
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
    return is_chain and not CATEGORIES.keys().isdisjoint(numbers)


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
        number: _reader(known[number], number, config.asterix) for number in CATEGORIES
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
    category = CATEGORIES[number]
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
        float(number): Site(plane, station)
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
    sites: dict[float, "Site"],
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
        category = CATEGORIES[number]
        station = record.get("010/SIC", 0.0)
        if station not in sites:
            sites[station] = Site(plane, None)
        item = detection(record, number, category, sites[station], plane)
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
        category = CATEGORIES[number]
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


def _first(record: Record, names: Iterable[str]) -> float | None:
    return next(
        (value for name in names if (value := record.get(name)) is not None), None
    )
