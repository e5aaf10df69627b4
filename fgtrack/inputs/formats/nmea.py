"""NMEA 0183 logs of an AIS receiver: positions of ships, read with pyais (extra `ais`).

A report has the UTC second of its position (ITU-R M.1371-5, table 48), but no minute
and no date. The log's clock comes from its tag blocks (`c:`), else from the receiver's
own GNSS ($--RMC, ZDA, GLL, GGA). Lines before the first time get the first time.

The receipt is the end of the current second of this clock. The stamp is the latest time
up to the receipt with the report's second. If the report's second is ahead by up to 3
s, the clock is late, and the receipt is set to the stamp. A report without a second has
the receipt as its stamp. Reports without a position, and damaged reports, are not read.
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
#: Message types with positions of ships, and of aircraft in search and rescue.
_POSITIONS = frozenset({1, 2, 3, 9, 18, 19, 27})
_DAY_S = 86_400
_MINUTE_S = 60
#: Largest lead of a report's second before the log's clock.
_AHEAD_S = 3
#: Values that mean "not available".
_NO_SPEED_KN = 102.3
_NO_COURSE_DEG = 360.0
_MOVING_MPS = 0.5


class _Clock:
    """Clock of a log, advanced line by line: UTC seconds since 1970, or of the day if the log has no date."""

    def __init__(self, midnight_s: float = 0.0) -> None:
        self.now_s: float | None = None
        self._midnight_s = midnight_s

    def read(self, line: bytes) -> None:
        """Advance the clock to the time in `line`, if the line has one; the clock never goes back."""
        if tag := _TAG_TIME.match(line):
            number = float(tag[1])
            self._advance(number / 1000.0 if number > 1e11 else number)
        elif (own := _OWN_TIME.match(line)) and not _TAG_TIME.match(line):
            fields = own[2].decode("ascii", "replace").split("*")[0].split(",")
            try:
                self._read_own(own[1].decode(), fields)
            except (
                ValueError,
                IndexError,
            ):  # a receiver without a fix sends empty fields
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
        # These sentences have no date: choose the day nearest to the clock.
        if kind in ("GLL", "GGA") and self.now_s is not None:
            time_s += _DAY_S * round((self.now_s - self._midnight_s - time_s) / _DAY_S)
        self._advance(self._midnight_s + time_s)

    def _advance(self, time_s: float) -> None:
        self.now_s = time_s if self.now_s is None else max(self.now_s, time_s)


def read_log(file: Path, plane: LocalPlane) -> Iterator[DetectionList]:
    """Yield lists of one report each, in the order of the file; raises `DataError` for a log without a clock."""
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
            f"{file}: has no time: a log needs tag blocks (c:), or sentences $--RMC, ZDA, GLL or GGA"
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
            except (AISBaseException, ValueError, IndexError, KeyError):
                continue  # the radio link damaged the report
            if item is not None:
                receipt_s = (first.now_s if clock.now_s is None else clock.now_s) + 1.0
                second = getattr(report, "second", _MINUTE_S)
                age_s = 0.0
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
) -> Detection | None:  # Any: pyais has a class for each message type
    """Detection of the ship in a report; None if the report has no position. A slow ship's course is left out."""
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
            f"{path}: is an AIS log, install the reader: pip install 'fgtrack[ais]'"
        ) from error
    plane = LocalPlane(config.origin)
    return lambda: merge(
        *(read_log(file, plane) for file in _files(path)), key=attrgetter("receipt_ns")
    )


FORMAT = FileFormat("AIS logs (NMEA 0183)", _recognises, _open)
