"""Texts with dates and times: ISO 8601, dates with the day or the month first, times of day, numbers since 1970.

The zone is UTC if the text names none. Fractions of a second are exact.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from functools import lru_cache
from itertools import product

from fgtrack.core.time import NS_PER_S, epoch_unit
from fgtrack.inputs.formats.common import exact_ns

DAY_S = 86_400
#: Number of texts in which the first time is searched.
_TRIED = 20
_TEXT = re.compile(
    r"(?:(?:Mon|Tue|Wed|Thu|Fri|Sat|Sun)[a-z]*,? )?(?P<day>[^:]*?)[T ,]*(?P<clock>\d{1,2}:\d\d(?::\d\d)?|(?<=T)\d{6})Z?"
    r"(?P<fraction>[.,:]\d+)? ?(?P<half>[AaPp][Mm])?"
    r" ?(?:Z|UTC|GMT|(?P<zone>[+-]\d\d:?(?:\d\d)?))?"
)
_ISO = ("%Y-%m-%d", "%Y/%m/%d", "%Y.%m.%d", "%Y%m%d")
_DAY_FIRST = (
    *(f"%d{mark}%m{mark}{year}" for mark, year in product("./-", ("%Y", "%y"))),
    *(f"%d{mark}%b{mark}{year}" for mark, year in product("- /", ("%Y", "%y"))),
    "%d %B %Y",
)
_MONTH_FIRST = (
    *(f"%m{mark}%d{mark}{year}" for mark, year in product("/-.", ("%Y", "%y"))),
    *("%b %d %Y", "%b %d, %Y", "%B %d, %Y"),
)
_CLOCKS = ("%H:%M:%S", "%H:%M", "%H%M%S")
_HALF_CLOCKS = ("%I:%M:%S %p", "%I:%M %p")
_IN_LINE = re.compile(
    r"(\d{4})[-/.](\d\d)[-/.](\d\d)[T ,](\d\d:\d\d:\d\d)(?:[.,](\d+))?(Z|[+-]\d\d:?\d\d)?"
)
_NUMBER = re.compile(r"(?<![\w.])\d{9,19}(?:\.\d+)?(?![\w.])")


@lru_cache(4096)  # many rows have the same second
def _whole_s(text: str, form: str) -> int:
    return int(datetime.strptime(text, form).timestamp())


@dataclass(frozen=True)
class TimeForm:
    """Form of the times in a column."""

    date: str | None = None
    """Date in the notation of `strptime`; None for times of day, which get the date 1 January 1970."""
    clock: str = _CLOCKS[0]
    """Time of day in the notation of `strptime`."""

    @property
    def is_of_day(self) -> bool:
        """True if the texts contain no date."""
        return self.date is None

    def time_ns(self, text: str) -> int:
        """Convert `text` to integer nanoseconds since 1970; raises `ValueError` for a text of another form."""
        match = _TEXT.fullmatch(text.strip())
        if match is None or bool(match["day"]) is self.is_of_day:
            raise ValueError("the text has another form")
        half = f" {match['half'].upper()}" if match["half"] else ""
        zone = (match["zone"] or "+0000").replace(":", "").ljust(5, "0")
        whole_s = _whole_s(
            f"{match['day'] or '1970'} {match['clock']}{half} {zone}",
            f"{self.date or '%Y'} {self.clock} %z",
        )
        fraction = Decimal(f"0.{match['fraction'][1:]}") if match["fraction"] else 0
        return exact_ns(whole_s + fraction)


def form_of(texts: Iterable[str]) -> TimeForm | None:
    """Return the form of the times in `texts`, of one column; None if they are numbers or have different forms.

    A tenth of the texts may have another form. Of several possible forms the one with
    the shortest duration counts, because the rows of a table follow each other. If that
    does not decide either, the day comes first, unless the time has AM or PM.
    """
    samples = [text.strip() for text in texts if text.strip()]
    match = next(filter(None, map(_TEXT.fullmatch, samples[:_TRIED])), None)
    if match is None:
        return None
    clocks = _HALF_CLOCKS if match["half"] else _CLOCKS
    dates: Sequence[str | None] = (*_ISO, *_DAY_FIRST, *_MONTH_FIRST)
    if match["half"]:
        dates = (*_ISO, *_MONTH_FIRST, *_DAY_FIRST)
    best: tuple[int, int] | None = None
    result = None
    for date, clock in product(dates if match["day"] else (None,), clocks):
        form = TimeForm(date, clock)
        times_ns = _times_ns(form, samples)
        if times_ns is None:
            continue
        ranking = len(samples) - len(times_ns), max(times_ns) - min(times_ns)
        if best is None or ranking < best:
            best = ranking
            result = form
    return result


def _times_ns(form: TimeForm, texts: Sequence[str]) -> list[int] | None:
    """Return the times of `texts` in the `form`, except texts in another form.

    None if more than a tenth of the texts has another form.
    """
    times_ns = list[int]()
    for number, text in enumerate(texts):
        try:
            times_ns.append(form.time_ns(text))
        except (ValueError, ArithmeticError):
            if number - len(times_ns) >= len(texts) // 10:
                return None
    return times_ns


def on_nearest_day(time_ns: int, near_ns: int) -> int:
    """Return the time of day `time_ns` on the day on which it is nearest to `near_ns`."""
    day_ns = DAY_S * NS_PER_S
    return time_ns + day_ns * round((near_ns - time_ns) / day_ns)


def time_in_line_s(text: str) -> float | None:
    """Return the first time in `text` in s since 1970: an ISO date, else a number since 1970; None without a time."""
    if found := _IN_LINE.search(text):
        *day, clock, fraction, zone = found.groups()
        whole = datetime.fromisoformat(f"{'-'.join(day)}T{clock}{zone or 'Z'}")
        return whole.timestamp() + float(f"0.{fraction or 0}")
    for number in _NUMBER.findall(text):
        unit = epoch_unit(float(number))
        if unit is not None:
            return exact_ns(Decimal(number), unit) / NS_PER_S
    return None
