"""Times of the lines of an NMEA 0183 log, and the parts of a line."""

import re
from array import array
from collections.abc import Iterable
from contextlib import suppress
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.inputs.formats.time_outliers import outliers
from fgtrack.inputs.formats.time_texts import DAY_S, time_in_line_s

_LINE = re.compile(
    rb"(?P<before>[^\\!$]{0,80})(?P<tags>(?:\\[^\\]*\\)*)(?P<sentence>[!$][^*]*(?:\*[0-9A-Fa-f]{2})?)(?P<after>.*)",
    re.DOTALL,
)
_TAG_TIME = re.compile(rb"(?:^|,)c:(\d+)")
_GNSS_TIME = re.compile(rb"\$..(RMC|ZDA|GLL|GGA),(.*)")
_WRAPPER = b"$PGHP,"
#: Numbers of tag blocks above this are milliseconds.
_LARGEST_S = 1e11


class Line(NamedTuple):
    """Parts of a line."""

    sentence: bytes
    """Sentence without what the recorder has added; empty if the line has none."""
    own_s: float | None = None
    """Time of the reception by the station: from the tag block, else behind or before the sentence."""
    logged_s: float | None = None
    """Time before the sentence: the recorder's."""


def split_line(line: bytes) -> Line:
    """Return the parts of `line`; times of tag blocks with a wrong checksum are ignored."""
    match = _LINE.fullmatch(line.strip())
    if match is None:
        return Line(b"")
    before = match["before"].decode("ascii", "replace")
    after = match["after"].decode("ascii", "replace")
    logged_s = time_in_line_s(before) if before else None
    own_s = _tag_time_s(match["tags"]) if match["tags"] else None
    if own_s is None and after:
        own_s = time_in_line_s(after)
    return Line(match["sentence"], logged_s if own_s is None else own_s, logged_s)


def is_damaged(sentence: bytes) -> bool:
    """True if the checksum of `sentence` is wrong, or a report ends before its checksum."""
    content, mark, checksum = sentence[1:].partition(b"*")
    if mark:
        return len(checksum) != 2 or reduce(xor, content, 0) != int(checksum, 16)
    # Some recorders omit the checksum: then the report must have all its fields.
    return sentence.startswith(b"!") and content.count(b",") < 6


def wrapped_time_s(sentence: bytes) -> float | None:
    """Return the time of a Gatehouse sentence ($PGHP), which belongs to the next sentence; None for other sentences."""
    if not sentence.startswith(_WRAPPER):
        return None
    fields = sentence.partition(b"*")[0].decode("ascii", "replace").split(",")
    with suppress(ValueError, IndexError):
        whole = datetime(*map(int, fields[2:8]), tzinfo=UTC)  # type: ignore[arg-type, misc]  # six numbers
        return whole.timestamp() + int(fields[8] or 0) / 1000.0
    return None


def _tag_time_s(tags: bytes) -> float | None:
    """Return the time in the tag blocks `tags`; None without a time, or if its checksum is wrong."""
    for block in filter(None, tags.split(b"\\")):
        content, mark, _ = block.partition(b"*")
        found = _TAG_TIME.search(content)
        if found is not None and not (mark and is_damaged(b"\\" + block)):
            number = float(found[1])
            return number / 1000.0 if number > _LARGEST_S else number
    return None


class GnssClock:
    """Clock of the receiver's own GNSS: UTC seconds since 1970, or of the day if no sentence has a date."""

    def __init__(self) -> None:
        self._midnight_s = 0.0
        self._now_s: float | None = None

    def time_s(self, sentence: bytes) -> float | None:
        """Return the time in `sentence`; None for a sentence without a time, or of a receiver without a fix."""
        found = _GNSS_TIME.match(sentence)
        if found is None:
            return None
        fields = found[2].decode("ascii", "replace").split("*")[0].split(",")
        with suppress(ValueError, IndexError):
            self._now_s = self._read(found[1].decode(), fields)
            return self._now_s
        return None

    def _read(self, kind: str, fields: list[str]) -> float:
        text = fields[4 if kind == "GLL" else 0]
        time_s = 3600.0 * int(text[:2]) + 60.0 * int(text[2:4]) + float(text[4:])
        date = {"RMC": fields[8:9], "ZDA": ["".join(fields[1:4])]}.get(kind)
        if date:
            form = "%d%m%y" if kind == "RMC" else "%d%m%Y"
            self._midnight_s = (
                datetime.strptime(date[0], form).replace(tzinfo=UTC).timestamp()
            )
        # The other sentences have no date: choose the day nearest to the clock.
        elif self._now_s is not None:
            time_s += DAY_S * round((self._now_s - self._midnight_s - time_s) / DAY_S)
        return self._midnight_s + time_s


class LogTimes(NamedTuple):
    """Times of the lines of a log in s since 1970, shape (lines,)."""

    received_s: FloatArray
    """Reception by the station.

    Lines without an own time have the newest time up to the line. If a receiver's clock
    is missing, they have the next time in the log, an upper bound.
    """
    arrived_s: FloatArray
    """Newest time of the recorder's clock up to the line, a lower bound of the receipt."""
    is_wrong: BoolArray
    """True if the line's own time does not fit the times of the neighbouring lines."""


def log_times(lines: Iterable[bytes]) -> LogTimes | None:
    """Return the times of the `lines` of a log; None if no line has a time.

    Lines before the first time get the first time. Without any date the times are those
    of a day.
    """
    own = array("d")
    logged = array("d")
    gnss = array("d")
    clock = GnssClock()
    wrapped_s: float | None = None
    for line in lines:
        parts = split_line(line)
        own_s = parts.own_s if wrapped_s is None else wrapped_s
        wrapped_s = wrapped_time_s(parts.sentence)
        gnss_s = None
        if parts.sentence[:1] == b"$" and not is_damaged(parts.sentence):
            gnss_s = clock.time_s(parts.sentence)
        own.append(np.nan if own_s is None else own_s)
        logged.append(np.nan if parts.logged_s is None else parts.logged_s)
        gnss.append(np.nan if gnss_s is None or own_s is not None else gnss_s)
    own_s_all = np.array(own)
    gnss_s_all = _with_date(np.array(gnss))
    times_s = np.where(np.isnan(own_s_all), gnss_s_all, own_s_all)
    if np.isnan(times_s).all():
        return None
    is_wrong = outliers(times_s)
    sound_s = np.where(is_wrong, np.nan, times_s)
    newest_s = _newest(sound_s)
    end_s = newest_s
    if np.isnan(gnss_s_all).all():
        end_s = np.fmax(newest_s, _following(sound_s))
    received_s = np.where(np.isnan(own_s_all), end_s, own_s_all)
    logged_s = np.array(logged)
    logged_s[outliers(logged_s)] = np.nan
    arrived_s = _newest(np.where(np.isnan(logged_s), sound_s, logged_s))
    return LogTimes(received_s, arrived_s, is_wrong)


def _newest(times_s: FloatArray) -> FloatArray:
    """Return the newest time up to each line, and the first time for the lines before it."""
    first_s = times_s[~np.isnan(times_s)][0]
    return np.asarray(np.fmax.accumulate(np.fmax(times_s, first_s)))


def _following(times_s: FloatArray) -> FloatArray:
    """Return the time of each line or of the first line behind it with a time; NaN behind the last time."""
    present = np.flatnonzero(~np.isnan(times_s))
    index = np.searchsorted(present, np.arange(len(times_s)))
    padded = np.append(times_s[present], np.nan)
    return padded[index]


def _with_date(times_s: FloatArray) -> FloatArray:
    """Return times of a clock whose first times are of the day, because the date came later, with that date."""
    dated = np.flatnonzero(times_s >= DAY_S)
    if not len(dated):
        return times_s
    first = dated[0]
    days = np.round((times_s[first] - times_s[:first]) / DAY_S)
    return np.concatenate([times_s[:first] + DAY_S * days, times_s[first:]])
