"""Style of figures and of their files. Equal figures give equal bytes."""

import base64
import io
import math
import textwrap
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image

from fgtrack.core.errors import printable_lines
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.show.palette import CurveStyle, styles

_RC: Any = mpl.rcParams  # Any: its keys are a Literal of all names
WRONG = "#000000"
GREY = "#777777"
# A line is interrupted at a pause of more than this number of usual steps.
_PAUSE_STEPS = 3
# Width of a letter and height of a text line, in units of the font size.
LETTER = 0.58
_LINE = 1.5
# Largest number of entries of a legend.
_MOST_ENTRIES = 12
# Width of the line before a legend entry and of its margins, in characters.
_HANDLE = 8
# Width of the labels of an axis, in inches.
_BESIDE_IN = 0.6
# Number of legend lines that fit without a higher figure.
_FREE_LINES = 2
# Values within this number of interquartile ranges from the quartiles belong to the bulk.
_BEYOND = 3.0
_MARGIN = 0.05
_MARK = "fgtrack figure"
#: Metadata of files by format: the creator, but no date or version, so that equal figures give equal files.
FORMATS: Mapping[str, Mapping[str, str | None]] = {
    "png": {"Creator": _MARK, "Software": None},
    "svg": {"Creator": _MARK, "Date": None},
    "pdf": {"Creator": _MARK, "CreationDate": None, "Producer": None},
}


class StyledFigure(Figure):
    """Figure that keeps the settings of its creation."""

    def __init__(self, figsize: tuple[float, float]) -> None:
        super().__init__(figsize=figsize)
        self._settings: Any = {
            key: value for key, value in _RC.items() if "backend" not in key
        }

    def draw(self, renderer: Any) -> None:  # Any: matplotlib does not export the type
        """Draw the figure, see `matplotlib.figure.Figure.draw`; control characters in texts are escaped."""
        for text in self.findobj(Text):
            text.set_text(printable_lines(text.get_text()))
        with mpl.rc_context(self._settings), warnings.catch_warnings():
            # A missing character is drawn as an empty box.
            warnings.filterwarnings("ignore", "Glyph .* missing")
            super().draw(renderer)

    def savefig(self, *args: Any, **kwargs: Any) -> None:  # Any: those of matplotlib
        """Write the figure, see `matplotlib.figure.Figure.savefig`."""
        with mpl.rc_context(self._settings):
            super().savefig(*args, **kwargs)

    def _repr_html_(self) -> str:
        return (
            f'<img src="data:image/png;base64,{base64.b64encode(png(self)).decode()}">'
        )


def run_styles(runs: Sequence[EvaluatedRun]) -> dict[str, CurveStyle]:
    """Return the curve style of each run by label, in the colour of its estimator."""
    result = styles(
        [str(item.run.meta.get("estimator") or item.label) for item in runs]
    )
    return {item.label: each for item, each in zip(runs, result, strict=True)}


def legend_above(axes: Axes, share: float = 1.0, markerscale: float = 1.0) -> None:
    """Draw a legend above a plot, with at most twelve entries.

    Its width is `share` of the figure's width. `markerscale` enlarges small markers.
    """
    handles, labels = axes.get_legend_handles_labels()
    figure = axes.get_figure(root=True)
    if not handles or figure is None:
        return
    more = len(labels) - _MOST_ENTRIES
    if more > 1:
        handles = handles[:_MOST_ENTRIES]
        labels = labels[:_MOST_ENTRIES]
        labels[-1] += f" ... and {more} more"
    letters = (share * figure.get_figwidth() - _BESIDE_IN) / (
        LETTER * size_in("legend.fontsize")
    )
    width = max(_HANDLE + 10, int(letters))
    broken = [textwrap.wrap(label, width - _HANDLE) for label in labels]
    columns = max(
        1, width // (_HANDLE + max(len(line) for lines in broken for line in lines))
    )
    axes.legend(
        handles,
        ["\n".join(lines) for lines in broken],
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        frameon=False,
        borderaxespad=0.2,
        markerscale=markerscale,
        columnspacing=1.2,
        handlelength=1.8,
    )
    if isinstance(figure, StyledFigure):
        grow(
            figure,
            "legend.fontsize",
            math.ceil(sum(map(len, broken)) / columns) - _FREE_LINES,
        )


def size_in(name: str) -> float:
    """Return the text size of the setting `name`, in inches."""
    return float(FontProperties(size=_RC[name]).get_size_in_points()) / 72.0


def grow(figure: Figure, name: str, lines: int) -> None:
    """Increase the height of `figure` by `lines` text lines of the setting `name`."""
    figure.set_figheight(figure.get_figheight() + max(0, lines) * _LINE * size_in(name))


def log_axis(axis: Axis) -> None:
    """Set plain numbers as ticks at 1, 2 and 5 of every decade of a logarithmic `axis`."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def usual_step_ns(stamps_ns: IntArray) -> float:
    """Median step between distinct stamps; infinity for a single stamp."""
    steps_ns = np.diff(np.unique(stamps_ns))
    return float(np.median(steps_ns)) if len(steps_ns) else math.inf


def broken_line(
    stamps_ns: IntArray, x: FloatArray, y: FloatArray, step_ns: float
) -> tuple[FloatArray, FloatArray]:
    """Return points in order of time, with a NaN in every pause, so that the line is interrupted there.

    `step_ns` is the usual step between points.
    """
    order = np.argsort(stamps_ns, kind="stable")
    pauses = np.flatnonzero(np.diff(stamps_ns[order]) > _PAUSE_STEPS * step_ns) + 1
    return np.insert(x[order], pauses, np.nan), np.insert(y[order], pauses, np.nan)


def bulk(
    samples: Iterable[FloatArray], required: Iterable[FloatArray] = ()
) -> tuple[float, float]:
    """Return a range with a margin that covers the bulk of `samples`, and all of `required`.

    (0, 1) without finite values.
    """
    lows = []
    highs = []
    for values, is_required in (
        *((each, False) for each in samples),
        *((each, True) for each in required),
    ):
        known = values[np.isfinite(values)]
        if len(known):
            first, third = np.quantile(known, (0.25, 0.75)).tolist()
            reach = np.inf if is_required else _BEYOND * (third - first)
            lows.append(max(float(known.min()), first - reach))
            highs.append(min(float(known.max()), third + reach))
    if not lows:
        return 0.0, 1.0
    low = min(lows)
    high = max(highs)
    # The least margin keeps histogram bins distinct.
    margin = max(_MARGIN * (high - low), 1e-6, 1e-9 * max(abs(low), abs(high)))
    return low - margin, high + margin


def save_pages(figures: Iterable[Figure], file: BinaryIO) -> None:
    """Write `figures` as pages of a PDF, without date and version."""
    from matplotlib.backends.backend_pdf import PdfPages

    with PdfPages(file, metadata=dict(FORMATS["pdf"])) as pages:
        for figure in figures:
            pages.savefig(figure)


def png(figure: Figure, dpi: float = 150.0) -> bytes:
    """Return `figure` as a small PNG with 256 colours, without date and version."""
    full = io.BytesIO()
    small = io.BytesIO()
    figure.savefig(full, format="png", dpi=dpi)
    picture = Image.open(full).convert("RGB")
    picture.quantize(
        256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
    ).save(small, "PNG")
    return small.getvalue()


def save(figure: Figure, path: Path) -> Path:
    """Write `figure` as PNG, SVG or PDF, by the suffix of `path`, without date and version; return `path`."""
    figure.savefig(path, metadata=dict(FORMATS[path.suffix.removeprefix(".")]))
    return path
