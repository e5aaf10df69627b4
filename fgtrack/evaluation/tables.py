"""Tables of numbers by column name, and their forms: terminal, Markdown, LaTeX, CSV, JSON values."""

import copy
import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any, Generic, Literal, Self, TypeVar

import numpy as np
import numpy.typing as npt
from rich.console import Console, ConsoleOptions, RenderResult
from rich.text import Text

from fgtrack.core.errors import printable, printable_lines
from fgtrack.evaluation.terminal import Shown, bulleted, lines, of_rows
from fgtrack.io.run import Table as RunTable

Row = TypeVar("Row")
Cell = TypeVar("Cell")
Value = str | int | float

NO_VALUE = "-"

_MOST_DECIMALS = 5
_WIDTH = 120  # of a table as text
_MOST_SENTENCES = 10  # of the verdict in a repr
_MARKDOWN = {"\\": r"\\", "|": r"\|", "<": r"\<"}
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
    when: Literal["always", "few", "full"] = "always"
    """Whether it is shown only among few columns, or only where the table is shown in full."""
    note: str = ""
    """A line below the table where the column is shown."""

    def cell(self, values: tuple[Value, ...] | None) -> str:
        """What is shown; a dash where no number is known."""
        texts = [self.text(v * self.scale if isinstance(v, float) else v) for v in values or ()]
        return self.form.format(*texts) if set(texts) - {NO_VALUE} else NO_VALUE


class Table(RunTable):
    """Columns by name, each of shape (rows,): SI units, NaN where there is no value. `str` shows it as text.

    Attributes
    ----------
    title
        What it is.
    row_keys
        Names of the columns that identify a row; the first is the run.
    notes
        Lines below the table, where it is shown in full.
    shown
        Columns as people read them: rounded, in handy units, some with several numbers in a cell.
    is_detail
        Whether it is shown only where a comparison is shown in full.
    """

    def __init__(
        self,
        title: str,
        columns: Sequence[Column[Row]],
        rows: Sequence[Row],
        row_keys: tuple[str, ...] = ("run",),
        notes: Sequence[str] = (),
        *,
        detail: bool = False,
        detail_rows: Callable[[Row], bool] = lambda row: False,
    ) -> None:
        self.title, self.row_keys, self.is_detail = printable(title), row_keys, detail
        data: dict[str, npt.NDArray[Any]] = {}  # Any: a column holds floats, integers or text
        shown = []
        for column in columns:
            values = [column.of(row) for row in rows]
            for k, name in enumerate(column.names):
                data[name] = np.array([math.nan if one is None else one[k] for one in values])
            cells = tuple(printable(column.cell(each)) for each in values)
            if column.heading:
                bold = tuple(column.bold is not None and column.bold(row) for row in rows)
                shown.append((column, Shown(printable_lines(column.heading), cells, column.left, bold)))
        super().__init__(data)
        self._shown, self._own_notes, self._full = shown, tuple(notes), False
        self._few_rows = [k for k, row in enumerate(rows) if not detail_rows(row)]
        self.shown = tuple(each for column, each in shown if column.when != "few")
        self.notes = self._notes("few")

    def in_full(self) -> Self:
        """The same table, which shows all of its columns and rows; without it `str` and files show the main ones."""
        full = copy.copy(self)
        full._full = True
        return full

    @property
    def has_more(self) -> bool:
        """Whether there is more than what is shown."""
        hidden = len(self._few_rows) < self.num_rows or any(column.when == "full" for column, _ in self._shown)
        return hidden and not self._full

    def __str__(self) -> str:
        return _text(self)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table, its columns arranged as the width of the terminal demands."""
        yield Text(f"\n{self.title}")
        yield from lines(self._visible(), options.max_width)
        yield from map(Text, self._visible_notes())

    def _visible(self) -> list[Shown]:
        if self._full:
            return list(self.shown)
        return [of_rows(each, self._few_rows) for column, each in self._shown if column.when != "full"]

    def _visible_notes(self) -> tuple[str, ...]:
        return self.notes if self._full else self._notes("full")

    def _notes(self, hidden: str) -> tuple[str, ...]:
        """The notes, without those of the columns that are `hidden`."""
        of_columns = (column.note for column, _ in self._shown if column.note and column.when != hidden)
        return tuple(dict.fromkeys(map(printable, (*of_columns, *self._own_notes))))

    def to_markdown(self) -> str:
        """A table of GitHub Markdown under a heading, the notes below."""
        shown, notes = self._visible(), self._visible_notes()
        head = [_markdown(_one_line(column.heading)) for column in shown]
        rule = [":---" if column.left else "---:" for column in shown]
        cells = cell_rows(shown, lambda cell, bold: f"**{_markdown(cell.strip())}**" if bold else _markdown(cell))
        text = [f"### {_markdown(self.title)}", "", *(f"| {' | '.join(row)} |" for row in (head, rule, *cells)), ""]
        return "\n".join([*text, *(f"- {_markdown(note)}" for note in notes), *([""] if notes else [])])

    def _repr_html_(self) -> str:
        """The table as a notebook shows it."""
        shown = self._visible()
        head = "".join(f"<th>{escape(_one_line(column.heading))}</th>" for column in shown)
        cells = cell_rows(shown, lambda cell, bold: f"<td>{f'<b>{escape(cell)}</b>' if bold else escape(cell)}</td>")
        rows = "".join(f"<tr>{''.join(row)}</tr>" for row in cells)
        notes = "".join(f"<li>{escape(note)}</li>" for note in self._visible_notes())
        table = f"<table><caption>{escape(self.title)}</caption><tr>{head}</tr>{rows}</table>"
        return table + f"<ul>{notes}</ul>" * bool(notes)

    def to_latex(self) -> str:
        """A table environment with the rules of the package booktabs; notes as comments."""
        shown = self._visible()
        head = [_latex(_one_line(column.heading)) for column in shown]
        rows = cell_rows(shown, lambda cell, bold: f"\\textbf{{{_latex(cell)}}}" if bold else _latex(cell))
        body = [f"{'{}' if row[0][:1] in ('[', '*') else ''}{' & '.join(row)} \\\\" for row in rows]  # no option of \\
        spec = "".join("l" if column.left else "r" for column in shown)
        return "\n".join(
            [
                *(r"\begin{table}", r"\centering", f"\\caption{{{_latex(self.title)}}}"),
                *(f"\\begin{{tabular}}{{{spec}}}", r"\toprule", f"{' & '.join(head)} \\\\", r"\midrule", *body),
                *(
                    r"\bottomrule",
                    r"\end{tabular}",
                    *(f"% {note}" for note in self._visible_notes()),
                    r"\end{table}",
                    "",
                ),
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
    """Tables by name; `str` gives the verdict and the main tables as text, in full all that have rows."""

    tables: Mapping[str, Table]
    details: Mapping[str, Any] = field(default_factory=dict)  # Any: JSON values
    """What JSON has besides the tables."""
    verdict: tuple[str, ...] = ()
    """Sentences that say what the tables amount to."""
    is_full: bool = False

    def in_full(self) -> "Tables":
        """The same tables, which show all of their columns and rows, and those of details."""
        return replace(self, tables={name: table.in_full() for name, table in self.tables.items()}, is_full=True)

    @property
    def has_more(self) -> bool:
        """Whether there is more than what is shown."""
        filled = [table for table in self.tables.values() if table.num_rows]
        return not self.is_full and any(table.is_detail or table.has_more for table in filled)

    def __getitem__(self, name: str) -> Table:
        return self.tables[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def __str__(self) -> str:
        parts: list[Table | Text] = [*bulleted(self.verdict, _WIDTH), *self._filled()]
        return "\n".join(map(_text, parts))

    def __repr__(self) -> str:
        filled = [name for name, table in self.items() if table.num_rows]
        return "\n".join(
            ["Tables", *(f"  {line}" for line in self.verdict[:_MOST_SENTENCES]), f"  {', '.join(filled)}"]
        )

    def _repr_html_(self) -> str:
        verdict = "".join(f"<li>{escape(printable(line))}</li>" for line in self.verdict)
        return f"<ul>{verdict}</ul>" * bool(verdict) + "".join(table._repr_html_() for table in self._filled())

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from bulleted(self.verdict, options.max_width)
        yield from self._filled()

    def to_markdown(self, name: str | None = None) -> str:
        """The table `name`, or those that are shown."""
        verdict = [] if name else [f"- {_markdown(printable(line))}" for line in self.verdict]
        lines = "\n".join([*verdict, "", ""]) if verdict else ""
        return lines + "\n".join(table.to_markdown() for table in self._filled(name))

    def to_latex(self, name: str | None = None) -> str:
        """The table `name`, or those that are shown."""
        lines = "" if name else "".join(f"% {printable(line)}\n" for line in self.verdict)
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
        if name is not None:
            return [self[name]]
        return [table for table in self.tables.values() if table.num_rows and (self.is_full or not table.is_detail)]


def _text(shown: Table | Text) -> str:
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get().removesuffix("\n")


def cell_rows(columns: Sequence[Shown], form: Callable[[str, bool], Cell]) -> Iterator[list[Cell]]:
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


def _markdown(text: str) -> str:
    """`text` without what Markdown, or HTML in it, would make of names: cells, elements, links."""
    return "".join(_MARKDOWN.get(char, char) for char in text).replace("](", r"]\(")


def _latex(text: str) -> str:
    return "".join(_LATEX.get(char, char) for char in text)


def _plain(value: Value) -> Value | None:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _csv(rows: Iterable[Sequence[Value | None]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
