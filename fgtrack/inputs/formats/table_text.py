"""Form of the text of a table: encoding, separator, header, decimal comma."""

import codecs
import csv
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice

from fgtrack.core.errors import DataError
from fgtrack.inputs.formats.time_texts import form_of

_SEPARATORS = ",;\t|"
#: Rows from which the form is inferred.
_ROWS = 200
_BYTE_ORDER_MARKS = {
    codecs.BOM_UTF8: "utf-8-sig",
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan|[+-]?inf", re.I)
_WITH_POINT = re.compile(r"[+-]?\d*\.\d+(?:[eE][+-]?\d+)?")
_WITH_COMMA = re.compile(
    r"[+-]?(?:\d*|\d{1,3}(?:\.\d{3})+),\d+(?:[eE][+-]?\d+)?|[+-]?\d+,"
)
#: Columns of a trajectory in the layout of TUM, which has no header.
_TRAJECTORY = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_UNIT_NORM = 1e-2
#: Smallest table that is recognised by its content.
_FEWEST_ROWS = 3
_FEWEST_COLUMNS = 3
#: Columns of the messages of ADS-B receivers in the format of BaseStation (SBS), and kinds of messages.
_SBS = (
    *("message", "transmission", "session", "aircraft", "hex", "flight"),
    *("generated_date", "generated_time", "log_date", "log_time", "callsign"),
    *("altitude_ft", "ground_speed_kn", "track_deg", "latitude", "longitude"),
    *("climb_ft_per_min", "squawk", "alert", "emergency", "spi", "is_on_ground"),
)
_SBS_KINDS = frozenset(("MSG", "SEL", "ID", "AIR", "STA", "CLK"))


@dataclass(frozen=True)
class TableText:
    """Form of the text of a table."""

    separator: str
    """Character between the cells; a space stands for any blanks."""
    header: tuple[str, ...]
    """Names of the columns; empty names at the end may have no cells."""
    num_head_lines: int
    """Lines before the first row."""
    has_decimal_comma: bool

    def cells(self, lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
        """Yield the number of the line and the stripped cells of each row of `lines`, without empty rows.

        Empty cells behind the last column are left out, and missing cells of unnamed
        columns at the end added. Numbers with a decimal comma get a point.
        """
        lines = islice(lines, self.num_head_lines, None)
        if self.separator == " ":
            lines = (" ".join(line.split()) for line in lines)
        reader = csv.reader(lines, delimiter=self.separator, skipinitialspace=True)
        size = len(self.header)
        num_named = len(_without_end(self.header, 0))
        for cells in reader:
            if not any(cells):
                continue
            stripped = list(map(str.strip, cells))
            if size and len(stripped) > size and not any(stripped[size:]):
                del stripped[size:]
            if num_named <= len(stripped) < size:
                stripped += [""] * (size - len(stripped))
            if self.has_decimal_comma:
                stripped = list(map(_with_point, stripped))
            yield self.num_head_lines + reader.line_num, stripped


def encoding_of(sample: bytes) -> str:
    """Return the name of the encoding of a text that begins with `sample`.

    It is given by a byte order mark or by the positions of the bytes 0; else UTF-8, and
    Windows-1252 if the bytes are not UTF-8.
    """
    for mark, name in _BYTE_ORDER_MARKS.items():
        if sample.startswith(mark):
            return name
    pairs = max(len(sample) // 2, 1)
    for name, first in (("utf-16-le", 1), ("utf-16-be", 0)):
        if sample[first::2].count(0) > 0.5 * pairs:
            return name
    try:
        codecs.getincrementaldecoder("utf-8")().decode(sample)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def text_form(lines: Sequence[str], delimiter: str | None, where: str) -> TableText:
    """Return the form of a table that begins with `lines`; raises `DataError` if its columns have no names.

    Without a `delimiter`, the most frequent character of the first row among comma,
    semicolon, tab and bar separates the cells, else blanks. The header is the last
    comment (`#`) before a first row with values, if both have the same number of cells.
    """
    given = re.match(r"sep=(.)\s*$", lines[0]) if lines else None
    if given is not None:
        delimiter = delimiter or given[1]
    first = int(given is not None)
    comment = ""
    while first < len(lines) and re.match(r"\s*(#|$)", lines[first]):
        comment = lines[first].strip() or comment
        first += 1
    head = lines[first] if first < len(lines) else comment
    separator = delimiter or max(_SEPARATORS, key=head.count)
    if delimiter is None and separator not in head and len(head.split()) > 1:
        separator = " "
        comment = comment.lstrip("#")

    def cells_of(some: Sequence[str]) -> list[list[str]]:
        found = list[list[str]]()
        with suppress(csv.Error):  # the reader of the rows reports it
            for _, cells in TableText(separator, (), 0, False).cells(some):
                found.append(cells)
        return found

    samples = cells_of(lines[first : first + _ROWS]) or [[]]
    named = (cells_of([comment]) or [[]])[0]
    has_comma = separator != "," and _has_decimal_comma(samples)
    has_values = any(cell and _is_value(cell) for cell in samples[0])
    size = len(_without_end(samples[0], len(named)))
    if has_values and len(named) == size > 1:
        return TableText(separator, tuple(named), first, has_comma)
    if first == len(lines):
        return TableText(separator, tuple(named), first, has_comma)
    present = [cell for cell in samples[0] if cell]
    if present and 2 * sum(map(_is_value, present)) >= len(present):
        return TableText(separator, _names_of(samples, where), first, has_comma)
    return TableText(separator, tuple(samples[0]), first + 1, has_comma)


def _without_end(cells: Sequence[str], size: int) -> Sequence[str]:
    """Return `cells` without the empty ones at the end, but at least `size` of them."""
    end = len(cells)
    while end > size and not cells[end - 1]:
        end -= 1
    return cells[:end]


def is_table(lines: Sequence[str]) -> bool:
    """True if `lines` have the form of a table of numbers: rows of equal length, mostly numbers or times."""
    try:
        form = text_form(lines, None, "")
        rows = [cells for _, cells in islice(form.cells(lines), _ROWS)]
    except (DataError, csv.Error):
        return False
    rows = rows[:-1] if len(rows) == _ROWS else rows
    if len(rows) < _FEWEST_ROWS or len(form.header) < _FEWEST_COLUMNS:
        return False
    first = [cell for cell in rows[0] if cell]
    num_values = sum(map(_is_value, first))
    return all(len(row) == len(rows[0]) for row in rows) and 2 * num_values > len(first)


def _with_point(cell: str) -> str:
    return (
        cell.replace(".", "").replace(",", ".") if _WITH_COMMA.fullmatch(cell) else cell
    )


def _has_decimal_comma(rows: Sequence[Sequence[str]]) -> bool:
    """True if numbers in the sample have a comma, and none has a point."""
    cells = [cell for row in rows for cell in row]
    return any(map(_WITH_COMMA.fullmatch, cells)) and not any(
        map(_WITH_POINT.fullmatch, cells)
    )


def _is_value(cell: str) -> bool:
    """True if the cell is empty, a number or a time, so it names no column."""
    return (
        not cell
        or _NUMBER.fullmatch(_with_point(cell)) is not None
        or form_of([cell]) is not None
    )


def _names_of(rows: Sequence[Sequence[str]], where: str) -> tuple[str, ...]:
    """Return the names of the columns of a known layout without a header. Raises `DataError` for another table."""
    if all(len(row) == len(_SBS) and row[0] in _SBS_KINDS for row in rows):
        return _SBS
    is_numeric = all(
        _NUMBER.fullmatch(_with_point(cell)) for row in rows for cell in row
    )
    if is_numeric and all(len(row) == len(_TRAJECTORY) for row in rows):
        norms = [sum(float(_with_point(each)) ** 2 for each in row[4:]) for row in rows]
        if all(abs(norm - 1.0) < _UNIT_NORM for norm in norms):
            return _TRAJECTORY
    raise DataError(
        f"{where}: has no header, its first line contains values: write the names of the "
        f"{len(rows[0])} columns into a first line, for example time,x,y"
    )
