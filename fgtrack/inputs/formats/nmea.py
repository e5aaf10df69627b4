"""NMEA 0183 logs of AIS receivers: positions of ships, read with pyais (extra `ais`).

A report has the UTC second of its position (ITU-R M.1371-5, table 48), but no minute
and no date. These come from the time of the report's own line: a tag block (`c:`), a
preceding `$PGHP`, or a number or an ISO date behind or before the sentence. Other
reports get the time of the receiver's own GNSS ($--RMC, ZDA, GLL, GGA), and before the
first time the first one.

The receipt is the end of the second of the newest time up to the line. The stamp is the
latest time up to the report's own reception with the report's second. If the report's
second is ahead by up to 3 s, the clock is late, and the receipt is set to the stamp. A
report without a second has its reception as the stamp.

Reports with a wrong checksum, a time that does not fit the neighbouring lines, a
damaged payload or no position are left out and counted.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator
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
from fgtrack.inputs.formats.nmea_times import (
    LogTimes,
    is_damaged,
    log_times,
    split_line,
)
from fgtrack.inputs.formats.time_outliers import WRONG_TIME
from fgtrack.inputs.geodetic import LocalPlane
from fgtrack.inputs.settings import InputConfig
from fgtrack.inputs.source import FileFormat

_ENDINGS = (".nmea", ".log", ".txt", ".ais")
_REPORT = rb"(\\[^\\\n]*\\){0,3}![A-Z]{2}VD[MO],\d,\d,"
_IS_LOG = re.compile(rb"^[^\n\\!${]{0,60}" + _REPORT, re.MULTILINE)
#: A row of a table has several cells before a sentence.
_IS_LOG_AS_TABLE = re.compile(rb"^[^\n,;\\!${]{0,40}[,;]?\"?" + _REPORT, re.MULTILINE)
#: Before reports, the log of a ship may have many sentences of other instruments.
_HEAD_BYTES = 1 << 18
_IS_REPORT = re.compile(rb"![A-Z]{2}VD[MO],")
#: Number, and identity of the message, of a sentence of a message with several.
_PART = re.compile(rb"(?:![A-Z]{5}),[2-9],(\d),(\d?,[^,]?),")
_KNOT_MPS = 1852.0 / 3600.0
#: Message types with positions of ships, and of aircraft in search and rescue.
_POSITIONS = frozenset({1, 2, 3, 9, 18, 19, 27})
_MINUTE_S = 60
#: Largest lead of a report's second before the log's clock.
_AHEAD_S = 3
#: Values that mean "not available".
_NO_SPEED_KN = 102.3
_NO_COURSE_DEG = 360.0
_MOVING_MPS = 0.5
#: Reasons for which a report is left out.
_CHECKSUM = "wrong checksum"
_DAMAGED = "damaged payload"
_NO_POSITION = "missing position"


def read_log(file: Path, plane: LocalPlane) -> Iterator[DetectionList]:
    """Yield lists of one report each, in the order of the file; raises `DataError` for a log without a clock."""
    from pyais import IterMessages
    from pyais.exceptions import AISBaseException

    with open_file(file) as lines:
        times = log_times(lines)
    if times is None:
        raise DataError(
            f"{file}: has no time: a log needs tag blocks (c:), sentences $--RMC, ZDA, GLL, GGA or $PGHP, "
            "or a time before or behind each report"
        )
    receipt_ns = -LARGEST_NS
    left_out: list[str] = []
    with open_file(file) as lines:
        sentences = _Sentences(lines, times, left_out)
        for sentence in IterMessages(sentences):
            try:
                item = _detection(report := sentence.decode(), plane)
            except (AISBaseException, ValueError, IndexError, KeyError):
                left_out.append(_DAMAGED)
                continue
            if item is None:
                left_out += [_NO_POSITION] * (report.msg_type in _POSITIONS)
                continue
            stamp_s = end_s = math.floor(sentences.received_s) + 1.0
            second = getattr(report, "second", _MINUTE_S)
            if second < _MINUTE_S:
                stamp_s -= (end_s - second + _AHEAD_S) % _MINUTE_S - _AHEAD_S
            stamp_ns = round(stamp_s * NS_PER_S)
            arrived_s = max(end_s, math.floor(sentences.arrived_s) + 1.0)
            receipt_ns = max(receipt_ns, stamp_ns, round(arrived_s * NS_PER_S))
            yield _list(stamp_ns, receipt_ns, (item,), tuple(left_out), plane)
            left_out.clear()
    if left_out:
        end_ns = max(receipt_ns, round(float(times.arrived_s[-1]) * NS_PER_S))
        yield _list(end_ns, end_ns, (), tuple(left_out), plane)


class _Sentences:
    """Iterator over the sound sentences of a log; the reasons for damaged reports are added to `left_out`."""

    def __init__(
        self, lines: Iterable[bytes], times: LogTimes, left_out: list[str]
    ) -> None:
        self._lines = lines
        self._times = times
        self._left_out = left_out
        #: Reception of the first part of each message of several sentences.
        self._begun_s: dict[bytes, float] = {}
        self.received_s = 0.0
        """Reception of the present sentence's report."""
        self.arrived_s = 0.0
        """Lower bound of the report's receipt."""

    def __iter__(self) -> Iterator[bytes]:
        for number, line in enumerate(self._lines):
            sentence = split_line(line).sentence
            if not _IS_REPORT.match(sentence):
                continue
            if is_damaged(sentence):
                self._left_out.append(_CHECKSUM)
                continue
            if self._times.is_wrong[number]:
                self._left_out.append(WRONG_TIME)
                continue
            self.received_s = float(self._times.received_s[number])
            self.arrived_s = float(self._times.arrived_s[number])
            if part := _PART.match(sentence):
                if part[1] == b"1":
                    self._begun_s[part[2]] = self.received_s
                self.received_s = self._begun_s.get(part[2], self.received_s)
            yield sentence


def _list(
    stamp_ns: int,
    receipt_ns: int,
    objects: tuple[Detection, ...],
    left_out: tuple[str, ...],
    plane: LocalPlane,
) -> DetectionList:
    return DetectionList(
        "ais", stamp_ns, receipt_ns, objects, "map", left_out, plane.origin_deg
    )


def _detection(
    report: Any, plane: LocalPlane
) -> Detection | None:  # Any: pyais has a class for each message type
    """Return the detection of the ship in a report; None if the report has no position. A slow ship's course is
    left out.
    """
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
        head = log.read(_HEAD_BYTES)
    form = _IS_LOG_AS_TABLE if file.suffix in (".csv", ".tsv") else _IS_LOG
    return b"\0" not in head and form.search(head) is not None


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
