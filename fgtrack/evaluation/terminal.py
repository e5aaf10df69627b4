"""A table as lines of a terminal: no row is wrapped and no name is cut, however narrow the terminal is."""

import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, takewhile

from rich.cells import cell_len
from rich.text import Text

from fgtrack.core.errors import printable

_GAP = 2
_INDENT = "  "  # of rows below their name
_QUANTITY = re.compile(r"(\d) (%|mm?|m/s|rad|s)(?=\W|$)")


@dataclass(frozen=True)
class Shown:
    """A column as it is shown."""

    heading: str
    cells: tuple[str, ...]
    left: bool
    bold: tuple[bool, ...]

    @cached_property
    def width(self) -> int:
        """Of the column in a terminal, without the space beside it."""
        return max(map(cell_len, (*self.heading.split("\n"), *self.cells)), default=0)


def lines(columns: Sequence[Shown], width: int) -> Iterator[Text]:
    """The table of `columns` in lines that are no longer than `width`.

    Leading columns of text name the rows. What does not fit beside the names stands in further parts below, each with
    the names; where that does not do, or is longer, the first name stands on a line of its own, above its rows. Only
    what is itself longer than a line goes on in the next one.
    """
    for line in _arranged(columns, width):
        yield from line.divide(range(width, line.cell_len, width))


def _arranged(columns: Sequence[Shown], width: int) -> Iterator[Text]:
    names = list(takewhile(lambda column: column.left, columns))
    values = columns[len(names) :]
    beside = _parts(names, values, width)
    if not names or (len(beside) == 1 and _fits(beside, width)):
        return _all_lines(beside, None)
    above = _parts(names[1:], values, width - len(_INDENT))
    groups = len([*groupby(names[0].cells)])
    longer = len(beside) * len(names[0].cells) > len(above) * (len(names[0].cells) + groups)
    return _all_lines(above, names[0]) if longer or not _fits(beside, width) else _all_lines(beside, None)


def _parts(names: Sequence[Shown], values: Sequence[Shown], width: int) -> list[list[Shown]]:
    """The columns in parts, each of them with the names and at least one value."""
    parts = [list(names)]
    for column in values:
        if len(parts[-1]) > len(names) and _width([*parts[-1], column]) > width:
            parts.append(list(names))
        parts[-1].append(column)
    return parts


def _width(columns: Sequence[Shown]) -> int:
    return sum(column.width + _GAP for column in columns) - 1


def _fits(parts: Sequence[Sequence[Shown]], width: int) -> bool:
    return all(_width(part) <= width for part in parts)


def _all_lines(parts: Sequence[Sequence[Shown]], title: Shown | None) -> Iterator[Text]:
    for number, part in enumerate(parts):
        if number:
            yield _line("continued:")
        yield from _part_lines(part, title)


def _part_lines(columns: Sequence[Shown], title: Shown | None) -> Iterator[Text]:
    indent = "" if title is None else _INDENT
    if title is not None and title.heading:
        yield from map(_line, f" {title.heading}".splitlines())
    headings = [column.heading.split("\n") for column in columns]
    height = max(map(len, headings), default=0)
    for k in range(height):
        yield _row(columns, [part[k - height] if k >= height - len(part) else "" for part in headings], indent=indent)
    yield _line("─" * max(len(indent) + _width(columns), 1))
    names = title or columns[0]
    before = None
    for row, name in enumerate(names.cells):
        if title is not None and name != before:
            yield _line(f" {name}", title.bold[row])
        cells = [column.cells[row] for column in columns]
        if title is None and names.left and name == before:
            cells[0] = ""
        yield _row(columns, cells, [column.bold[row] for column in columns], indent)
        before = name


def _row(columns: Sequence[Shown], cells: Sequence[str], bold: Sequence[bool] = (), indent: str = "") -> Text:
    text = _line(indent)
    for place, (column, cell) in enumerate(zip(columns, cells, strict=True)):
        space = " " * (column.width - cell_len(cell))
        text.append(" " * (_GAP if place else 1) + ("" if column.left else space))
        text.append(cell, "bold" if bold and bold[place] else "")
        text.append(space if column.left else "")
    text.rstrip()
    return text


def _line(text: str, bold: bool = False) -> Text:
    """Text that no terminal wraps or cuts before its edge."""
    return Text(text, "bold" if bold else "", no_wrap=True, overflow="ignore")


def of_rows(column: Shown, rows: Sequence[int]) -> Shown:
    """`column` with these rows alone."""
    return replace(column, cells=tuple(column.cells[k] for k in rows), bold=tuple(column.bold[k] for k in rows))


def bulleted(sentences: Iterable[str], width: int) -> Iterator[Text]:
    """Sentences, each behind a dash, wrapped between words; a number and its unit stay together."""
    for sentence in sentences:
        kept = _QUANTITY.sub("\\1\u00a0\\2", printable(sentence))
        for line in textwrap.wrap(kept, width, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False):
            yield _line(line.replace("\u00a0", " "))


def hanging(names: Mapping[str, str], width: int) -> Iterator[Text]:
    """Names, and beside each in a column of its own what it is, wrapped between words."""
    indent = 2 + max(map(len, names), default=0) + _GAP
    for name, what in names.items():
        first = f"  {name}".ljust(indent)
        for line in textwrap.wrap(what, width, initial_indent=first, subsequent_indent=" " * indent):
            yield _line(line)
