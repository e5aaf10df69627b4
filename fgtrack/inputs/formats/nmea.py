"""NMEA 0183 logs of a receiver of AIS: positions of ships, read with pyais (extra `ais`).

A report has the UTC second of its position (ITU-R M.1371-5, table 48), no minute and no date. The clock of the log is
that of its tag blocks (`c:`), else of the receiver's own GNSS ($--RMC, ZDA, GLL, GGA); lines before its first time get
that one. The receipt is the end of the second of this clock, the stamp the latest time of that second of the minute up
to it. A second ahead by up to 3 s shows that this clock is late: then the receipt is the stamp. A report without a
second has the receipt; those without a position or with errors are not read.
"""

import math
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.files import open_file
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, Message
from fgtrack.inputs.geodetic import LocalPlane
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import FileFormat

_ENDINGS = (".nmea", ".log", ".txt", ".ais")
_IS_AIS = re.compile(rb"^(\\[^\\]*\\)?!(AI|AB|BS)VD[MO],", re.MULTILINE)
_TAG_TIME = re.compile(rb"^\\(?:[^\\]*,)?c:(\d+)")
_OWN_TIME = re.compile(rb"\$..(RMC|ZDA|GLL|GGA),(.*)")
_KNOT_MPS = 1852.0 / 3600.0
_POSITIONS = frozenset(
    {1, 2, 3, 9, 18, 19, 27}
)  # message types of ships, and of aircraft in search and rescue
_DAY_S, _MINUTE_S, _AHEAD_S = 86_400, 60, 3
_NO_SPEED_KN, _NO_COURSE_DEG = 102.3, 360.0
_MOVING_MPS = 0.5


class _Clock:
    """The clock of a log, line by line: seconds of UTC since 1970, or of the day where there is no date."""

    def __init__(self, midnight_s: float = 0.0) -> None:
        self.now_s: float | None = None
        self._midnight_s = midnight_s

    def read(self, line: bytes) -> None:
        """Set the time by `line` if it has one; it never goes back."""
        if tag := _TAG_TIME.match(line):
            number = float(tag[1])
            self._advance(number / 1000.0 if number > 1e11 else number)
        elif (own := _OWN_TIME.match(line)) and not _TAG_TIME.match(line):
            fields = own[2].decode("ascii", "replace").split("*")[0].split(",")
            try:
                self._read_own(own[1].decode(), fields)
            except (ValueError, IndexError):  # empty without a fix
                return

    def _read_own(self, kind: str, fields: list[str]) -> None:
        text = fields[4 if kind == "GLL" else 0]
        if kind == "RMC":
            self._midnight_s = (
                datetime.strptime(fields[8], "%d%m%y").replace(tzinfo=UTC).timestamp()
            )
        elif kind == "ZDA":
            self._midnight_s = (
                datetime.strptime("-".join(fields[1:4]), "%d-%m-%Y")
                .replace(tzinfo=UTC)
                .timestamp()
            )
        time_s = 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + float(text[4:])
        if kind in ("GLL", "GGA") and self.now_s is not None:  # beyond midnight
            time_s += _DAY_S * round((self.now_s - self._midnight_s - time_s) / _DAY_S)
        self._advance(self._midnight_s + time_s)

    def _advance(self, time_s: float) -> None:
        self.now_s = time_s if self.now_s is None else max(self.now_s, time_s)


def read_log(file: Path, plane: LocalPlane) -> Iterator[DetectionList]:
    """Lists of one report each, in the order of the file. Raises `DataError` for a log without a clock."""
    from pyais import IterMessages
    from pyais.exceptions import AISBaseException

    first = _Clock()
    with open_file(file) as lines:
        for line in lines:
            first.read(line)
            if first.now_s is not None and first.now_s >= _DAY_S:
                break
    if first.now_s is None:
        raise DataError(
            f"{file}: has no time: neither tag blocks (c:) nor $--RMC, ZDA, GLL or GGA"
        )
    receipt_ns = -LARGEST_NS
    clock = _Clock(first.now_s - first.now_s % _DAY_S)
    with open_file(file) as lines:

        def read() -> Iterator[bytes]:
            for line in lines:
                clock.read(line.strip())
                yield line.strip()

        for sentence in IterMessages(read()):
            try:
                item = _detection(report := sentence.decode(), plane)
            except (
                AISBaseException,
                ValueError,
                IndexError,
                KeyError,
            ):  # damaged by the radio link
                continue
            if item is not None:
                receipt_s = (first.now_s if clock.now_s is None else clock.now_s) + 1.0
                second, age_s = getattr(report, "second", _MINUTE_S), 0.0
                if second < _MINUTE_S:
                    age_s = (receipt_s - second + _AHEAD_S) % _MINUTE_S - _AHEAD_S
                stamp_ns = round((receipt_s - age_s) * NS_PER_S)
                receipt_ns = max(receipt_ns, stamp_ns, round(receipt_s * NS_PER_S))
                yield DetectionList(
                    "ais",
                    stamp_ns,
                    receipt_ns,
                    (item,),
                    "map",
                    origin_deg=plane.origin_deg,
                )


def _detection(
    report: Any, plane: LocalPlane
) -> Detection | None:  # Any: pyais has a class of each message type
    """The ship of a report; None where it has no position. Its course is left out where it hardly moves."""
    if report.msg_type not in _POSITIONS:
        return None
    x_m, y_m = plane.position_m(report.lat, report.lon)
    if math.isnan(x_m):
        return None
    speed_mps = None if report.speed >= _NO_SPEED_KN else report.speed * _KNOT_MPS
    has_course = (
        speed_mps is not None
        and speed_mps > _MOVING_MPS
        and report.course < _NO_COURSE_DEG
    )
    yaw_rad = wrap_angle(math.radians(90.0 - report.course)) if has_course else None
    return Detection(x_m, y_m, yaw_rad, speed_mps, id=str(report.mmsi))


def _recognises(path: Path) -> bool:
    files = _files(path)
    return bool(files) and all(_is_log(file) for file in files)


def _files(path: Path) -> list[Path]:
    return (
        sorted(file for file in path.iterdir() if file.suffix in _ENDINGS)
        if path.is_dir()
        else [path]
    )


def _is_log(file: Path) -> bool:
    with open_file(file) as log:
        return _IS_AIS.search(log.read(4096)) is not None


def _open(path: Path, config: InputConfig) -> Callable[[], Iterator[Message]]:
    try:
        import pyais  # noqa: F401 - read_log needs it
    except ImportError as error:
        raise CallError(
            f"{path}: is a log of AIS, install its reader: pip install 'fgtrack[ais]'"
        ) from error
    plane = LocalPlane(config.origin)
    return lambda: merge(
        *(read_log(file, plane) for file in _files(path)), key=attrgetter("receipt_ns")
    )


FORMAT = FileFormat("logs of AIS (NMEA 0183)", _recognises, _open)
