"""Runs to look at: figures, the HTML report, and files for Foxglove, RViz and maps.

The names below are public: the style of figures of your own. `fgtrack.plot` draws runs.
"""

from typing import TYPE_CHECKING

from fgtrack.core.lazy import lazy_names

#: Module that each public name is loaded from on first use.
_HOMES = {
    "CurveStyle": "fgtrack.show.palette",
    "GREY": "fgtrack.show.figures.style",
    "PALETTE": "fgtrack.show.palette",
    "WRONG": "fgtrack.show.figures.style",
    "log_axis": "fgtrack.show.figures.style",
    "save": "fgtrack.show.figures.style",
    "style_of": "fgtrack.show.palette",
    "styled": "fgtrack.show.figures.paper",
    "styles": "fgtrack.show.palette",
}

__all__ = sorted(_HOMES)

if TYPE_CHECKING:  # the same names for type checkers; a test keeps the two lists equal
    from fgtrack.show.figures.paper import styled as styled
    from fgtrack.show.figures.style import GREY as GREY
    from fgtrack.show.figures.style import WRONG as WRONG
    from fgtrack.show.figures.style import log_axis as log_axis
    from fgtrack.show.figures.style import save as save
    from fgtrack.show.palette import PALETTE as PALETTE
    from fgtrack.show.palette import CurveStyle as CurveStyle
    from fgtrack.show.palette import style_of as style_of
    from fgtrack.show.palette import styles as styles

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
