"""Tables of numbers by column name, and their forms: terminal, Markdown, LaTeX, CSV, JSON values."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt
from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as RichTable
from rich.text import Text

from fgtrack.io.run import Table as RunTable

Row = TypeVar("Row")
Value = str | int | float

NO_VALUE = "-"

_WIDTH = 120  # of a table as text
_NOTE_WIDTH = 86  # so that no note is broken
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
                shown.append(Shown(column.heading, cells, column.left))
        super().__init__(data)
        self.shown = tuple(shown)

    def __str__(self) -> str:
        return _text(self.rich())

    def rich(self) -> RichTable:
        """The table for a terminal; the name of a run is in its first row only."""
        table = RichTable(
            title=Text(f"\n{self.title}"),
            caption=Text("\n".join(self.notes)),
            box=box.SIMPLE_HEAD,
            show_edge=False,
            padding=(0, 0, 0, 1),
            min_width=_NOTE_WIDTH,
            title_justify="left",
            caption_justify="left",
        )
        for column in self.shown:
            if column.left:
                table.add_column(Text(column.heading), overflow="fold")
            else:
                table.add_column(Text(column.heading), justify="right", no_wrap=True)
        for cells in self._rows():
            table.add_row(*map(Text, cells))
        return table

    def to_markdown(self) -> str:
        """A table of GitHub Markdown under a heading, the notes below."""
        head = [_one_line(column.heading) for column in self.shown]
        rule = [":---" if column.left else "---:" for column in self.shown]
        rows = [[cell.replace("|", r"\|") for cell in row] for row in (head, rule, *self._rows())]
        lines = [f"### {self.title}", "", *(f"| {' | '.join(row)} |" for row in rows), ""]
        return "\n".join([*lines, *(f"- {note}" for note in self.notes), *([""] if self.notes else [])])

    _repr_markdown_ = to_markdown  # what a notebook shows

    def to_latex(self) -> str:
        """A table environment with the rules of the package booktabs; notes as comments."""
        head = [_latex(_one_line(column.heading)) for column in self.shown]
        rows = [[_latex(cell) for cell in row] for row in self._rows()]
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

    def _rows(self) -> Iterator[tuple[str, ...]]:
        before = ""
        for first, *cells in zip(*(column.cells for column in self.shown), strict=True):
            yield ("" if first == before else first), *cells
            before = first


@dataclass(frozen=True, eq=False, repr=False)
class Tables(Mapping[str, Table]):
    """Tables by name; `str` gives those that have rows as text."""

    tables: Mapping[str, Table]
    details: Mapping[str, Any] = field(default_factory=dict)  # Any: JSON values
    """What JSON has besides the tables."""

    def __getitem__(self, name: str) -> Table:
        return self.tables[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def __str__(self) -> str:
        return "\n".join(map(str, self._filled()))

    def __repr__(self) -> str:
        return f"<Tables: {', '.join(self)}>"

    def _repr_markdown_(self) -> str:
        return self.to_markdown()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        for table in self._filled():
            yield table.rich()

    def to_markdown(self, name: str | None = None) -> str:
        """The table `name`, or all that have rows."""
        return "\n".join(table.to_markdown() for table in self._filled(name))

    def to_latex(self, name: str | None = None) -> str:
        """The table `name`, or all that have rows."""
        return "\n".join(table.to_latex() for table in self._filled(name))

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
        """JSON values: the details, and the tables as lists of rows."""
        return {**self.details, "tables": {name: table.records() for name, table in self.tables.items()}}

    def _filled(self, name: str | None = None) -> list[Table]:
        return [self[name]] if name else [table for table in self.tables.values() if table.num_rows]


def _text(table: RichTable) -> str:
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(table)
    return capture.get().removesuffix("\n")


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
