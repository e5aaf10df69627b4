"""How figures look, and how they are saved: the same bytes every time, whatever the user's own settings."""

import base64
import io
import math
import os
import re
import textwrap
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from pathlib import Path
from typing import Any, BinaryIO, ParamSpec, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure, SubFigure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image

from fgtrack.core.errors import CallError, printable_lines
from fgtrack.core.files import open_file, read_head
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.palette import PALETTE as PALETTE
from fgtrack.io.output import Kind

WRONG = "#000000"
GREY = "#777777"

_PAUSE_STEPS = 3  # a line is not drawn across a pause that is longer than as many usual steps

_LINES = ("-", "--", ":", "-.")

_TITLE_CHARACTERS_PER_IN = 10  # of a title; a legend has more, its letters are smaller
_LEGEND_CHARACTERS_PER_IN = 13
_MOST_ENTRIES = 12  # of a legend
_HANDLE = 6  # characters that the line before an entry and the space around it take
_FREE_LINES = 2  # of a legend for which figures have room
_LINE_IN = 0.17  # height of a line of text

# The defaults of matplotlib, not those of a file in the home folder; backends are not a matter of style.
_STYLE = {
    **{key: value for key, value in mpl.rcParamsDefault.items() if "backend" not in key},
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.framealpha": 0.9,
    "figure.titlesize": 11,
    "figure.constrained_layout.use": True,
    "figure.dpi": 100,
    "savefig.dpi": 150,
    "text.parse_math": False,
    "path.simplify": True,
    "agg.path.chunksize": 20_000,
    "svg.hashsalt": "fgtrack",
}

_MARK = "fgtrack figure"
#: Formats of files, with who made them and without what would differ from one writing to the next.
FORMATS: Mapping[str, Mapping[str, str | None]] = {
    "png": {"Creator": _MARK, "Software": None},
    "svg": {"Creator": _MARK, "Date": None},
    "pdf": {"Creator": _MARK, "CreationDate": None, "Producer": None},
}


#: How the files begin, with the place where that stands.
_BEGINNINGS = (
    rb"\x89PNG\r\n\x1a\n.{0,500}?tEXtCreator\0%b" % _MARK.encode(),
    rb"<\?xml .{0,1500}?<dc:creator>\s*<cc:Agent>\s*<dc:title>%b</dc:title>" % _MARK.encode(),
)
_HEAD = 3000
_PDF_END = re.compile(rb"startxref\s+(\d+)\s+%%EOF\s*$")
_PDF_INFO = b"<< /Creator (%b) >>\nendobj\n" % _MARK.encode()  # before the table that the end points to


def _is_drawn(path: Path) -> bool:
    head = read_head(path, _HEAD)
    if head.startswith(b"%PDF-"):
        return _is_drawn_pdf(path)
    return any(re.match(beginning, head, re.DOTALL) for beginning in _BEGINNINGS)


def _is_drawn_pdf(path: Path) -> bool:
    with open_file(path) as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - _HEAD))
        end = _PDF_END.search(file.read())
        place = -1 if end is None else int(end[1]) - len(_PDF_INFO)
        if not 0 <= place < size:
            return False
        file.seek(place)
        return file.read(len(_PDF_INFO)) == _PDF_INFO


#: A picture, or a PDF of several.
DRAWN = Kind("a figure of fgtrack", _is_drawn)

P = ParamSpec("P")
T = TypeVar("T")


class StyledFigure(Figure):
    """A figure with the style of fgtrack, whatever the user's settings are when it is drawn; notebooks show it."""

    def draw(self, renderer: Any) -> None:  # Any: matplotlib does not export the type
        """Draw it, see `matplotlib.figure.Figure.draw`; what is no letter or sign, in a name out of a file, escaped."""
        for text in self.findobj(Text):
            text.set_text(printable_lines(text.get_text()))
        with mpl.rc_context(_STYLE), warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing")  # of a script that the font lacks: an empty box
            super().draw(renderer)

    def _repr_html_(self) -> str:
        picture = io.BytesIO()
        self.savefig(picture, format="png")
        return f'<img src="data:image/png;base64,{base64.b64encode(picture.getvalue()).decode()}">'


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """`function` run with the style of fgtrack; settings are as before afterwards."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with mpl.rc_context(_STYLE):
            return function(*args, **kwargs)

    return run


def colour(index: int) -> str:
    """Colour of the entry `index` of a legend."""
    return PALETTE[index % len(PALETTE)]


def line_style(index: int) -> str:
    """Line style of the entry `index`: it changes when the colours repeat."""
    return _LINES[index // len(PALETTE) % len(_LINES)]


def title(figure: Figure, text: str) -> None:
    """Write `text` above `figure`, broken into lines that are no wider than it."""
    width = int(_TITLE_CHARACTERS_PER_IN * figure.get_figwidth())
    lines = [line for part in text.split("\n") for line in textwrap.wrap(part, width)]
    figure.suptitle("\n".join(lines))
    _grow(figure, _LINE_IN * (len(lines) - 1))


def titled(label: str, what: str) -> str:
    """Title of a figure that shows `what` of the run `label`, or of all runs where that is empty."""
    return f"{label}: {what}" if label else what[0].upper() + what[1:]


def legend_above(axes: Axes, width_in: float) -> None:
    """Legend above a plot that is `width_in` wide, where it hides nothing; of many entries the first."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    more = len(labels) - _MOST_ENTRIES
    if more > 1:
        handles, labels = handles[:_MOST_ENTRIES], [*labels[: _MOST_ENTRIES - 1], f"{labels[_MOST_ENTRIES - 1]} ..."]
        labels[-1] += f" and {more} more"
    width = int(_LEGEND_CHARACTERS_PER_IN * width_in)
    broken = [textwrap.wrap(label, width - _HANDLE) for label in labels]
    columns = max(1, width // (_HANDLE + max(len(line) for lines in broken for line in lines)))
    labels = ["\n".join(lines) for lines in broken]
    _grow(axes.figure, _LINE_IN * (math.ceil(sum(map(len, broken)) / columns) - _FREE_LINES))
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        frameon=False,
        borderaxespad=0.2,
        markerscale=3.0,
    )


def _grow(figure: Figure | SubFigure, more_in: float) -> None:
    """Make `figure` higher, so that what is written above its plots takes nothing from them."""
    if more_in > 0.0 and isinstance(figure, Figure):
        figure.set_figheight(figure.get_figheight() + more_in)


def log_axis(axis: Axis) -> None:
    """Plain numbers at 1, 2 and 5 of every decade of a logarithmic `axis`."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def usual_step_ns(stamps_ns: IntArray) -> float:
    """Median step between distinct stamps; infinite where there is only one."""
    steps_ns = np.diff(np.unique(stamps_ns))
    return float(np.median(steps_ns)) if len(steps_ns) else math.inf


def broken_line(stamps_ns: IntArray, x: FloatArray, y: FloatArray, step_ns: float) -> tuple[FloatArray, FloatArray]:
    """Points in order of time, usually `step_ns` apart, with a NaN in every pause, so that no line is drawn there."""
    order = np.argsort(stamps_ns, kind="stable")
    pauses = np.flatnonzero(np.diff(stamps_ns[order]) > _PAUSE_STEPS * step_ns) + 1
    return np.insert(x[order], pauses, np.nan), np.insert(y[order], pauses, np.nan)


@styled
def save_pages(figures: Iterable[Figure], file: BinaryIO) -> None:
    """Write `figures` as the pages of one PDF, without date and version."""
    with PdfPages(file, metadata=dict(FORMATS["pdf"])) as pages:
        for figure in figures:
            pages.savefig(figure)


@styled
def png(figure: Figure, dpi: float) -> bytes:
    """`figure` as a small PNG of 256 colours, without date and version."""
    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi, metadata=dict(FORMATS["png"]))
    with Image.open(drawn) as picture:
        picture.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)
    return small.getvalue()


@styled
def save(figure: Figure, path: Path | str) -> Path:
    """Write `figure` as PNG, SVG or PDF, as the suffix says, without date and version: equal figures, equal files.

    Raises
    ------
    CallError
        The suffix is none of these, or the file cannot be written.
    """
    path = Path(path)
    form = path.suffix.lower().removeprefix(".")
    if form not in FORMATS:
        raise CallError(f"{path}: no format of a figure, end the name with .{', .'.join(FORMATS)}")
    try:
        figure.savefig(path, format=form, metadata=dict(FORMATS[form]))
    except OSError as error:
        raise CallError(f"{path}: cannot be written ({error.strerror}), choose another folder") from error
    return path
