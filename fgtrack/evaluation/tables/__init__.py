"""Tables: records of numbers in SI units, and how people read them on a terminal, in Markdown and in LaTeX."""

import csv
import io
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any, Literal, TypeVar, overload

from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderResult
from rich.table import Table as Grid
from rich.text import Text

from fgtrack.core.errors import printable, printable_lines

Value = str | int | float
Record = Mapping[str, Any]  # Any: text, integers, floats, None
Cell = TypeVar("Cell")
DataFrame = Any  # pandas, which is untyped and imported where it is used

NO_VALUE = "-"
PERCENT = 100.0
MS = 1e3

_WIDTH = 120  # of a table as text
_LONG = 40  # characters of a cell that may be broken
_MOST_SENTENCES = 10  # of the verdict in a repr
_MARKDOWN = {"\\": r"\\", "|": r"\|", "<": r"\<"}
_LATEX = {char: f"\\{char}" for char in "&%$#_{}"} | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {"\\": r"\textbackslash{}", "±": r"$\pm$", "<": r"$<$", ">": r"$>$"}
_QUANTITY = re.compile(r"(\d) (%|mm?|m/s|rad|s)(?=\W|$)")


def short(value: Value, digits: int = 3, most_decimals: int = 3) -> str:
    """`value` with three significant digits, integers and text in full; a dash for NaN."""
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return NO_VALUE
    size = abs(float(f"{value:.{digits - 1}e}"))
    decimals = digits - 1 - math.floor(math.log10(size)) if size else most_decimals
    decimals = min(max(decimals, 0), most_decimals)
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # no negative zero


def two_digits(value: Value) -> str:
    """`value` with two significant digits and at most five decimals, integers in full; a dash for NaN."""
    text = short(value, 2, 5)
    return "0" if text == "0.00000" else text


@dataclass(frozen=True)
class Column:
    """One or several numbers of every record, in one cell.

    Attributes
    ----------
    heading
        Lines, with the unit.
    names
        Keys of the numbers, separated by spaces; by default the heading.
    form
        How their texts become the cell.
    scale
        What is shown is as many times the number.
    text
        The text of a number.
    left
        True for text, which is aligned left. The leading columns of text name the rows.
    when
        `few`: unless the table is shown in full; `full`: only then.
    bold
        True for the records whose cell is bold.
    note
        A line below the table where the column is shown.
    cell_of
        The cell of a record, instead of all this.
    """

    heading: str
    names: str = ""
    form: str = "{}"
    scale: float = 1.0
    text: Callable[[Value], str] = short
    left: bool = False
    when: Literal["always", "few", "full"] = "always"
    bold: Callable[[Record], bool] = lambda record: False
    note: str = ""
    cell_of: Callable[[Record], str] | None = None

    def cell(self, record: Record) -> str:
        """Text of the numbers of `record`; a dash where none is known."""
        if self.cell_of is not None:
            return self.cell_of(record)
        values = [record.get(name) for name in (self.names or self.heading).split()]
        texts = [
            NO_VALUE if value is None else self.text(value * self.scale if isinstance(value, float) else value)
            for value in values
        ]
        return self.form.format(*texts) if set(texts) - {NO_VALUE} else NO_VALUE


RUN = Column("run", left=True)


def named(name: str, moment: str) -> str:
    """`name` of a quantity with the `moment` before its unit: position_rmse_m."""
    quantity, _, unit = name.rpartition("_")
    return f"{quantity}_{moment}_{unit}"


@dataclass(frozen=True)
class Shown:
    """A column as text."""

    heading: str
    cells: Sequence[str]
    bold: Sequence[bool]
    left: bool


@dataclass(frozen=True)
class Table:
    """Records and the columns that show them; `str` gives the text of a terminal of 120 columns.

    Attributes
    ----------
    title
        Caption.
    records
        Rows: numbers by name with their units; a name that is missing, None and NaN are no value.
    columns
        What is shown.
    keys
        Names that identify a row; the first is the run.
    notes
        Lines below the table.
    is_detail
        True for a table that is shown only where a comparison is shown in full.
    is_main
        True for the records that are shown unless the table is shown in full.
    is_full
        True if all columns and records are shown.
    """

    title: str
    records: Sequence[Record]
    columns: Sequence[Column]
    keys: Sequence[str] = ("run",)
    notes: Sequence[str] = ()
    is_detail: bool = False
    is_main: Callable[[Record], bool] = lambda record: True
    is_full: bool = False

    def in_full(self) -> "Table":
        """The same table with all columns and records shown."""
        return replace(self, is_full=True)

    @property
    def has_more(self) -> bool:
        """True if there is more than what is shown."""
        hidden = any(column.when == "full" for column in self.columns) or not all(map(self.is_main, self.records))
        return hidden and not self.is_full

    @property
    def names(self) -> list[str]:
        """Names of all numbers."""
        return list(dict.fromkeys(name for record in self.records for name in record))

    @property
    def data(self) -> DataFrame:
        """All numbers as a pandas DataFrame."""
        import pandas as pd  # slow to load, and no command needs it

        return pd.DataFrame([dict(record) for record in self.records], columns=self.names)

    def plain(self) -> list[dict[str, Value | None]]:
        """Records as JSON values: None where there is no value."""
        return [{name: _plain(record.get(name)) for name in self.names} for record in self.records]

    def to_csv(self) -> str:
        """All numbers with all digits; an empty cell where there is no value."""
        return csv_text([self.names, *(record.values() for record in self.plain())])

    def to_markdown(self) -> str:
        """Shown columns and records as a table of GitHub Markdown under a heading, the notes below."""
        shown = self.shown()
        head = [_markdown(_one_line(column.heading)) for column in shown]
        rows = _rows(shown, lambda cell, bold: f"**{_markdown(cell.strip())}**" if bold else _markdown(cell))
        rule = [":---" if column.left else "---:" for column in shown]
        lines = [
            f"### {_markdown(printable(self.title))}",
            "",
            *(f"| {' | '.join(row)} |" for row in (head, rule, *rows)),
            "",
        ]
        return "\n".join(
            [*lines, *(f"- {_markdown(note)}" for note in self.shown_notes()), *([""] if self.shown_notes() else [])]
        )

    def to_latex(self) -> str:
        """Shown columns and records as a table environment with the rules of package booktabs; notes as comments."""
        shown = self.shown()
        head = [_latex(_one_line(column.heading)) for column in shown]
        rows = _rows(shown, lambda cell, bold: f"\\textbf{{{_latex(cell)}}}" if bold else _latex(cell))
        body = [f"{'{}' if row[0][:1] in ('[', '*') else ''}{' & '.join(row)} \\\\" for row in rows]  # no option of \\
        spec = "".join("l" if column.left else "r" for column in shown)
        begin = [r"\begin{table}", r"\centering", f"\\caption{{{_latex(printable(self.title))}}}"]
        begin += [f"\\begin{{tabular}}{{{spec}}}", r"\toprule", f"{' & '.join(head)} \\\\", r"\midrule"]
        end = [r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in self.shown_notes()), r"\end{table}", ""]
        return "\n".join([*begin, *body, *end])

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{escape(note)}</li>" for note in self.shown_notes())
        caption = f"<caption>{escape(printable(self.title))}</caption>"
        return f"<table>{caption}{self.to_html()}</table>" + f"<ul>{notes}</ul>" * bool(notes)

    def to_html(self) -> str:
        """Head and body of an HTML table of the shown columns and records."""
        shown = self.shown()
        head = [html_cell("th", column.heading, column.left) for column in shown]
        lines = []
        for row in _rows(shown, lambda cell, bold: (cell, bold)):
            cells = (html_cell("td", cell, one.left, bold) for one, (cell, bold) in zip(shown, row, strict=True))
            lines.append(f"<tr>{''.join(cells)}</tr>\n")
        return f"<thead><tr>{''.join(head)}</tr></thead>\n<tbody>\n{''.join(lines)}</tbody>\n"

    def __str__(self) -> str:
        return _text(self)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(f"\n{printable(self.title)}")
        yield from _grids(self.shown(), options.max_width)
        yield from map(Text, self.shown_notes())

    def _visible(self) -> list[Column]:
        return [column for column in self.columns if column.when != ("few" if self.is_full else "full")]

    def shown(self) -> list[Shown]:
        """The columns as text."""
        records = [record for record in self.records if self.is_full or self.is_main(record)]
        return [
            Shown(
                printable_lines(column.heading),
                [printable(column.cell(record)) for record in records],
                [column.bold(record) for record in records],
                column.left,
            )
            for column in self._visible()
        ]

    def shown_notes(self) -> list[str]:
        """Notes of the columns that are shown, and of the table."""
        of_columns = (column.note for column in self._visible() if column.note)
        return list(dict.fromkeys(map(printable, (*of_columns, *self.notes))))


@dataclass(frozen=True, eq=False, repr=False)
class Tables(Mapping[str, DataFrame]):
    """Tables by name: `tables["tracking"]` is a pandas DataFrame, `tables[["tracking", "lag"]]` are two of the tables.

    `str` gives the verdict and the main tables as text, in full all that have rows.

    Attributes
    ----------
    tables
        By name, each with its `data` and the columns that show it.
    details
        JSON values beside the tables.
    verdict
        Sentences that summarise the tables.
    is_full
        True if all tables are shown, with all columns and records.
    """

    tables: Mapping[str, Table]
    details: Mapping[str, Any] = field(default_factory=dict)  # Any: JSON values
    verdict: tuple[str, ...] = ()
    is_full: bool = False

    def in_full(self) -> "Tables":
        """The same tables, all of them shown with all columns and records."""
        return replace(self, tables={name: table.in_full() for name, table in self.tables.items()}, is_full=True)

    @property
    def has_more(self) -> bool:
        """True if there is more than what is shown."""
        filled = [table for table in self.tables.values() if table.records]
        return not self.is_full and any(table.is_detail or table.has_more for table in filled)

    @overload
    def __getitem__(self, name: str) -> DataFrame: ...

    @overload
    def __getitem__(self, name: list[str]) -> "Tables": ...

    def __getitem__(self, name: str | list[str]) -> DataFrame:
        if isinstance(name, list):
            return Tables({one: self.tables[one].in_full() for one in name}, is_full=True)
        return self.tables[name].data

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def __str__(self) -> str:
        return _text(self)

    def __repr__(self) -> str:
        lines = [
            "Tables",
            *self.verdict[:_MOST_SENTENCES],
            ", ".join(k for k, table in self.tables.items() if table.records),
        ]
        return "\n  ".join(lines)

    def _repr_html_(self) -> str:
        verdict = "".join(f"<li>{escape(printable(line))}</li>" for line in self.verdict)
        return f"<ul>{verdict}</ul>" * bool(verdict) + "".join(table._repr_html_() for table in self._filled())

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield from bulleted(self.verdict, options.max_width)
        yield from self._filled()

    def to_markdown(self) -> str:
        """Verdict and tables, as far as they are shown."""
        verdict = "".join(f"- {_markdown(printable(line))}\n" for line in self.verdict)
        return f"{verdict}\n" * bool(verdict) + "\n".join(table.to_markdown() for table in self._filled())

    def to_latex(self) -> str:
        """Tables, as far as they are shown, the verdict as comments."""
        verdict = "".join(f"% {printable(line)}\n" for line in self.verdict)
        return verdict + "\n".join(table.to_latex() for table in self._filled())

    def to_csv(self) -> str:
        """All numbers, one in a row of five columns: table, run, part (sensor, lag), quantity, value."""
        rows: list[Sequence[Value | None]] = [("table", "run", "part", "quantity", "value")]
        for name, table in self.tables.items():
            for record in table.plain():
                run, *part = (record[key] for key in table.keys)
                rows += [(name, run, *(part or [""]), k, v) for k, v in record.items() if k not in table.keys]
        return csv_text(rows)

    def to_dict(self) -> dict[str, Any]:
        """JSON values: the verdict, the details, and the tables as lists of records."""
        tables = {name: table.plain() for name, table in self.tables.items()}
        return {"verdict": list(self.verdict), **self.details, "tables": tables}

    def _filled(self) -> list[Table]:
        return [table for table in self.tables.values() if table.records and (self.is_full or not table.is_detail)]


def bulleted(sentences: Iterable[str], width: int) -> Iterator[Text]:
    """Sentences, each behind a dash, wrapped between words; a number and its unit stay together."""
    for sentence in sentences:
        kept = _QUANTITY.sub("\\1\u00a0\\2", printable(sentence))
        for line in textwrap.wrap(kept, width, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False):
            yield Text(line.replace("\u00a0", " "))


def _text(shown: Table | Tables) -> str:
    console = Console(file=io.StringIO(), width=_WIDTH, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(shown)
    return capture.get().removesuffix("\n")


def html_cell(tag: str, text: str, is_left: bool, is_bold: bool = False) -> str:
    """A cell of an HTML table; of class `long` where it may be broken."""
    content = escape(text).replace("\n", "<br>")
    kinds = " ".join(name for name, has in (("left", is_left), ("long", len(text) > _LONG)) if has)
    kind = f' class="{kinds}"' if kinds else ""
    return f"<{tag}{kind}>{f'<b>{content}</b>' if is_bold else content}</{tag}>"


def _rows(shown: Sequence[Shown], form: Callable[[str, bool], Cell]) -> Iterator[list[Cell]]:
    """Rows in a `form` of text and whether it is bold; the first cell only where it changes."""
    for k, first in enumerate(shown[0].cells):
        repeated = k > 0 and shown[0].cells[k - 1] == first
        yield [form("" if repeated and column is shown[0] else column.cells[k], column.bold[k]) for column in shown]


def _one_line(heading: str) -> str:
    return heading.replace("-\n", "").replace("/\n", "/").replace("\n", " ")


def _grids(shown: Sequence[Shown], width: int) -> Iterator[Grid | Text]:
    """Tables of at most `width`: columns without room beside the names stand in further ones below, with the names.

    Names that take more than half of the width are broken.
    """
    widths = [2 + max(map(cell_len, (*one.heading.split("\n"), *one.cells))) for one in shown]
    num_names = next((k for k, one in enumerate(shown) if not one.left), len(shown))
    parts, free = [list(range(num_names))], width + 1 - min(sum(widths[:num_names]), width // 2)
    for k in range(num_names, len(shown)):
        used = sum(widths[each] for each in parts[-1][num_names:])
        if used and used + widths[k] > free:
            parts.append(list(range(num_names)))
        parts[-1].append(k)
    rows = list(_rows(shown, lambda cell, bold: Text(cell, "bold" if bold else "")))
    for part in parts:
        if part is not parts[0]:
            yield Text("continued:")
        grid = Grid(box=SIMPLE_HEAD, show_edge=False, padding=(0, 0, 0, 1), header_style="")
        for k in part:
            justify: Literal["left", "right"] = "left" if shown[k].left else "right"
            heading = Text(shown[k].heading)
            grid.add_column(heading, justify=justify, vertical="bottom", no_wrap=not shown[k].left, overflow="fold")
        for row in rows:
            grid.add_row(*(row[k] for k in part))
        yield grid


def _markdown(text: str) -> str:
    """`text` without what Markdown, or HTML in it, would make of names: cells, elements, links."""
    return "".join(_MARKDOWN.get(char, char) for char in text).replace("](", r"]\(")


def _latex(text: str) -> str:
    return "".join(_LATEX.get(char, char) for char in text)


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def csv_text(rows: Iterable[Iterable[Value | None]]) -> str:
    """Rows as CSV; None and NaN are empty cells."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(map(_plain, row) for row in rows)
    return text.getvalue()
