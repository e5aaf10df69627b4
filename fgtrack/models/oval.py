"""The built-in oval map: the size of a fast banked speedway, with a bend in its front straight."""

import math
from collections.abc import Callable

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.path import Path
from fgtrack.models.track_map import COLUMNS, TrackMap

#: Name of this map in settings that otherwise name a map file.
OVAL = "oval"
_TURN_RADIUS_M = 220.0
# Distance from the start line to the point where the curvature of the front bend begins to fall.
_BEND_M = 30.0
# Distance over which the curvature changes from one constant value to the next.
_BLEND_M = 130.0


def make_oval() -> TrackMap:
    """Return a banked tri-oval of 2.4 km, 15 m wide, driven counter-clockwise.

    The turns have a radius of 220 m. The curvature has a continuous derivative. The lap
    is symmetric about the line through the start and the middle of the back straight.
    So it closes exactly.
    """
    points = _centre_line()
    path = Path.through(points)
    curvature = path.frame(np.linspace(0.0, path.length_m, len(points))).turn
    straight_rad = math.radians(9.0)
    turn_rad = math.radians(20.0)
    share = np.clip(curvature * _TURN_RADIUS_M, 0.0, 1.0)
    banking = straight_rad + (turn_rad - straight_rad) * share
    # Negative banking leans to the left, as in the map files of the speedways.
    return _map_along(points, half_width_m=7.5, banking_rad=-banking)


def make_pit_lane() -> TrackMap:
    """Return the closed line of the pit lane of `make_oval`.

    It is a road left of the front straight, and the apron along the rest of the lap.
    """
    oval = make_oval()
    s = np.linspace(0.0, oval.length_m, len(oval.table))
    from_start = np.minimum(s, oval.length_m - s)
    blend = _smooth_step((from_start - 220.0) / 160.0)
    # The pit road lies 24 m left of the reference line, the apron 10 m.
    points = oval.position(s, 24.0 - 14.0 * blend)
    points[-1] = points[0]
    return _map_along(points, half_width_m=4.5, banking_rad=np.zeros(len(points)))


def _smooth_step(x: FloatArray) -> FloatArray:
    """Smooth step from 0 at x <= 0 to 1 at x >= 1: a quintic with a continuous second derivative."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


def _smooth_step_integral(x: FloatArray) -> FloatArray:
    """Integral of `_smooth_step` from 0 to x."""
    y = np.clip(x, 0.0, 1.0)
    return np.asarray(y**4 * (2.5 + y * (y - 3.0)) + np.maximum(x - 1.0, 0.0))


def _centre_line() -> FloatArray:
    """Points of the lap, evenly spaced from the start line, shape (n + 1, 2).

    The last point repeats the first.
    """
    bend = 1.0 / 600.0
    turn = 1.0 / _TURN_RADIUS_M
    bend_angle = bend * (_BEND_M + _BLEND_M / 2.0)
    # Length of a turn, between the middles of its two curvature ramps.
    turn_m = (math.pi - bend_angle) / turn
    half_m = 1200.0
    straight_start = _BEND_M + _BLEND_M

    def heading(s: FloatArray, straight_m: float) -> FloatArray:
        turn_start = straight_start + straight_m
        ramps = ((_BEND_M, -bend), (turn_start, turn), (turn_start + turn_m, -turn))
        return bend * s + sum(
            change * _BLEND_M * _smooth_step_integral((s - start) / _BLEND_M)
            for start, change in ramps
        )

    # Half a lap must end at the x of its start. A longer front straight moves the end forward by the cosine of
    # the bend, and shortens the back straight. One linear equation gives the length of the front straight.
    s = np.linspace(0.0, half_m, round(half_m / 2.0) + 1)
    end_x = _integrate(s, lambda u: np.cos(heading(u, 0.0)))[-1]
    straight_m = -end_x / (1.0 + math.cos(bend_angle))
    x = _integrate(s, lambda u: np.cos(heading(u, straight_m)))
    y = _integrate(s, lambda u: np.sin(heading(u, straight_m)))
    x = np.concatenate([x, -x[-2::-1]])
    y = np.concatenate([y, y[-2::-1]])
    # Rotate the lap, so that the heading of no straight lies at the jump from pi to -pi.
    c, sn = math.cos(0.5), math.sin(0.5)
    return np.stack([c * x - sn * y, sn * x + c * y], axis=1)


def _integrate(
    s: FloatArray, function: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Integral of `function` from s[0] to each s, shape (n,); Gauss-Legendre quadrature in each cell."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    half = np.diff(s)[:, None] / 2.0
    cells = (function(s[:-1, None] + half * (1.0 + nodes)) * weights * half).sum(axis=1)
    return np.concatenate([[0.0], np.cumsum(cells)])


def _map_along(
    points: FloatArray, *, half_width_m: float, banking_rad: FloatArray
) -> TrackMap:
    """Return the map with the reference line `points`, shape (n + 1, 2).

    The raceline equals the reference line, and is driven at constant speed.
    """
    path = Path.through(points)
    s = path.u_m
    frame = path.frame(s)
    curvature = frame.turn / frame.scale
    columns: dict[str, FloatArray | float] = {
        "x_ref_m": points[:, 0],
        "y_ref_m": points[:, 1],
        "width_right_m": half_width_m,
        "width_left_m": half_width_m,
        "x_normvec_m": np.sin(frame.heading_rad),
        "y_normvec_m": -np.cos(frame.heading_rad),
        "alpha_m": 0.0,
        "s_racetraj_m": s,
        "psi_racetraj_rad": frame.heading_rad,
        "kappa_racetraj_radpm": curvature,
        "vx_racetraj_mps": 70.0,
        "ax_racetraj_mps2": 0.0,
        "banking_rad": banking_rad,
        "s_ref_m": s,
        "psi_ref_rad": frame.heading_rad,
        "kappa_ref_radpm": curvature,
        "dkappa_ref_radpm2": (frame.turn_rate - curvature * frame.scale_rate)
        / frame.scale**2,
    }
    return TrackMap(
        np.stack([np.broadcast_to(columns[name], s.shape) for name in COLUMNS], axis=1)
    )
