"""Colours of figures, reports and viewers. An estimator has the same colour everywhere."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple
from zlib import crc32

_BLUE, _ORANGE, _GREEN, _PURPLE, _SKY, _RED = (
    "#0072B2",
    "#CC7A00",
    "#009E73",
    "#B65CA8",
    "#2F93C6",
    "#D1495B",
)
#: Distinguishable with colour blindness. Each has a contrast of 3 or more on white and dark pages (WCAG 2.1).
PALETTE = (_BLUE, _ORANGE, _GREEN, _PURPLE, _SKY, _RED)
#: Colours of the sensors of a recording, by order of name. None is the colour of a common estimator.
SENSORS = (_PURPLE, "#8C7A1F", "#6F6F6F", "#A0622D", _SKY)
_LINES = ("-", "--", "-.", ":")
_MARKERS = "os^vDP"


class CurveStyle(NamedTuple):
    """Colour, line style and marker of a curve."""

    colour: str
    line: str
    marker: str


#: Styles of the common estimators. Where two curves coincide, a dashed line above a solid line shows both.
_ESTIMATORS: Mapping[str, CurveStyle] = {
    "smoother": CurveStyle(_BLUE, "-", "o"),
    "smoother-batch": CurveStyle(_BLUE, "-.", "o"),
    "smoother-banded": CurveStyle(_BLUE, ":", "o"),
    "ekf-replay": CurveStyle(_ORANGE, "--", "s"),
    "ekf-rts": CurveStyle(_ORANGE, "-.", "D"),
    "ekf-backward-forward": CurveStyle(_GREEN, "-", "^"),
    "rewind-forget": CurveStyle(_GREEN, "--", "^"),
    "drop": CurveStyle(_RED, "-", "v"),
    "as-current": CurveStyle(_PURPLE, "-", "D"),
    "reorder-buffer": CurveStyle(_SKY, "-", "P"),
}


def style_of(estimator: str) -> CurveStyle:
    """Return the curve style of `estimator`; an unknown name always gets the same style."""
    number = crc32(estimator.encode())
    unknown = CurveStyle(
        (_PURPLE, _SKY)[number % 2],
        _LINES[1:][number // 2 % 3],
        _MARKERS[number // 8 % len(_MARKERS)],
    )
    return _ESTIMATORS.get(estimator, unknown)


def styles(estimators: Sequence[str]) -> list[CurveStyle]:
    """Return a curve style for each of `estimators`, in their order; equal colours get different lines."""
    result: list[CurveStyle] = []
    for item in map(style_of, estimators):
        taken = [other.line for other in result if other.colour == item.colour]
        result.append(
            item._replace(
                line=next(
                    (line for line in (item.line, *_LINES) if line not in taken),
                    item.line,
                )
            )
        )
    return result


def distinct_colours(estimators: Sequence[str]) -> list[str]:
    """Return a colour for each of `estimators`: its own, or a free colour of the palette if it is already used."""
    result: list[str] = []
    for own in (style_of(name).colour for name in estimators):
        result.append(
            next((colour for colour in (own, *PALETTE) if colour not in result), own)
        )
    return result
