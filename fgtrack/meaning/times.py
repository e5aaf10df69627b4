"""Tests which times of a recording are stamps and receipts, and which clocks differ by a known constant."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fgtrack.core.types import FloatArray, IntArray

__all__ = [
    "ClockConstant",
    "Loop",
    "TimeColumns",
    "clock_constant",
    "loop_of",
    "time_columns",
]

#: Differences of clocks in s: GPS time and TAI are ahead of UTC, and TAI of GPS time.
_CONSTANTS = {"GPS time and UTC": 18, "TAI and UTC": 37, "TAI and GPS time": 19}
#: Time zones differ by multiples of a quarter of an hour, up to 14 hours.
_ZONE_S = 900
_LARGEST_ZONE_S = 14 * 3600
#: Delays that need no constant.
_LEAST_DELAY_S = -0.5
_LARGEST_DELAY_S = 5.0
#: Delays that remain after the correction by a constant.
_LEAST_REMAINDER_S = -0.05
_LARGEST_REMAINDER_S = 1.5
_LARGEST_ZONE_REMAINDER_S = 5.0
#: Range of the delays of most messages; a clock that differs by a constant has the usual spread of delays.
_LARGEST_SPREAD_S = 2.0
#: Words in the names of columns with a receipt, and with a stamp.
_OF_RECEIPT = frozenset(
    (
        "log",
        "bag",
        "rosbag",
        "record",
        "recorded",
        "receipt",
        "received",
        "receive",
        "recv",
        "rx",
        "arrival",
        "arrived",
        "publish",
    )
)
_OF_STAMP = frozenset(
    (
        "header",
        "stamp",
        "sensor",
        "measurement",
        "measured",
        "meas",
        "acquisition",
        "capture",
        "detection",
        "gps",
        "hw",
    )
)
_WHOLE = frozenset(("sec", "secs", "second", "seconds", "s"))
_FRACTION = frozenset(
    ("nsec", "nsecs", "nanosec", "nanosecs", "nanosecond", "nanoseconds", "ns")
)
#: Share of rows in which the receipt must not precede the stamp.
_MOST_ROWS = 0.98
#: Smallest step back of the stamps of a loop.
_LEAST_LOOP_S = 2.0


@dataclass(frozen=True)
class TimeColumns:
    """Columns of the stamp and the receipt of a table."""

    stamp: tuple[str, ...]
    """One column, or whole seconds and nanoseconds."""
    receipt: tuple[str, ...]
    """As `stamp`; empty if no column contains a receipt."""
    reason: str


@dataclass(frozen=True)
class ClockConstant:
    """Known difference of two clocks."""

    offset_s: float
    """Stamp minus time of the recorder's clock, as `clock_offset_s`."""
    name: str
    """Clocks that differ by this constant."""
    delay_s: float
    """Median delay after the correction."""


@dataclass(frozen=True)
class Loop:
    """Repetition of the stamps in a recording."""

    index: int
    """Index of the first message of the repetition."""
    back_s: float
    """Time by which the stamps go back."""


def time_columns(
    columns: Mapping[str, FloatArray], words: Mapping[str, Sequence[str]]
) -> TimeColumns | None:
    """Return the columns of stamp and receipt among `columns`, each of shape (n,); None if no column contains times.

    `words` contains the words of each name. A column of nanoseconds below 1e9 belongs to
    the seconds with the same beginning of the name. Of two clocks, the receipt is the
    one that is later in nearly all rows. Names decide if the rows do not.
    """
    times = _joined(columns, words)
    if not times:
        return None
    named = {
        key: sum(_rank(words[name]) for name in key[:1]) for key in times
    }  # above 0: receipt
    stamp = min(times, key=lambda key: named[key])
    others = [key for key in times if key != stamp]
    if not others:
        return TimeColumns(stamp, (), "the only column of times")
    receipt = max(others, key=lambda key: named[key])
    delays_s = times[receipt] - times[stamp]
    delays_s = delays_s[np.isfinite(delays_s)]
    if not len(delays_s) or float(np.median(np.abs(delays_s))) > _LARGEST_ZONE_S:
        return TimeColumns(
            stamp, (), "by its name; the other times have another origin"
        )
    if float(np.mean(delays_s <= 0.0)) >= _MOST_ROWS and (delays_s < 0.0).any():
        if named[receipt] - named[stamp] < 2:
            stamp, receipt = receipt, stamp
            delays_s = -delays_s
    elif not delays_s.any():
        return TimeColumns(stamp, (), "the other columns contain the same times")
    delay_s = float(np.median(delays_s))
    return TimeColumns(
        stamp,
        receipt,
        f"{' and '.join(receipt)} is later by {delay_s:.3g} s in the median, so it is the receipt",
    )


def _joined(
    columns: Mapping[str, FloatArray], words: Mapping[str, Sequence[str]]
) -> dict[tuple[str, ...], FloatArray]:
    """Return the times in s by their columns: one column, or seconds and nanoseconds."""
    result: dict[tuple[str, ...], FloatArray] = {}
    taken = set[str]()
    for name in columns:
        if not words[name] or words[name][-1] not in _WHOLE:
            continue
        for other in columns:
            is_fraction = bool(words[other]) and words[other][-1] in _FRACTION
            values = columns[other][np.isfinite(columns[other])]
            if (
                is_fraction
                and list(words[other][:-1]) == list(words[name][:-1])
                and len(values)
                and values.min() >= 0.0
                and values.max() < 1e9
            ):
                result[(name, other)] = columns[name] + 1e-9 * columns[other]
                taken |= {name, other}
    return result | {(name,): one for name, one in columns.items() if name not in taken}


def _rank(words: Sequence[str]) -> int:
    """Return the number of words of a receipt minus the number of words of a stamp."""
    own = set(words)
    return len(own & _OF_RECEIPT) - len(own & _OF_STAMP)


def clock_constant(delays_s: FloatArray) -> ClockConstant | None:
    """Return the known difference of clocks that explains the delays from stamp to receipt; None if none does.

    Usual delays need no constant. Delays of several seconds that are no constant are
    delays.
    """
    finite = delays_s[np.isfinite(delays_s)]
    if not len(finite):
        return None
    median_s = float(np.median(finite))
    low_s, high_s = np.quantile(finite, [0.1, 0.9])
    if _LEAST_DELAY_S <= median_s <= _LARGEST_DELAY_S:
        return None
    if high_s - low_s > _LARGEST_SPREAD_S:
        return None
    options = [
        ClockConstant(sign * seconds, name, median_s + sign * seconds)
        for name, seconds in _CONSTANTS.items()
        for sign in (1.0, -1.0)
    ]
    zone_s = -_ZONE_S * round((median_s - 0.1) / _ZONE_S)
    if zone_s and abs(zone_s) <= _LARGEST_ZONE_S:
        hours = abs(zone_s) / 3600
        options.append(
            ClockConstant(
                float(zone_s), f"time zones, {hours:g} h apart", median_s + zone_s
            )
        )
    fitting = [
        one
        for one in options
        if _LEAST_REMAINDER_S
        <= one.delay_s
        <= (
            _LARGEST_REMAINDER_S
            if abs(one.offset_s) < _ZONE_S
            else _LARGEST_ZONE_REMAINDER_S
        )
    ]
    return min(fitting, key=lambda one: abs(one.delay_s), default=None)


def loop_of(stamps_ns: IntArray, receipts_ns: IntArray) -> Loop | None:
    """Return the first repetition of the stamps of one source, shape (n,), in the order of receipt.

    None if there is no repetition. A repetition goes back by most of the time that was
    recorded before, and the stamps continue from there. Single wrong stamps are no
    repetition.
    """
    if len(stamps_ns) < 4:
        return None
    steps_s = np.diff(stamps_ns) * 1e-9
    for index in np.flatnonzero(steps_s < -_LEAST_LOOP_S).tolist():
        before = stamps_ns[: index + 1]
        after = stamps_ns[index + 1 : index + 4]
        passed_s = (receipts_ns[index + 1] - receipts_ns[0]) * 1e-9
        recorded_s = (before[-1] - before[0]) * 1e-9
        returns = np.isin(after, before).mean()
        is_near = abs(int(after[0]) - int(before[0])) * 1e-9 < 0.1 * max(
            recorded_s, 1.0
        )
        if (
            len(after) == 3
            and (np.diff(after) > 0).all()
            and recorded_s >= _LEAST_LOOP_S
            and passed_s >= 0.5 * recorded_s
            and (returns > 0.5 or is_near)
        ):
            return Loop(index + 1, -float(steps_s[index]))
    return None
