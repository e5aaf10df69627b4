"""Tables: records of numbers in SI units, printed on a terminal, as Markdown, LaTeX, HTML and CSV."""

import io
import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, RenderResult
from rich.markup import escape as rich_escape
from rich.table import Table as Grid
from rich.text import Text

from fgtrack.core.cells import guarded
from fgtrack.core.errors import printable, printable_lines

Value = str | int | float
Record = Mapping[str, Any]  # Any: text, integers, floats, None
DataFrame = Any  # pandas, which is untyped and imported where it is used
NO_VALUE = "-"
PERCENT = 100.0
MS = 1e3
_WIDTH = 120  # characters of a table as text
_ANY = 10_000  # characters, more than any cell has
_LONG = 40  # characters of an HTML cell from which its lines may be broken
_MARKDOWN = str.maketrans({"\\": r"\\", "|": r"\|", "<": r"\<"})
_LATEX = str.maketrans(
    {char: f"\\{char}" for char in "&%$#_{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
    | {"±": r"$\pm$", "<": r"$<$", ">": r"$>$"}
)


def short(value: Value, digits: int = 3, most_decimals: int = 3) -> str:
    """Return `value` as text.

    A float has `digits` significant digits and at most `most_decimals` decimals; digits
    before the point are never rounded away. NaN and infinity become a dash. Integers and
    text are unchanged.
    """
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return NO_VALUE
    size = abs(float(f"{value:.{digits - 1}e}"))
    decimals = digits - 1 - math.floor(math.log10(size)) if size else most_decimals
    decimals = min(max(decimals, 0), most_decimals)
    return f"{round(value, decimals) + 0.0:.{decimals}f}"  # no negative zero


def two_digits(value: Value) -> str:
    """Return `value` as text with two significant digits and at most five decimals, see `short`."""
    text = short(value, 2, 5)
    return "0" if text == "0.00000" else text


def _yes(record: Record) -> bool:
    return True


def _no(record: Record) -> bool:
    return False


@dataclass(frozen=True)
class Column:
    """Column of a table: each cell shows one or several numbers of a record."""

    heading: str
    """Heading with the unit, in one or more lines."""
    names: str | Sequence[str] = ""
    """Keys of the numbers, as a sequence or separated by spaces; by default the heading."""
    form: str = "{}"
    """Format of the cell, with a field for each number."""
    scale: float = 1.0
    """Factor on the numbers."""
    text: Callable[[Value], str] = short
    """Function that formats a number after scaling."""
    left: bool = False
    """True for text, which is aligned left. The first columns of text name the rows."""
    is_extra: bool = False
    """True if the column is shown only in the full table."""
    bold: Callable[[Record], bool] = _no
    """Function that returns True for records whose cell is bold."""

    def cell(self, record: Record) -> str:
        """Return the text of the numbers of `record`; a dash if it has none of the numbers."""
        names = self.names or self.heading
        values = [
            record.get(name)
            for name in (names.split() if isinstance(names, str) else names)
        ]
        texts = [
            NO_VALUE
            if value is None
            else self.text(value * self.scale if isinstance(value, float) else value)
            for value in values
        ]
        return printable(
            self.form.format(*texts) if set(texts) - {NO_VALUE} else NO_VALUE
        )

    @property
    def line(self) -> str:
        """Heading in a single line."""
        return self.heading.replace("-\n", "").replace("/\n", "/").replace("\n", " ")


RUN = Column("run", left=True)


def named(name: str, moment: str) -> str:
    """Return the name of a quantity with `moment` before its unit, for instance position_rmse_m."""
    quantity, _, unit = name.rpartition("_")
    return f"{quantity}_{moment}_{unit}"


def _text(shown: object) -> str:
    console = Console(
        file=io.StringIO(), width=_WIDTH, color_system=None, force_terminal=False
    )
    with console.capture() as capture:
        console.print(shown)
    return capture.get().removesuffix("\n")


@dataclass(frozen=True)
class Table:
    """Records, and the columns that show them; `str` gives the text for a terminal with 120 columns."""

    title: str
    records: Sequence[Record]
    """Rows: numbers by name, whose end is the unit. A missing name, None and NaN are missing values."""
    columns: Sequence[Column]
    keys: Sequence[str] = ("run",)
    """Names that identify a row; the first one is the run."""
    notes: Sequence[str] = ()
    """Lines below the table."""
    is_detail: bool = False
    """True for a table that is shown only in a full comparison."""
    is_main: Callable[[Record], bool] = _yes
    """Function that is True for records which are always shown; the others are shown only in the full table."""

    __str__ = _text

    def in_full(self) -> "Table":
        """Return the table with all columns and records shown."""
        columns = [replace(column, is_extra=False) for column in self.columns]
        return Table(self.title, self.records, columns, self.keys, self.notes)

    @property
    def data(self) -> DataFrame:
        """All numbers as a pandas DataFrame."""
        import pandas as pd  # slow to load, and no command needs it

        return pd.DataFrame([dict(record) for record in self.records])

    def plain(self) -> list[dict[str, Value | None]]:
        """Return the records as JSON values; None for a missing value."""
        names = dict.fromkeys(name for record in self.records for name in record)
        return [
            {name: _plain(record.get(name)) for name in names}
            for record in self.records
        ]

    def to_csv(self) -> str:
        """Return all numbers with all digits; an empty cell for a missing value."""
        return _csv(self.plain())

    @property
    def shown(self) -> list[Column]:
        """Columns with a value that are not extra."""
        shown = [column for column in self.columns if not column.is_extra]
        return [
            column
            for column in shown
            if any(column.cell(record) != NO_VALUE for record in self.records)
        ]

    def rows(
        self, text: Callable[[str], str] = str, bold: str = "{}"
    ) -> list[list[str]]:
        """Return a row of cells for each shown record.

        `text` escapes a cell, and `bold` is the format of bold cells. A repeated first
        cell is empty.
        """
        rows = []
        shown = self.shown
        for record in filter(self.is_main, self.records):
            cells = [
                (text(column.cell(record)), column.bold(record)) for column in shown
            ]
            rows.append(
                [bold.format(cell) if is_bold else cell for cell, is_bold in cells]
            )
        for row, before in zip(rows[:0:-1], rows[-2::-1], strict=True):
            if row[0] == before[0]:
                row[0] = ""
        return rows

    def to_markdown(self) -> str:
        """Return the shown columns and records as a GitHub Markdown table, with heading and notes."""
        head = [_markdown(column.line) for column in self.shown]
        rule = [":---" if column.left else "---:" for column in self.shown]
        rows = [
            f"| {' | '.join(row)} |"
            for row in (head, rule, *self.rows(_markdown, "**{}**"))
        ]
        notes = [f"- {_markdown(note)}" for note in self.notes]
        return "\n".join(
            [
                f"### {_markdown(self.title)}",
                "",
                *rows,
                "",
                *notes,
                *([""] if notes else []),
            ]
        )

    def to_latex(self) -> str:
        """Return a LaTeX table environment with the rules of the package booktabs; notes are in the caption."""
        caption = ". ".join([self.title, *(_sentence(note) for note in self.notes)])
        rows = [
            f"{' & '.join(row)} \\\\" for row in self.rows(_latex, r"\textbf{{{}}}")
        ]
        return "\n".join(
            [
                *(
                    r"\begin{table}",
                    r"\centering",
                    f"\\caption{{{_latex(caption)}}}",
                ),
                f"\\begin{{tabular}}{{{''.join('l' if column.left else 'r' for column in self.shown)}}}",
                *(
                    r"\toprule",
                    f"{' & '.join(_latex(column.line) for column in self.shown)} \\\\",
                    r"\midrule",
                ),
                *(*rows, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""),
            ]
        )

    def to_html(self) -> str:
        """Return head and body of an HTML table with the shown columns and records."""
        head = [
            html_cell("th", escape(printable_lines(column.heading)), column.left)
            for column in self.shown
        ]
        rows = [
            "".join(
                html_cell("td", cell, column.left)
                for column, cell in zip(self.shown, row, strict=True)
            )
            for row in self.rows(escape, "<b>{}</b>")
        ]
        body = "".join(f"<tr>{row}</tr>\n" for row in rows)
        return f"<thead><tr>{''.join(head)}</tr></thead>\n<tbody>\n{body}</tbody>\n"

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> RenderResult:
        """Yield grids that fit the width; surplus columns continue in further grids below, with the row names."""
        yield Text(f"\n{printable(self.title)}")
        shown = self.shown
        rows = [
            [Text.from_markup(cell, emoji=False) for cell in row]
            for row in self.rows(rich_escape, "[bold]{}[/]")
        ]

        def grid(indices: Sequence[int]) -> Grid:
            result = Grid(
                box=SIMPLE_HEAD, show_edge=False, padding=(0, 0, 0, 1), header_style=""
            )
            for k in indices:
                left = shown[k].left
                heading = Text(printable_lines(shown[k].heading))
                justify: Any = "left" if left else "right"  # Any: rich has a Literal
                result.add_column(
                    heading,
                    justify=justify,
                    vertical="bottom",
                    no_wrap=not left,
                    overflow="fold",
                )
            for row in rows:
                result.add_row(*(row[k] for k in indices))
            return result

        sizes = [
            1 + console.measure(grid([k]), options=options.update_width(_ANY)).maximum
            for k in range(len(shown))
        ]
        num_names = next(
            (k for k, column in enumerate(shown) if not column.left), len(shown)
        )
        free = (
            options.max_width + 1 - min(sum(sizes[:num_names]), options.max_width // 2)
        )  # longer names are broken
        parts: list[list[int]] = [[]]
        for k in range(num_names, len(shown)):
            if parts[-1] and sum(sizes[each] for each in (*parts[-1], k)) > free:
                parts.append([])
            parts[-1].append(k)
        for number, part in enumerate(parts):
            if number:
                yield Text("continued:")
            yield grid([*range(num_names), *part])
        yield from (Text(printable(note)) for note in self.notes)


@dataclass(frozen=True, eq=False, repr=False)
class Tables(Mapping[str, DataFrame]):
    """Tables by name: `tables["tracking"]` is a DataFrame.

    `tables[["tracking", "lag"]]` gives a `Tables` with these two.
    """

    tables: Mapping[str, Table]
    details: Mapping[str, Any] = field(default_factory=dict)  # Any: JSON values
    """Additional JSON values."""
    verdict: tuple[str, ...] = ()
    """Sentences that summarise the tables."""

    def in_full(self) -> "Tables":
        """Return the tables, each with all columns and records shown."""
        return replace(
            self, tables={name: table.in_full() for name, table in self.tables.items()}
        )

    def __getitem__(self, name: str | list[str]) -> DataFrame:
        if isinstance(name, list):
            return Tables({each: self.tables[each].in_full() for each in name})
        return self.tables[name].data

    def __iter__(self) -> Iterator[str]:
        return iter(self.tables)

    def __len__(self) -> int:
        return len(self.tables)

    def __contains__(self, name: object) -> bool:
        return name in self.tables

    __eq__, __hash__ = object.__eq__, object.__hash__  # frames have no truth value
    __str__ = _text

    def __repr__(self) -> str:
        return "\n  ".join(["Tables", *self.verdict, ", ".join(self.tables)])

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> RenderResult:
        yield from bulleted(self.verdict, options.max_width)
        yield from self._filled()

    def _repr_html_(self) -> str:
        tables = (
            f"<table><caption>{escape(table.title)}</caption>{table.to_html()}</table>"
            for table in self._filled()
        )
        return f"<pre>{escape(printable_lines(repr(self)))}</pre>{''.join(tables)}"

    def to_markdown(self) -> str:
        """Return the verdict and the shown tables."""
        verdict = "".join(f"- {_markdown(line)}\n" for line in self.verdict)
        return f"{verdict}\n" * bool(verdict) + "\n".join(
            table.to_markdown() for table in self._filled()
        )

    def to_latex(self) -> str:
        """Return the shown tables, with the verdict as comments."""
        verdict = "".join(f"% {printable(line)}\n" for line in self.verdict)
        return verdict + "\n".join(table.to_latex() for table in self._filled())

    def to_csv(self) -> str:
        """Return each number in a row with five columns: table, run, part (sensor, lag), quantity, value."""
        rows = []
        for name, table in self.tables.items():
            for record in table.plain():
                run, part = (*(record.pop(key) for key in table.keys), "")[:2]
                head = {"table": name, "run": run, "part": part}
                rows += [
                    {**head, "quantity": quantity, "value": value}
                    for quantity, value in record.items()
                ]
        return _csv(rows)

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values: the verdict, the details, and the tables as lists of records."""
        tables = {name: table.plain() for name, table in self.tables.items()}
        return {"verdict": list(self.verdict), **self.details, "tables": tables}

    def _filled(self) -> list[Table]:
        return [
            table
            for table in self.tables.values()
            if table.records and not table.is_detail
        ]


def bulleted(sentences: Iterable[str], width: int) -> Iterator[Text]:
    """Yield the lines of `sentences`, each with a leading dash, wrapped between words."""
    for sentence in sentences:
        lines = textwrap.wrap(
            printable(sentence),
            width,
            initial_indent="- ",
            subsequent_indent="  ",
            break_on_hyphens=False,
        )
        yield from map(Text, lines)


def html_cell(tag: str, content: str, is_left: bool) -> str:
    """Return a cell of an HTML table with escaped `content`.

    A cell with long content gets the class `long`, so that its lines may be broken.
    """
    kind = " ".join(["left"] * is_left + ["long"] * (len(content) > _LONG))
    lines = content.replace("\n", "<br>")
    return (
        f'<{tag} class="{kind}">{lines}</{tag}>' if kind else f"<{tag}>{lines}</{tag}>"
    )


def _csv(records: Sequence[Record]) -> str:
    import pandas as pd

    cells = [
        {
            name: guarded(value) if isinstance(value, str) else value
            for name, value in record.items()
        }
        for record in records
    ]
    text: str = pd.DataFrame(cells, dtype=object).to_csv(
        index=False, lineterminator="\n"
    )
    return text


def _markdown(text: str) -> str:
    """Return `text` with all characters escaped that Markdown or HTML would interpret."""
    return printable(text).translate(_MARKDOWN).replace("](", r"]\(")


def _sentence(note: str) -> str:
    """Return `note` with a capital first letter, unless it begins with a name in code."""
    return note if note[:1] == "`" else note[:1].upper() + note[1:]


def _latex(text: str) -> str:
    return printable(text).translate(_LATEX)


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
