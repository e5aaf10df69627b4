"""The map look-up of the published implementation of Karle et al. 2023, with its defects Q3 and Q4.

It works in that implementation's yaw (0 along +y), and gives REP-103 in its range (-pi/2, 3 pi/2].
"""

import math

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.track_map import COLUMNS, RoadView, TrackMap

_CLOSING = 0.999  # the closing point lies this share of the way from the last row to the first


class PublishedMap:
    """Arc look-up at the nearest row, with bounds as points (defect Q4) and a heading that is interpolated as a plain
    number, through its jump at +-pi (defect Q3).

    The raceline's arc length serves as the knots although the projection is on the reference line; the projection
    is taken without its sign, so a place behind the nearest row is mirrored ahead of it.

    Raises
    ------
    DataError
        The raceline's arc length of `track` does not grow from row to row.
    """

    def __init__(self, track: TrackMap) -> None:
        column = dict(zip(COLUMNS, track.table.T, strict=True))
        column["psi_ref_rad"] = wrap_angles(column["psi_ref_rad"] - 0.5 * math.pi)

        def closed(name: str) -> FloatArray:
            """A column whose last row is the closing point."""
            values = column[name][:-1]
            return np.append(values, _CLOSING * (values[0] - values[-1]) + values[-1])

        self._x, self._y = closed("x_ref_m"), closed("y_ref_m")
        self._line = np.stack([self._x, self._y], axis=-1)
        self._arc = column["s_racetraj_m"]
        if np.diff(self._arc).min() <= 0.0:
            row = int(np.argmax(np.diff(self._arc) <= 0.0)) + 1
            raise DataError(
                f"no map for a published look-up: row {row}: s_racetraj_m does not grow to the next row; "
                "write a raceline, or drop circular_heading and heading_jump from defects"
            )
        self._length_m = float(self._arc.max())
        self._segment = np.roll(self._line, -1, axis=0) - self._line
        self._segment_squared = np.sum(self._segment**2, axis=1)
        self._heading = closed("psi_ref_rad")
        normal = np.stack([closed("x_normvec_m"), closed("y_normvec_m")], axis=-1)
        right, left = closed("width_right_m")[:, None], closed("width_left_m")[:, None]
        edges = self._line + normal * right, self._line - normal * left
        self._table = np.column_stack([*edges, right + left, closed("kappa_ref_radpm")])

    def view(self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float) -> RoadView:
        """Heading, curvature and whether a place lies further outside than the buffers allow; points (n, 2)."""
        arc = self._arcs(points_m)
        high = np.clip(np.searchsorted(self._arc, arc, side="left"), 1, len(self._arc) - 1)
        weight = (arc - self._arc[high - 1]) / (self._arc[high] - self._arc[high - 1])
        low_row, high_row = self._table[high - 1], self._table[high]
        row = (high_row - low_row) * weight[:, None] + low_row
        to_right = np.hypot(*(points_m - row[:, 0:2]).T)
        to_left = np.hypot(*(points_m - row[:, 2:4]).T)
        outside: BoolArray = (to_right - row[:, 4] > inner_buffer_m) | (to_left - row[:, 4] > outer_buffer_m)
        return RoadView(self._heading_at(high, weight) + 0.5 * math.pi, row[:, 5], outside)

    def _arcs(self, points_m: FloatArray) -> FloatArray:
        squared = (self._x - points_m[:, 0:1]) ** 2 + (self._y - points_m[:, 1:2]) ** 2
        nearest = np.argmin(squared, axis=1)
        along = np.sum(self._segment[nearest] * (points_m - self._line[nearest]), axis=1)
        share = np.abs(along) / self._segment_squared[nearest]
        passed_m = share * np.sqrt(self._segment_squared[nearest])
        return np.asarray(np.mod(self._arc[nearest] + passed_m, self._length_m))

    def _heading_at(self, high: IntArray, weight: FloatArray) -> FloatArray:
        low_yaw, high_yaw = self._heading[high - 1], self._heading[high]
        return np.asarray((high_yaw - low_yaw) * weight + low_yaw)


class CircularHeadingMap(PublishedMap):
    """The published look-up with the heading interpolated on the circle: defect Q4 alone."""

    def _heading_at(self, high: IntArray, weight: FloatArray) -> FloatArray:
        low_yaw, high_yaw = self._heading[high - 1], self._heading[high]
        return np.asarray(wrap_angles(high_yaw - low_yaw) * weight + low_yaw)
