"""Stamps and receipts of the rows of a table: numbers, dates, times of day."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fgtrack.inputs.formats.common import exact_ns
from fgtrack.inputs.formats.fields import FieldError, paths_of
from fgtrack.inputs.formats.time_texts import TimeForm, form_of, on_nearest_day
from fgtrack.inputs.settings import CsvTable

TIMES = ("stamp", "receipt")
"""Names of the times of a row."""
Cells = Mapping[str, str]


class WrongTimeError(FieldError):
    """A cell contains no time."""


@dataclass
class Day:
    """Newest time of day of an input. The next time of day gets the day on which it is nearest to this time."""

    newest_ns: int | None = None


class TableTimes:
    """Converts the times of a table's rows; the forms of dates are inferred from its first rows."""

    def __init__(self, table: CsvTable, samples: Sequence[Cells], day: Day) -> None:
        """Prepare the conversion; `day` is shared by all tables of an input.

        Raises `FieldError` for a time of more than two columns.
        """
        self._table = table
        self._newest_ns = day
        self._columns = {
            name: paths_of(table.columns.get(name, table.columns["stamp"]))
            for name in TIMES
        }
        self._forms: dict[str, TimeForm | None] = {}
        for name, columns in self._columns.items():
            if len(columns) > 2:
                raise FieldError(
                    f"{columns}: a time is one column, or seconds and nanoseconds, or date and time"
                )
            self._forms[name] = form_of(_joined(cells, columns) for cells in samples)

    def __call__(self, cells: Cells) -> tuple[int, int]:
        """Return stamp and receipt of a row in integer nanoseconds; raises `FieldError` for other texts."""
        times_ns = {name: self._time_ns(cells, name) for name in TIMES}
        for name, other in (TIMES, TIMES[::-1]):
            form = self._forms[name]
            if form is not None and form.is_of_day:
                times_ns[name] = self._on_day(times_ns[name], times_ns[other], other)
        if self._table.stamp_from == "receipt":
            return times_ns["receipt"], times_ns["receipt"]
        return times_ns["stamp"], times_ns["receipt"]

    def _on_day(self, time_ns: int, other_ns: int, other: str) -> int:
        """Return the time of day `time_ns` of a row with its day.

        If the row's other time has a date, the day is the one nearest to it. Else it is the day nearest to the newest
        time of the input.
        """
        form = self._forms[other]
        if form is None or not form.is_of_day:
            return on_nearest_day(time_ns, other_ns)
        day = self._newest_ns
        if day.newest_ns is not None:
            time_ns = on_nearest_day(time_ns, day.newest_ns)
        day.newest_ns = time_ns
        return time_ns

    def _time_ns(self, cells: Cells, name: str) -> int:
        columns = self._columns[name]
        form = self._forms[name]
        text = _joined(cells, columns)
        try:
            if form is not None:
                return form.time_ns(text)
            units = [self._table.time_unit] if len(columns) == 1 else ["s", "ns"]
            return sum(
                exact_ns(cells[column], unit)
                for column, unit in zip(columns, units, strict=True)
            )
        except (ArithmeticError, ValueError) as error:
            unit = self._table.time_unit if len(columns) == 1 else "s and ns"
            wanted = (
                f"is not a time in {unit}: correct the cell or `time_unit`"
                if form is None
                else "is not a date and time as in the rows before: correct the cell"
            )
            raise WrongTimeError(
                f"{', '.join(columns)}: {text!r:.40} {wanted}"
            ) from error


def _joined(cells: Cells, columns: Sequence[str]) -> str:
    return " ".join(cells[column] for column in columns)
