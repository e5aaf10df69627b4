"""An oval of our own to race on: the size of a fast banked speedway, with a bend in its front straight."""

import math
from collections.abc import Callable

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.path import Path
from fgtrack.models.track_map import COLUMNS, TrackMap

#: The name that stands for this map wherever a map file may be named.
OVAL = "oval"
_TURN_RADIUS_M = 220.0
_BEND_M = (
    30.0  # from the start line to where the bend of the front straight begins to end
)
_BLEND_M = 130.0  # over which the curvature goes from one value to the next


def make_oval() -> TrackMap:
    """Banked tri-oval of 2.4 km, 15 m wide, turns of 220 m radius, driven counter-clockwise.
    Its curvature has a continuous derivative. The lap is symmetric about the line through the start and the middle of
    the back straight, so it closes exactly.
    """
    points = _centre_line()
    path = Path.through(points)
    curvature = path.frame(np.linspace(0.0, path.length_m, len(points))).turn
    low, high = (
        math.radians(9.0),
        math.radians(20.0),
    )  # on the straights and in the turns
    banking = low + (high - low) * np.clip(curvature * _TURN_RADIUS_M, 0.0, 1.0)
    # As in the speedways' files, negative banking leans to the left.
    return _map_along(points, half_width_m=7.5, banking_rad=-banking)


def make_pit_lane() -> TrackMap:
    """Closed line of the pit lane of `make_oval`: a road left of the front straight, the apron elsewhere."""
    oval = make_oval()
    s = np.linspace(0.0, oval.length_m, len(oval.table))
    from_start = np.minimum(s, oval.length_m - s)
    blend = _smooth_step((from_start - 220.0) / 160.0)
    points = oval.position(
        s, 24.0 - 14.0 * blend
    )  # the road lies 24 m to the left, the apron 10 m
    points[-1] = points[0]
    return _map_along(points, half_width_m=4.5, banking_rad=np.zeros(len(points)))


def _smooth_step(x: FloatArray) -> FloatArray:
    """0 up to x = 0, 1 from x = 1, between them the quintic without jumps up to the second derivative."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 + x * (6.0 * x - 15.0)))


def _smooth_step_integral(x: FloatArray) -> FloatArray:
    """Integral of `_smooth_step` from 0 to x."""
    y = np.clip(x, 0.0, 1.0)
    return np.asarray(y**4 * (2.5 + y * (y - 3.0)) + np.maximum(x - 1.0, 0.0))


def _centre_line() -> FloatArray:
    """Points of the lap, evenly spaced from the start line, shape (n + 1, 2); the last repeats the first."""
    bend, turn = 1.0 / 600.0, 1.0 / _TURN_RADIUS_M
    bend_angle = bend * (_BEND_M + _BLEND_M / 2.0)
    turn_m = (
        math.pi - bend_angle
    ) / turn  # from the middle of one ramp to the middle of the other
    half_m = 1200.0
    straight_start = _BEND_M + _BLEND_M

    def heading(s: FloatArray, straight_m: float) -> FloatArray:
        turn_start = straight_start + straight_m
        ramps = ((_BEND_M, -bend), (turn_start, turn), (turn_start + turn_m, -turn))
        return bend * s + sum(
            change * _BLEND_M * _smooth_step_integral((s - start) / _BLEND_M)
            for start, change in ramps
        )

    # The half lap must end above its start. A longer front straight moves its end forward by the cosine of
    # the bend and shortens the back straight: one linear equation gives the length of the front straight.
    s = np.linspace(0.0, half_m, round(half_m / 2.0) + 1)
    end_x = _integrate(s, lambda u: np.cos(heading(u, 0.0)))[-1]
    straight_m = -end_x / (1.0 + math.cos(bend_angle))
    x = _integrate(s, lambda u: np.cos(heading(u, straight_m)))
    y = _integrate(s, lambda u: np.sin(heading(u, straight_m)))
    x, y = np.concatenate([x, -x[-2::-1]]), np.concatenate([y, y[-2::-1]])
    c, sn = (
        math.cos(0.5),
        math.sin(0.5),
    )  # so that no straight lies on the jump of the heading
    return np.stack([c * x - sn * y, sn * x + c * y], axis=1)


def _integrate(
    s: FloatArray, function: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Integral of `function` from s[0] to each s, shape (n,), by Gauss-Legendre in every cell."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    half = np.diff(s)[:, None] / 2.0
    cells = (function(s[:-1, None] + half * (1.0 + nodes)) * weights * half).sum(axis=1)
    return np.concatenate([[0.0], np.cumsum(cells)])


def _map_along(
    points: FloatArray, *, half_width_m: float, banking_rad: FloatArray
) -> TrackMap:
    """Map with the reference line `points`, shape (n + 1, 2), as its raceline, driven at constant speed."""
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
