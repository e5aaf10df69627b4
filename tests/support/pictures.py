"""What a figure shows as a picture: its texts, and whether any is cut off or lies on another."""

import io
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import BinaryIO

import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from PIL import Image

from fgtrack.show.figures.style import StyledFigure

_TOUCH_PX = 1.0


def with_blank_pictures(patch: pytest.MonkeyPatch) -> None:
    """Let figures be saved as small blank pictures, for tests of files whose pictures nobody looks at."""
    blank = io.BytesIO()
    Image.new("RGB", (4, 3), "white").save(blank, "PNG")

    def savefig(_: StyledFigure, file: Path | BinaryIO, **options: object) -> None:
        if isinstance(file, Path):
            file.write_bytes(blank.getvalue())
        else:
            file.write(blank.getvalue())

    patch.setattr(StyledFigure, "savefig", savefig)


def faults(figure: Figure) -> list[str]:
    """A line for each text of `figure` that reaches beyond the canvas, and for each two that lie on each other."""
    FigureCanvasAgg(figure).draw()
    boxes = list(_boxes(figure))
    canvas = figure.bbox
    found = [
        f"cut off: {name!r}"
        for name, box in boxes
        if box.x0 < canvas.x0 - _TOUCH_PX
        or box.y0 < canvas.y0 - _TOUCH_PX
        or box.x1 > canvas.x1 + _TOUCH_PX
        or box.y1 > canvas.y1 + _TOUCH_PX
    ]
    for (name, box), (other, its) in combinations(boxes, 2):
        wide, high = (
            min(box.x1, its.x1) - max(box.x0, its.x0),
            min(box.y1, its.y1) - max(box.y0, its.y0),
        )
        if wide > _TOUCH_PX and high > _TOUCH_PX:
            found.append(f"overlap: {name!r} and {other!r}")
    return found


def _boxes(figure: Figure) -> Iterator[tuple[str, Bbox]]:
    """Every text that is seen, and its place in pixels."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    seen = [
        text
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text().strip()
    ]
    ticks = {id(label) for axes in figure.axes for label in _all_tick_labels(axes)}
    drawn = {id(label) for axes in figure.axes for label in _drawn_tick_labels(axes)}
    hidden = {
        id(text)
        for axes in figure.axes
        if not axes.get_visible()
        for text in axes.findobj(Text)
    }
    for text in seen:
        if id(text) in hidden or (id(text) in ticks and id(text) not in drawn):
            continue
        yield (
            text.get_text(),
            Text.get_window_extent(text, renderer),
        )  # of an annotation without its arrow


def _all_tick_labels(axes: Axes) -> Iterator[Text]:
    for axis in (axes.xaxis, axes.yaxis):
        for tick in (*axis.majorTicks, *axis.minorTicks):
            yield from (tick.label1, tick.label2)


def _drawn_tick_labels(axes: Axes) -> Iterator[Text]:
    """Labels of the ticks inside the limits."""
    for axis in (axes.xaxis, axes.yaxis):
        low, high = sorted(axis.get_view_interval())
        for tick in (*axis.majorTicks, *axis.minorTicks):
            if low <= tick.get_loc() <= high:
                yield from (
                    label for label in (tick.label1, tick.label2) if label.get_visible()
                )
