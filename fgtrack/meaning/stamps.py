"""Columns of the times of a table: numbers since 1970, dates, times of day, a date and a time in two columns."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.time import NS_PER_S, NS_PER_UNIT
from fgtrack.core.types import FloatArray
from fgtrack.inputs.formats.fields import paths_of
from fgtrack.inputs.formats.table_times import Cells
from fgtrack.inputs.formats.time_texts import TimeForm, form_of
from fgtrack.inputs.settings import FieldPath
from fgtrack.meaning.guess import Guess, is_time, time_unit, words_of
from fgtrack.meaning.times import time_columns

__all__ = ["stamps", "with_receipt", "with_stamp"]

#: Number of rows from which the form of dates is inferred.
_ROWS = 1000
_NANOS = tuple(
    [word]
    for word in ("nsec", "nsecs", "nanosec", "nanosecs", "nanosecond", "nanoseconds")
)
_DATE_WORDS = frozenset(("date", "day", "datum"))


def with_stamp(own: Mapping[str, Guess], cells: Sequence[Cells]) -> dict[str, Guess]:
    """Return the guesses `own` of a table with the rows `cells`, completed by a stamp.

    Without a stamp, the receipt is the stamp. A time of day gets the column of dates
    with the same words, or else the first one.
    """
    result = dict(own)
    if "stamp" not in own and "receipt" in own:
        only = result.pop("receipt")
        result["stamp"] = replace(only, reason="the only column of times")
    for key in ("stamp", "receipt"):
        if key in result and cells:
            result[key] = _with_date(result[key], cells)
    return result


def _with_date(guess: Guess, cells: Sequence[Cells]) -> Guess:
    """Return the guess of a time with the column of dates beside it, if it needs one."""
    form = _form(cells, guess.path)
    if form.date is not None if form else _is_number(cells[0], guess.path):
        return guess
    own = paths_of(guess.path)[0]
    names = [name for name in cells[0] if name]
    dates = [name for name in names if _DATE_WORDS & set(words_of(name))]
    clocks = (
        [own] if form else [each for each in names if words_of(each)[-1:] == ["time"]]
    )
    context = set(words_of(own))
    dates.sort(key=lambda name: not context & (set(words_of(name)) - _DATE_WORDS))
    for columns in ([date, clock] for date in dates for clock in clocks):
        if columns[0] != columns[1] and _form(cells, columns) is not None:
            return Guess(columns, "date and time of day")
    return guess


def with_receipt(
    own: Mapping[str, Guess], values: Mapping[str, Sequence[float]]
) -> dict[str, Guess]:
    """Return the guesses `own` of a table with the columns of stamp and receipt that its times show.

    `values` contains the numbers in the rows by column. Stamps that are dates stay as they
    are, and so does a receipt in another unit.
    """
    result = dict(own)
    names = [name for name in values if is_time(name) or words_of(name)[-1:] in _NANOS]
    columns: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    for name in names:
        numbers = np.asarray(values[name], dtype=np.float64)
        finite = numbers[np.isfinite(numbers)]
        if len(finite) < len(numbers) or not len(finite):
            continue
        is_fraction = words_of(name)[-1:] in _NANOS
        units[name] = "ns" if is_fraction else time_unit(name, finite.tolist())[0]
        scale = 1.0 if is_fraction else NS_PER_UNIT[units[name]] / NS_PER_S
        columns[name] = scale * numbers
    stamp = paths_of(result["stamp"].path)[0] if "stamp" in result else ""
    if stamp not in columns:
        return result
    found = time_columns(columns, {name: words_of(name) for name in columns})
    if found is None:
        return result
    result["stamp"] = Guess(_path(found.stamp), found.reason)
    result.pop("receipt", None)
    unit = "s" if len(found.stamp) == 2 else units[found.stamp[0]]
    if len(found.receipt) == 2 or (found.receipt and units[found.receipt[0]] == unit):
        result["receipt"] = Guess(_path(found.receipt), found.reason)
    return result


def _path(names: Sequence[str]) -> str | list[str]:
    return names[0] if len(names) == 1 else list(names)


def stamps(guess: Guess, cells: Sequence[Cells]) -> tuple[list[float], str, str]:
    """Return the times in the rows, NaN for others, their unit, and the reason for the unit."""
    texts = [_joined(row, guess.path) for row in cells]
    form = _form(cells, guess.path)
    if form is not None:
        reason = "times of day" if form.is_of_day else "dates and times"
        return [_seconds(form, text) for text in texts], "s", reason
    numbers = [_number(text.split(" ")[0]) for text in texts]
    if len(paths_of(guess.path)) == 2:
        numbers = [
            whole_s + _number(text.split(" ")[1]) / NS_PER_S
            for whole_s, text in zip(numbers, texts, strict=True)
        ]
        return numbers, "s", "whole seconds and nanoseconds"
    finite = [value for value in numbers if math.isfinite(value)]
    unit, reason = time_unit(paths_of(guess.path)[0], finite)
    return numbers, unit, reason


def _form(cells: Sequence[Cells], path: FieldPath) -> TimeForm | None:
    return form_of(_joined(row, path) for row in cells[:_ROWS])


def _joined(row: Cells, path: FieldPath) -> str:
    return " ".join(row[name] for name in paths_of(path))


def _is_number(row: Cells, path: FieldPath) -> bool:
    return math.isfinite(_number(_joined(row, path).split(" ")[0]))


def _seconds(form: TimeForm, text: str) -> float:
    try:
        return form.time_ns(text) / NS_PER_S
    except (ValueError, ArithmeticError):
        return math.nan


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
