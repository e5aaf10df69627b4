"""Map look-up of the published implementation of Karle et al. 2023, with its defects Q3 and Q4.

The look-up uses the published yaw (0 along +y). Its result is in REP-103, in the range
(-pi/2, 3 pi/2].
"""

import math

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, FloatArray
from fgtrack.models.track_map import COLUMNS, RoadView, TrackMap


class PublishedMap:
    """Map look-up by arc length from the nearest row of the map.

    The bounds are points, not lines (defect Q4). The heading is interpolated as a plain
    number, even across its jump at +-pi (defect Q3); `circular` avoids this.

    The interpolation uses the arc length of the raceline, but the unsigned projection
    is on the reference line.
    """

    def __init__(self, track: TrackMap, circular: bool = False) -> None:
        """Raises `DataError` if the raceline's arc length does not increase from row to row."""
        column = dict(zip(COLUMNS, track.table.T, strict=True))
        column["psi_ref_rad"] = wrap_angles(column["psi_ref_rad"] - 0.5 * math.pi)

        def closed(name: str) -> FloatArray:
            """Column `name` whose last row is the closing point, 0.999 of the way from the last row to the first."""
            values = column[name][:-1]
            return np.append(values, 0.999 * (values[0] - values[-1]) + values[-1])

        self._line = np.stack([closed("x_ref_m"), closed("y_ref_m")], axis=-1)
        self._line.flags.writeable = False
        self._longest_m = float(np.hypot(*np.diff(self._line, axis=0).T).max())
        self._arc = column["s_racetraj_m"]
        if np.diff(self._arc).min() <= 0.0:
            raise DataError(
                "not a map for the published look-up: s_racetraj_m must increase from row to row"
            )
        self._segment = np.roll(self._line, -1, axis=0) - self._line
        self._segment_squared = np.sum(self._segment**2, axis=1)
        self._heading = closed("psi_ref_rad")
        self._circular = circular
        normal = np.stack([closed("x_normvec_m"), closed("y_normvec_m")], axis=-1)
        right, left = closed("width_right_m")[:, None], closed("width_left_m")[:, None]
        edges = self._line + normal * right, self._line - normal * left
        self._table = np.column_stack([*edges, right + left, closed("kappa_ref_radpm")])

    def view(
        self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float
    ) -> RoadView:
        """Heading, curvature, and mask of `points_m` (n, 2) further outside than the buffers allow."""
        points_m = np.array(points_m, order="C")
        nearest = kernels("fgtrack.models.feet").nearest(
            points_m, self._line, self._longest_m
        )
        along = np.sum(
            self._segment[nearest] * (points_m - self._line[nearest]), axis=1
        )
        share = np.abs(along) / self._segment_squared[nearest]
        passed_m = share * np.sqrt(self._segment_squared[nearest])
        arc = np.mod(self._arc[nearest] + passed_m, float(self._arc.max()))
        high = np.clip(
            np.searchsorted(self._arc, arc, side="left"), 1, len(self._arc) - 1
        )
        weight = (arc - self._arc[high - 1]) / (self._arc[high] - self._arc[high - 1])
        low_row = self._table[high - 1]
        high_row = self._table[high]
        row = (high_row - low_row) * weight[:, None] + low_row
        to_right = np.hypot(*(points_m - row[:, 0:2]).T)
        to_left = np.hypot(*(points_m - row[:, 2:4]).T)
        outside: BoolArray = (to_right - row[:, 4] > inner_buffer_m) | (
            to_left - row[:, 4] > outer_buffer_m
        )
        turn = self._heading[high] - self._heading[high - 1]
        yaw = (wrap_angles(turn) if self._circular else turn) * weight + self._heading[
            high - 1
        ]
        return RoadView(yaw + 0.5 * math.pi, row[:, 5], outside)
