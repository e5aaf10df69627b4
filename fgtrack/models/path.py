"""A smooth path, closed or open: position, heading and curvature with their exact derivatives."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from fgtrack.core.types import FloatArray

_JACOBI_STEPS = 60


@dataclass(frozen=True)
class PathFrame:
    """Moving frame of a path at n parameters u; all shapes are (n,).

    A prime denotes the derivative by u.
    """

    x_m: FloatArray
    y_m: FloatArray
    heading_rad: FloatArray
    """Direction of the tangent, wrapped."""
    scale: FloatArray
    """Metres of path per unit of u; 1 for an arc-length parameter."""
    scale_rate: FloatArray
    """scale'."""
    turn: FloatArray
    """heading'."""
    turn_rate: FloatArray
    """heading''."""


@dataclass(frozen=True, eq=False)
class Path:
    """Cubic spline through points. Its parameter u is the arc length along the chords.

    A closed path is periodic. An open path goes straight on beyond its two ends.
    """

    u_m: FloatArray
    """Parameters of the points, shape (n + 1,), from 0 to the length of the lap.

    An open path has two additional points, on the straight lines beyond its ends.
    """
    coefficients: FloatArray
    """Position and its three derivatives at the start of each piece, shape (4, n, 2)."""
    is_closed: bool = True

    @classmethod
    def through(cls, points_m: FloatArray) -> Self:
        """Return the closed path through `points_m`, shape (n + 1, 2); the last point repeats the first."""
        steps = np.diff(points_m, axis=0)
        h = np.hypot(*steps.T)[:, None]
        slope = steps / h
        before = np.roll(h, 1, axis=0)
        # Continuous second derivatives s: h_- s_- + 2 (h_- + h) s + h s_+ = 6 (slope - slope_-).
        # Each Jacobi step halves the error of the solution.
        second = total = 3.0 * (slope - np.roll(slope, 1, axis=0)) / (before + h)
        for _ in range(_JACOBI_STEPS):
            neighbours = before * np.roll(second, 1, axis=0) + h * np.roll(
                second, -1, axis=0
            )
            second = total - 0.5 * neighbours / (before + h)
        after = np.roll(second, -1, axis=0)
        coefficients = (
            points_m[:-1],
            slope - h * (2.0 * second + after) / 6.0,
            second,
            (after - second) / h,
        )
        return cls(np.concatenate([[0.0], np.cumsum(h)]), np.array(coefficients))

    @classmethod
    def open_through(cls, points_m: FloatArray) -> Self:
        """Return the open path through `points_m`, shape (n, 2); its curvature is 0 at both ends."""
        from scipy.interpolate import CubicSpline

        steps_m = np.hypot(*np.diff(points_m, axis=0).T)
        u_m = np.concatenate([[0.0], np.cumsum(steps_m)])
        spline = CubicSpline(u_m, points_m, bc_type="natural")
        inside = spline.c[::-1] * np.array([1.0, 1.0, 2.0, 6.0])[:, None, None]
        still = np.zeros(2)
        first = spline(u_m[0], 1)
        last = spline(u_m[-1], 1)
        before = np.array([points_m[0] - first, first, still, still])[:, None]
        after = np.array([points_m[-1], last, still, still])[:, None]
        return cls(
            np.concatenate([[-1.0], u_m, [u_m[-1] + 1.0]]),
            np.concatenate([before, inside, after], axis=1),
            is_closed=False,
        )

    @property
    def length_m(self) -> float:
        """Length of the lap of a closed path along the chords."""
        return float(self.u_m[-1])

    def frame(self, u_m: FloatArray) -> PathFrame:
        """Moving frame at the parameters `u_m`, shape (n,); parameters of any lap are valid."""
        lap_m = np.mod(u_m, self.length_m) if self.is_closed else u_m
        piece = np.searchsorted(self.u_m[1:-1], lap_m, side="right")
        t = (lap_m - self.u_m[piece])[:, None]
        p0, p1, p2, p3 = self.coefficients[:, piece]
        x, y = (p0 + t * (p1 + t * (p2 / 2.0 + t * p3 / 6.0))).T
        x1, y1 = (p1 + t * (p2 + t * p3 / 2.0)).T
        x2, y2 = (p2 + t * p3).T
        x3, y3 = p3.T
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
