"""A smooth closed curve to drive along: position, heading and curvature with their exact derivatives."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from fgtrack.core.types import FloatArray

if TYPE_CHECKING:  # takes half a second to import
    from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class PathFrame:
    """Moving frame of a path at n parameters u. Shapes (n,); a prime is the derivative by u."""

    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray
    """Direction of the tangent, wrapped."""
    scale: FloatArray
    """Metres of path per unit of u, 1 for an arc-length parameter."""
    scale_rate: FloatArray
    turn: FloatArray
    """heading'."""
    turn_rate: FloatArray
    """heading''."""


@dataclass(frozen=True, eq=False)
class Path:
    """Periodic cubic spline through points; the parameter u is the arc length along their chords."""

    spline: "CubicSpline[np.float64]"
    length_m: float

    @classmethod
    def through(cls, points_m: FloatArray) -> Self:
        """Closed path through `points_m`, shape (n + 1, 2), whose last point repeats the first."""
        from scipy.interpolate import CubicSpline

        chords = np.hypot(*np.diff(points_m, axis=0).T)
        u = np.concatenate([[0.0], np.cumsum(chords)])
        return cls(CubicSpline(u, points_m, bc_type="periodic"), float(u[-1]))

    def frame(self, u_m: FloatArray) -> PathFrame:
        """Moving frame at `u_m`, shape (n,), of any lap."""
        (x, y), (x1, y1), (x2, y2), (x3, y3) = (self.spline(u_m, nu).T for nu in range(4))
        scale_squared = x1 * x1 + y1 * y1
        scale = np.sqrt(scale_squared)
        dot = x1 * x2 + y1 * y2
        turn = (x1 * y2 - y1 * x2) / scale_squared
        return PathFrame(
            x_m=x,
            y_m=y,
            heading_rad=np.arctan2(y1, x1),
            scale=scale,
            scale_rate=dot / scale,
            turn=turn,
            turn_rate=(x1 * y3 - y1 * x3 - 2.0 * turn * dot) / scale_squared,
        )
