"""Style of figures and of their files. Equal figures give equal bytes."""

import base64
import io
import logging
import math
import textwrap
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
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
# The same, and the left edge in the axes, for a figure in a column of a page.
_NARROW_HANDLE = 6
_NARROW_LEFT = -0.12
_NARROW_IN = 5.0
# Width of the labels of an axis, in inches.
_BESIDE_IN = 0.6
# Number of legend lines that fit without a higher figure.
_FREE_LINES = 2
# Values within this number of interquartile ranges from the quartiles belong to the bulk.
_BEYOND = 3.0
# Ratio of the ends of a logarithmic axis above which it has one tick in a decade.
_LONG_AXIS = 1e3
# Width of a map above which its axes are in kilometres.
_WIDE_M = 20e3
_MARGIN = 0.05
# Comments of an EPS file that differ from run to run.
_DATES = (b"%%CreationDate", b"%%Title", b"%%Creator")
_MARK = "fgtrack figure"
#: Metadata of files by format: the creator, but no date or version, so that equal figures give equal files.
FORMATS: Mapping[str, Mapping[str, str | None]] = {
    "png": {"Creator": _MARK, "Software": None},
    "svg": {"Creator": _MARK, "Date": None},
    "pdf": {"Creator": _MARK, "CreationDate": None, "Producer": None},
    "eps": {"Creator": _MARK},
}


class StyledFigure(Figure):
    """Figure that keeps the settings of its creation."""

    def __init__(self, figsize: tuple[float, float]) -> None:
        super().__init__(figsize=figsize)
        self.caption = ""
        """Caption: what is drawn, over how many seeds, with which interval."""
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
    is_narrow = share * figure.get_figwidth() < _NARROW_IN
    handle = _NARROW_HANDLE if is_narrow else _HANDLE
    beside_in = 0.0 if is_narrow else _BESIDE_IN
    letters = (share * figure.get_figwidth() - beside_in) / (
        LETTER * size_in("legend.fontsize")
    )
    width = max(handle + 10, int(letters))
    broken = [textwrap.wrap(label, width - handle) for label in labels]
    columns = _columns([handle + max(map(len, lines)) for lines in broken], width)
    axes.legend(
        handles,
        ["\n".join(lines) for lines in broken],
        loc="lower left",
        bbox_to_anchor=(_NARROW_LEFT if is_narrow else 0.0, 1.0),
        ncols=columns,
        frameon=False,
        borderaxespad=0.2,
        markerscale=markerscale,
        columnspacing=0.8 if is_narrow else 1.2,
        handlelength=1.8,
        handletextpad=0.4 if is_narrow else None,
    )
    if isinstance(figure, StyledFigure):
        grow(
            figure,
            "legend.fontsize",
            math.ceil(sum(map(len, broken)) / columns) - _FREE_LINES,
        )


def _columns(widths: Sequence[int], width: int) -> int:
    """Return the largest number of columns in which entries of the given `widths` fit into `width`.

    As in matplotlib, entries fill one column after the other.
    """
    for columns in range(len(widths), 1, -1):
        long, more = divmod(len(widths), columns)
        sizes = [long + (k < more) for k in range(columns)]
        starts = [sum(sizes[:k]) for k in range(columns)]
        parts = [widths[a : a + n] for a, n in zip(starts, sizes, strict=True)]
        if sum(map(max, parts)) <= width:
            return columns
    return 1


def legend_at_ends(axes: Axes, breaks: bool = False) -> None:
    """Write the label of each line beside its right end, in the colour of the line.

    Labels are moved apart so that they do not overlap. With `breaks`, a label has a line
    break after its comma. A plot whose lines have no values gets no labels.
    """
    handles, labels = axes.get_legend_handles_labels()
    figure = axes.get_figure(root=True)
    lines = [getattr(handle, "lines", [handle])[0] for handle in handles]
    ends = [
        (line, label, float(line.get_xdata()[-1]), float(line.get_ydata()[-1]))
        for line, label in zip(lines, labels, strict=True)
        if len(line.get_ydata())
    ]
    if not ends or figure is None:
        return
    if breaks:
        ends = [(line, text.replace(", ", ",\n"), x, y) for line, text, x, y in ends]
    figure.draw_without_rendering()
    points = axes.transData.transform([(x, y) for _, _, x, y in ends])
    heights = axes.transAxes.inverted().transform(points)[:, 1]
    box = axes.get_window_extent()
    lines_a_label = 1 + max(text.count("\n") for _, text, _, _ in ends)
    step = lines_a_label * _LINE * size_in("legend.fontsize") * figure.dpi / box.height
    for k, height in zip(
        np.argsort(heights), _apart(np.sort(heights), step), strict=True
    ):
        line, label, _, _ = ends[k]
        axes.annotate(
            label,
            (1.0, height),
            xycoords="axes fraction",
            xytext=(4.0, 0.0),
            textcoords="offset points",
            va="center",
            linespacing=1.0,
            fontsize=72.0 * size_in("legend.fontsize"),
            color=line.get_color(),
            annotation_clip=False,
        )


def _apart(heights: FloatArray, step: float) -> FloatArray:
    """Return ascending `heights`, shape (n,), moved apart to at least `step`, each as little as possible.

    Groups of labels that touch are spread about their common mean.
    """
    groups: list[list[float]] = []
    for height in heights.tolist():
        groups.append([height])
        while len(groups) > 1 and _lowest(groups[-1], step) < _lowest(
            groups[-2], step
        ) + step * len(groups[-2]):
            last = groups.pop()
            groups[-1] += last
    return np.concatenate(
        [_lowest(group, step) + step * np.arange(len(group)) for group in groups]
    )


def _lowest(group: Sequence[float], step: float) -> float:
    """Return the lowest height of a group of labels at distances of `step` about its mean."""
    return sum(group) / len(group) - step * (len(group) - 1) / 2.0


def size_in(name: str) -> float:
    """Return the text size of the setting `name`, in inches."""
    return float(FontProperties(size=_RC[name]).get_size_in_points()) / 72.0


def grow(figure: Figure, name: str, lines: int) -> None:
    """Increase the height of `figure` by `lines` text lines of the setting `name`."""
    figure.set_figheight(figure.get_figheight() + max(0, lines) * _LINE * size_in(name))


def log_axis(axis: Axis) -> None:
    """Set plain numbers as ticks at 1, 2 and 5 of every decade of a logarithmic `axis`.

    An axis of more than three decades has ticks at 1 alone: the locator has no ticks at
    all where three in a decade are too many.
    """
    low, high = np.sort(axis.get_view_interval()).tolist()
    is_long = not 0.0 < high < low * _LONG_AXIS
    axis.set_major_locator(LogLocator(subs=(1.0,) if is_long else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def map_axes(axes: Axes, widest_m: float) -> None:
    """Label `axes` as a map, in metres; in kilometres if the map is wider than 20 km."""
    unit = "m"
    if widest_m > _WIDE_M:
        unit = "km"
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(lambda value_m, _: f"{value_m / 1e3:g}")
    axes.set(xlabel=f"x, east [{unit}]", ylabel=f"y, north [{unit}]")
    axes.set_aspect("equal", adjustable="datalim")


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
    """Write `figure` as PNG, SVG, PDF or EPS, by the suffix of `path`, without date and version; return `path`."""
    form = path.suffix.removeprefix(".")
    if form != "eps":
        figure.savefig(path, metadata=dict(FORMATS[form]))
        return path
    content = io.BytesIO()
    with warnings.catch_warnings(), _without_log("matplotlib.backends.backend_ps"):
        # PostScript has no transparency; shaded bands become solid.
        figure.savefig(content, format=form, metadata=dict(FORMATS[form]))
    lines = content.getvalue().split(b"\n")
    path.write_bytes(b"\n".join(line for line in lines if not line.startswith(_DATES)))
    return path


@contextmanager
def _without_log(name: str) -> Iterator[None]:
    """Silence the logger `name`."""
    logger = logging.getLogger(name)
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before
