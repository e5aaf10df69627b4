"""Tables of numbers by column name, and their forms: terminal, Markdown, LaTeX, CSV, JSON values."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from fgtrack.io.run import Table as RunTable

Row = TypeVar("Row")
Cell = TypeVar("Cell")
Value = str | int | float

NO_VALUE = "-"

_MOST_DECIMALS = 5
_WIDTH = 120  # of a table as text
_LATEX = {char: f"\\{char}" for char in "&%$#_{}"} | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {"\\": r"\textbackslash{}", "±": r"$\pm$", "<": r"$<$", ">": r"$>$"}


def short(value: Value) -> str:
    """`value` with three significant digits, whole numbers and text in full; a dash for NaN."""
    if isinstance(value, str | int):
        return str(value)
    if not math.isfinite(value):
        return NO_VALUE
    size = abs(float(f"{value:.2e}"))
    decimals = 0 if size >= 100.0 else 1 if size >= 10.0 else 2 if size >= 1.0 else 3
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # no negative zero


def two_digits(value: Value) -> str:
    """`value` with two significant digits and at most five decimals, whole numbers in full; a dash for NaN."""
    if isinstance(value, str | int):
        return str(value)
    if not math.isfinite(value):
        return NO_VALUE
    size = abs(float(f"{value:.1e}"))
    if round(size, _MOST_DECIMALS) == 0.0:
        return "0"
    decimals = min(max(0, 1 - math.floor(math.log10(size))), _MOST_DECIMALS)
    return f"{value:.{decimals}f}"


@dataclass(frozen=True)
class Column(Generic[Row]):
    """One or several numbers of every row, and the one cell that shows them."""

    heading: str
    """Lines, with the unit; a column without heading is in the data alone."""
    names: tuple[str, ...]
    """Names of the numbers, with their units."""
    of: Callable[[Row], tuple[Value, ...] | None]
    """The numbers; None where the row has none."""
    form: str = "{}"
    """How the numbers become one cell."""
    scale: float = 1.0
    """What is shown is as many times the number."""
    text: Callable[[Value], str] = short
    left: bool = False
    """Whether cells are aligned left, for text; else right."""
    bold: Callable[[Row], bool] | None = None
    """Which rows have the best value; none without it."""

    def cell(self, values: tuple[Value, ...] | None) -> str:
        """What is shown; a dash where no number is known."""
        texts = [self.text(v * self.scale if isinstance(v, float) else v) for v in values or ()]
        return self.form.format(*texts) if set(texts) - {NO_VALUE} else NO_VALUE


@dataclass(frozen=True)
class Shown:
    """A column as it is shown."""

    heading: str
    cells: tuple[str, ...]
    left: bool
    bold: tuple[bool, ...]

    @property
    def width(self) -> int:
        """Of the column in a terminal, without the space beside it."""
        return max(map(len, (*self.heading.split("\n"), *self.cells)), default=0)


class Table(RunTable):
    """Columns by name, each of shape (rows,): SI units, NaN where there is no value. `str` shows it as text.

    Attributes
    ----------
    title
        What it is.
    row_keys
        Names of the columns that identify a row; the first is the run.
    notes
        Lines below the table.
    shown
        Columns as people read them: rounded, in handy units, some with several numbers in a cell.
    """

    def __init__(
        self,
        title: str,
        columns: Sequence[Column[Row]],
        rows: Sequence[Row],
        row_keys: tuple[str, ...] = ("run",),
        notes: Sequence[str] = (),
    ) -> None:
        self.title, self.row_keys, self.notes = title, row_keys, tuple(notes)
        data: dict[str, npt.NDArray[Any]] = {}  # Any: a column holds floats, integers or text
        shown = []
        for column in columns:
            values = [column.of(row) for row in rows]
            for k, name in enumerate(column.names):
                data[name] = np.array([math.nan if one is None else one[k] for one in values])
            cells = tuple(map(column.cell, values))
            if column.heading:
                bold = tuple(column.bold is not None and column.bold(row) for row in rows)
                shown.append(Shown(column.heading, cells, column.left, bold))
        super().__init__(data)
        self.shown = tuple(shown)

    def __str__(self) -> str:
        return _text(self)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table; where the terminal is narrower, the columns that fit, and the others below."""
        yield Text(f"\n{self.title}")
        for number, columns in enumerate(self._parts(options.max_width)):
            if number:
                yield Text("continued:")
            yield _grid(columns)
        if self.notes:
            yield Text("\n".join(self.notes))

    def _parts(self, width: int) -> Iterator[list[Shown]]:
        """The columns in parts that are not wider than `width`; the names of the rows stand in each of them."""
        names = list(takewhile(lambda column: column.left, self.shown))
        part = list(names)
        for column in self.shown[len(names) :]:
            if len(part) > len(names) and sum(one.width + 2 for one in (*part, column)) - 1 > width:
                yield part
                part = list(names)
            part.append(column)
        yield part

    def to_markdown(self) -> str:
        """A table of GitHub Markdown under a heading, the notes below."""
        head = [_one_line(column.heading) for column in self.shown]
        rule = [":---" if column.left else "---:" for column in self.shown]
        cells = _rows(self.shown, lambda cell, bold: f"**{cell}**" if bold else cell)
        rows = [[cell.replace("|", r"\|") for cell in row] for row in (head, rule, *cells)]
        lines = [f"### {self.title}", "", *(f"| {' | '.join(row)} |" for row in rows), ""]
        return "\n".join([*lines, *(f"- {note}" for note in self.notes), *([""] if self.notes else [])])

    _repr_markdown_ = to_markdown  # what a notebook shows

    def to_latex(self) -> str:
        """A table environment with the rules of the package booktabs; notes as comments."""
        head = [_latex(_one_line(column.heading)) for column in self.shown]
        rows = _rows(self.shown, lambda cell, bold: f"\\textbf{{{_latex(cell)}}}" if bold else _latex(cell))
        body = [f"{' & '.join(row)} \\\\" for row in rows]
        spec = "".join("l" if column.left else "r" for column in self.shown)
        return "\n".join(
            [
                *(r"\begin{table}", r"\centering", f"\\caption{{{_latex(self.title)}}}"),
                *(f"\\begin{{tabular}}{{{spec}}}", r"\toprule", f"{' & '.join(head)} \\\\", r"\midrule", *body),
                *(r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in self.notes), r"\end{table}", ""),
            ]
        )

    def to_csv(self) -> str:
        """All columns with all digits; an empty cell where there is no value."""
        return _csv([tuple(self), *(tuple(record.values()) for record in self.records())])

    def records(self) -> list[dict[str, Value | None]]:
        """Rows as values by name; None where there is none."""
        columns = [[_plain(value) for value in column.tolist()] for column in self.values()]
        return [dict(zip(self, row, strict=True)) for row in zip(*columns, strict=True)]


@dataclass(frozen=True, eq=False, repr=False)
class Tables(Mapping[str, Table]):
    """Tables by name; `str` gives the verdict and the tables that have rows as text."""

    tables: Mapping[str, Table]
    details: Mapping[str, Any] = field(default_factory=dict)  # Any: JSON values
    """What JSON has besides the tables."""
    verdict: tuple[str, ...] = ()
    """Sentences that say what the tables amount to."""

    def __getitem__(self, name: str) -> Table:
        return self.tables[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def __str__(self) -> str:
        return "\n".join([*(_text(Text(line)) for line in self.verdict), *map(str, self._filled())])

    def __repr__(self) -> str:
        return f"<Tables: {', '.join(self)}>"

    def _repr_markdown_(self) -> str:
        return self.to_markdown()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from map(Text, self.verdict)
        yield from self._filled()

    def to_markdown(self, name: str | None = None) -> str:
        """The table `name`, or all that have rows."""
        lines = "" if name or not self.verdict else "\n".join([*(f"- {line}" for line in self.verdict), "", ""])
        return lines + "\n".join(table.to_markdown() for table in self._filled(name))

    def to_latex(self, name: str | None = None) -> str:
        """The table `name`, or all that have rows."""
        lines = "" if name else "".join(f"% {line}\n" for line in self.verdict)
        return lines + "\n".join(table.to_latex() for table in self._filled(name))

    def to_csv(self, name: str | None = None) -> str:
        """The table `name`, or all numbers in one of five columns: table, run, part (sensor, lag), quantity, value."""
        if name is not None:
            return self[name].to_csv()
        rows: list[tuple[Value | None, ...]] = [("table", "run", "part", "quantity", "value")]
        for name, table in self.tables.items():
            for record in table.records():
                run, *part = (record[key] for key in table.row_keys)
                rows += [(name, run, *(part or [""]), k, v) for k, v in record.items() if k not in table.row_keys]
        return _csv(rows)

    def to_dict(self) -> dict[str, Any]:
        """JSON values: the verdict, the details, and the tables as lists of rows."""
        return {
            "verdict": list(self.verdict),
            **self.details,
            "tables": {name: table.records() for name, table in self.tables.items()},
        }

    def _filled(self, name: str | None = None) -> list[Table]:
        return [self[name]] if name else [table for table in self.tables.values() if table.num_rows]


def _text(shown: Table | Text) -> str:
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get().removesuffix("\n")


def _grid(columns: Sequence[Shown]) -> RichTable:
    """Columns for a terminal; the name of a run is in its first row only."""
    table = RichTable(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 0, 0, 1))
    for column in columns:
        if column.left:
            table.add_column(Text(column.heading), overflow="fold")
        else:
            table.add_column(Text(column.heading), justify="right", no_wrap=True)
    for cells in _rows(columns, _as_text):
        table.add_row(*cells)
    return table


def _as_text(cell: str, bold: bool) -> Text:
    return Text(cell, "bold" if bold else "")


def _rows(columns: Sequence[Shown], form: Callable[[str, bool], Cell]) -> Iterator[list[Cell]]:
    """Rows of cells as `form` makes them of the text and whether it is bold; the first cell only where it changes."""
    before = ""
    for marks, (first, *cells) in zip(
        zip(*(column.bold for column in columns), strict=True),
        zip(*(column.cells for column in columns), strict=True),
        strict=True,
    ):
        texts = ("" if first == before else first, *cells)
        yield [form(text, mark) for text, mark in zip(texts, marks, strict=True)]
        before = first


def _one_line(heading: str) -> str:
    return heading.replace("-\n", "").replace("/\n", "/").replace("\n", " ")


def _latex(text: str) -> str:
    return "".join(_LATEX.get(char, char) for char in text)


def _plain(value: Value) -> Value | None:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _csv(rows: Iterable[Sequence[Value | None]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
