"""Size, font and style of a figure for a page, or the given axes into which it is drawn."""

import logging
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from pathlib import Path
from typing import Any, ParamSpec, TypedDict, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib import font_manager, style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from fgtrack.core.errors import CallError
from fgtrack.show.figures.style import LETTER, StyledFigure, grow, size_in

_logger = logging.getLogger(__name__)
P = ParamSpec("P")
T = TypeVar("T")
#: Settings of figures, used where the user has not changed matplotlib's default. Text sizes follow `font.size`.
_STYLE: Mapping[str, Any] = {  # Any: values of rcParams
    "font.size": 9.5,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": "medium",
    "xtick.labelsize": "small",
    "ytick.labelsize": "small",
    "legend.fontsize": "small",
    "figure.constrained_layout.use": True,
    "savefig.dpi": 150,
    "text.parse_math": False,
    "agg.path.chunksize": 20_000,
    "svg.hashsalt": "fgtrack",
    # TrueType: publishers as IEEE refuse Type 3, which is matplotlib's default.
    "pdf.fonttype": 42,
    "ps.fonttype": 42,
}
#: Additional settings for a figure as narrow as a column.
_COLUMN: Mapping[str, Any] = {
    "font.size": 8.0,
    "xtick.major.pad": 2.0,
    "ytick.major.pad": 2.0,
    "axes.labelpad": 2.0,
    "figure.constrained_layout.h_pad": 0.02,
    "figure.constrained_layout.w_pad": 0.02,
    "savefig.dpi": 300,
}
_COLUMN_IN = 5.0
_UNITS_IN = {"in": 1.0, "cm": 1.0 / 2.54, "mm": 1.0 / 25.4, "pt": 1.0 / 72.27}
_NARROWEST_IN = 1.5
_WIDEST_IN = 40.0
# The height is proportional to width^0.6, because texts do not shrink with the figure.
_FLATTEN = 0.6
#: Fonts with the same letter widths, for machines without the commercial font.
_METRIC_COMPATIBLE: Mapping[str, Sequence[str]] = {
    "Times New Roman": ("Liberation Serif", "STIXGeneral"),
    "Times": ("Liberation Serif", "STIXGeneral"),
    "Arial": ("Liberation Sans",),
    "Helvetica": ("Liberation Sans",),
}


#: Values of the choices of `Paper`.
_CHOICES: Mapping[str, Sequence[str]] = {
    "log": ("x", "y", "xy"),
    "legend": ("above", "ends"),
}


class Paper(TypedDict, total=False):
    """Keyword arguments of every figure.

    Without them a figure has the width of a screen and the settings in
    `matplotlib.rcParams`.
    """

    width: float | str
    """Width in inches, or with a unit: "3.4in", "86mm". The figure then has no title, as a paper has captions."""
    font: str
    """Font family, for instance "Times New Roman"."""
    style: str | Path
    """Style of matplotlib: a file (.mplstyle) or the name of a shipped style. It overrides rcParams."""
    log: str
    """Axes of a sweep's figures with a logarithmic scale: "x", "y" or "xy". The default is chosen by the values."""
    legend: str
    """Position of the legend: "above", in columns above the plot, or "ends", beside the ends of the lines."""
    ax: Axes
    """Axes of another figure to draw into. A figure with several plots subdivides them."""


def inches(width: float | str) -> float:
    """Return `width` in inches.

    Raises `CallError` if it is not a width between 1.5 and 40 inches.
    """
    text = str(width).strip()
    match = re.fullmatch(r"([0-9]+\.?[0-9]*|\.[0-9]+)\s*(in|cm|mm|pt|)", text)
    value = float(match[1]) * _UNITS_IN[match[2] or "in"] if match else math.nan
    if not _NARROWEST_IN <= value <= _WIDEST_IN:
        raise CallError(
            f"width {text!r}: must be between {_NARROWEST_IN:g} and {_WIDEST_IN:g} inches, write 3.4in, 8.6cm or 86mm"
        )
    return value


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator that runs `function` with the style of fgtrack and of its `Paper` arguments; it restores rcParams."""

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with mpl.rc_context(settings(kwargs)):
            return function(*args, **kwargs)

    return run


def is_column(paper: Mapping[str, Any]) -> bool:
    """True if the figure is as narrow as a column.

    Raises `CallError` for an invalid width.
    """
    return "width" in paper and inches(paper["width"]) < _COLUMN_IN


def settings(
    paper: Mapping[str, Any],
) -> Any:  # Any: keys of rcParams are a Literal of all names
    """Return the rcParams of a figure on `paper`.

    The user's own values win over fgtrack's values. The style and font of `paper` win
    over both. Raises `CallError` for an invalid width, style, font or choice.
    """
    wanted = {**_STYLE, **(_COLUMN if is_column(paper) else {})}
    current: Any = mpl.rcParams
    usual: Any = mpl.rcParamsDefault
    result: Any = {
        key: value for key, value in wanted.items() if current[key] == usual[key]
    }
    if "style" in paper:
        try:
            result.update(
                style.library.get(str(paper["style"]))
                or mpl.rc_params_from_file(paper["style"], False, False)
            )
        except (OSError, ValueError) as error:
            raise CallError(
                f"style {paper['style']}: cannot be used ({error}), give an .mplstyle file or a style of matplotlib"
            ) from error
    for name, choices in _CHOICES.items():
        if paper.get(name, choices[0]) not in choices:
            raise CallError(
                f"{name} {paper[name]!r}: must be one of {', '.join(choices)}"
            )
    if "font" in paper:
        result["font.family"] = _families(paper["font"])
    return result


@cache  # report a substitute only once
def _families(font: str) -> list[str]:
    families = [font, *_METRIC_COMPATIBLE.get(font, ())]
    known = {entry.name for entry in font_manager.fontManager.ttflist} | set(
        font_manager.font_family_aliases
    )
    installed = [name for name in families if name in known]
    if not installed:
        raise CallError(f"font {font!r}: not installed, use one of `fc-list : family`")
    if installed[0] != font:
        _logger.warning(
            "font %r is not installed, using %r with equal letter widths",
            font,
            installed[0],
        )
    return installed


class Sheet:
    """Canvas of a figure: a new figure, or the axes that the caller gave."""

    def __init__(self, width_in: float, height_in: float, paper: Paper) -> None:
        """Create a figure of this size, scaled to the width in `paper`. With `ax` in `paper`, use the figure of the
        axes.
        """
        self._ax = paper.get("ax")
        self.has_title = self._ax is None and "width" not in paper
        if self._ax is None:
            wanted_in = inches(paper.get("width", width_in))
            figure: Any = StyledFigure(
                figsize=(wanted_in, height_in * (wanted_in / width_in) ** _FLATTEN)
            )
        else:
            figure = self._ax.get_figure(root=True)
        self.figure: Figure = figure

    def plots(
        self,
        rows: int = 1,
        columns: int = 1,
        *,
        heights: Sequence[float] | None = None,
        widths: Sequence[float] | None = None,
        sharex: bool = False,
        sharey: bool = False,
    ) -> NDArray[Any]:  # Any: of Axes
        """Return the axes of the plots, shape (rows, columns).

        Raises `CallError` for several plots in given axes that are not from `plt.subplots`.
        """
        ratios: dict[str, Any] = {"height_ratios": heights, "width_ratios": widths}
        if self._ax is None:
            grid: Any = self.figure.add_gridspec(rows, columns, **ratios)
        elif rows * columns == 1:
            return np.array([[self._ax]], dtype=object)
        else:
            cell = self._ax.get_subplotspec()
            if cell is None:
                raise CallError(
                    f"ax: a figure of {rows * columns} plots needs axes from `plt.subplots`"
                )
            self._ax.set_axis_off()
            grid = cell.subgridspec(rows, columns, **ratios)
        result: NDArray[Any] = np.asarray(
            grid.subplots(sharex=sharex, sharey=sharey, squeeze=False), dtype=object
        )
        return result

    def title(self, text: str) -> None:
        """Write `text` above the figure, wrapped to its width; a figure without a title keeps it as its caption."""
        if isinstance(self.figure, StyledFigure):
            self.figure.caption = text
        if self.has_title:
            width = max(
                10,
                int(
                    self.figure.get_figwidth() / (LETTER * size_in("figure.titlesize"))
                ),
            )
            lines = [
                line for part in text.split("\n") for line in textwrap.wrap(part, width)
            ]
            self.figure.suptitle("\n".join(lines))
            grow(self.figure, "figure.titlesize", len(lines) - 1)
