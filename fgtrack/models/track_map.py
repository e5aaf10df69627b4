"""A race track or pit lane: its closed reference line, its bounds, and road coordinates."""

import math
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt

from fgtrack.core.checks import LARGEST
from fgtrack.core.errors import DataError
from fgtrack.core.files import read_whole
from fgtrack.core.geometry import wrap_angles
from fgtrack.core.linalg import kernels
from fgtrack.core.types import BoolArray, FloatArray, IntArray

#: Columns of a map file, in order. The normal points to the right of the driving direction.
COLUMNS = (
    "x_ref_m",
    "y_ref_m",
    "width_right_m",
    "width_left_m",
    "x_normvec_m",
    "y_normvec_m",
    "alpha_m",
    "s_racetraj_m",
    "psi_racetraj_rad",
    "kappa_racetraj_radpm",
    "vx_racetraj_mps",
    "ax_racetraj_mps2",
    "banking_rad",
    "s_ref_m",
    "psi_ref_rad",
    "kappa_ref_radpm",
    "dkappa_ref_radpm2",
)
_COLUMN = {name: index for index, name in enumerate(COLUMNS)}
_HEADINGS = (_COLUMN["psi_racetraj_rad"], _COLUMN["psi_ref_rad"])
_ARCS = [_COLUMN["s_racetraj_m"], _COLUMN["s_ref_m"]]
# A heading is 0 along +y in a map file, and 0 along +x in REP-103.
_FILE_HEADING_OFFSET_RAD = math.pi / 2
_SAME_POINT_M = 1e-3
# A coarse map may turn a lot between two rows. A wrong heading convention is off by pi / 2.
_MAX_HEADING_ERROR_RAD = 1.0
# Columns of a segment row: ten quantities at the start of the segment, then their changes up to its end.
# Points are complex numbers x + i y. `_BACK` is exp(-i heading): it rotates a vector to (along + i left).
# `_ALONG` is the component of the segment itself along the heading.
_POINT, _BACK, (_HEADING, _CURVATURE, _LEFT, _RIGHT, _ARC, _ALONG) = (
    slice(0, 2),
    slice(2, 4),
    range(4, 10),
)
_QUANTITIES = 10


class RoadView(NamedTuple):
    """Map quantities at n positions."""

    yaw_rad: FloatArray
    """Heading of the traffic, shape (n,)."""
    curvature_radpm: FloatArray
    """Curvature of the road, positive for a left turn, shape (n,)."""
    outside: BoolArray
    """Mask of the positions where no object can be, shape (n,)."""


class TrackMap:
    """A closed reference line with the widths to both bounds.

    The line is straight from row to row. Within a segment the normal rotates evenly. So
    road coordinates are one-to-one up to the centre of curvature. They are the arc
    length s along the segments, and the lateral offset to the left. Angles follow
    REP-103.
    """

    def __init__(self, table: FloatArray) -> None:
        """Build the map from the rows of `table`, with the columns `COLUMNS` and REP-103 headings.

        Raises `DataError` with the row if the rows are not a closed line in driving
        direction.
        """
        table = _closed(np.asarray(table, dtype=np.float64))
        table[:, _HEADINGS] = wrap_angles(table[:, _HEADINGS])
        x, y = np.ascontiguousarray(table[:, :2].T)
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        heading = np.unwrap(table[:, _COLUMN["psi_ref_rad"]])
        line = x + 1j * y
        back = np.exp(-1j * heading)
        others = table[
            :,
            [
                _COLUMN[name]
                for name in ("kappa_ref_radpm", "width_left_m", "width_right_m")
            ],
        ].T
        # The quantities in the order of a segment row.
        knots = np.stack([x, y, back.real, back.imag, heading, *others, arc])
        starts = knots[:, :-1]
        changes = np.diff(knots)
        along = (np.diff(line) * [back[:-1], np.diff(back)]).real
        segments = np.concatenate([starts, along[:1], changes, along[1:]]).T.copy()
        for array in (table, arc, segments):
            array.flags.writeable = False
        self.table = table
        """The given rows; the last row repeats the first point and so closes the line."""
        self.length_m = float(arc[-1])
        """Length of one lap."""
        self.counter_clockwise = bool(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0.0)
        """True if the line is driven counter-clockwise. Then the inner bound is the left bound."""
        self._arc = arc
        self._segments = segments
        self._longest_m = float(np.diff(arc).max())

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read a map file: 17 `COLUMNS` separated by semicolons, `#` begins a comment line.

        The last row may repeat the first. Raises `DataError` with the path if the file
        cannot be read or is not a map.
        """
        content = read_whole(Path(path), 20.0)  # 20 MB are about 100,000 rows
        try:
            lines = [
                line
                for line in content.decode().splitlines()
                if line.strip() and not line.lstrip().startswith("#")
            ]
            table = np.array(
                [line.split(";") for line in lines], dtype=np.float64
            ).reshape(-1, len(COLUMNS))
            table[:, _HEADINGS] += _FILE_HEADING_OFFSET_RAD
            return cls(table)
        except (ValueError, DataError) as error:
            text = str(error).removeprefix("not a map: ")
            raise DataError(
                f"{path}: not a map of {len(COLUMNS)} columns separated by ';': {text}"
            ) from error

    def frenet(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Arc length s in [0, length) and lateral offset of `points_m` (n, 2); left is positive."""
        foot, lateral = self._locate(points_m)
        s = foot[:, _ARC]
        return np.where(s < self.length_m, s, 0.0), lateral

    def position(self, s_m: FloatArray, lateral_m: FloatArray) -> FloatArray:
        """Points (n, 2) at arc length `s_m` and lateral offset `lateral_m`; the inverse of `frenet`.

        Arc lengths of any lap are valid.
        """
        foot = self._at(s_m)
        back = _complex(foot[:, _BACK])
        points = _complex(foot[:, _POINT]) + 1j * lateral_m * np.abs(back) / back
        return points.view(np.float64).reshape(-1, 2)

    def bounds(self, s_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distances from the line to the left and right bound at arc length `s_m`, shapes (n,)."""
        foot = self._at(s_m)
        return foot[:, _LEFT], foot[:, _RIGHT]

    def view(
        self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float
    ) -> RoadView:
        """Heading and curvature of the line at `points_m` (n, 2), and mask of points outside the bounds.

        A positive buffer widens the track. The inner bound is the left one on a track
        that is driven counter-clockwise.
        """
        left_m = inner_buffer_m
        right_m = outer_buffer_m
        if not self.counter_clockwise:
            left_m, right_m = right_m, left_m
        line = np.array(points_m, order="C"), self._segments, self._longest_m
        return RoadView(*kernels("fgtrack.models.feet").view(*line, left_m, right_m))

    def _at(self, s_m: FloatArray) -> FloatArray:
        """Map quantities at arc length `s_m`, shape (n, 10)."""
        s = np.mod(np.asarray(s_m, dtype=np.float64), self.length_m)
        index: IntArray = np.minimum(
            np.searchsorted(self._arc, s, side="right") - 1, len(self._segments) - 1
        )
        at = self._segments[index]
        part = (s - at[:, _ARC]) / at[:, _QUANTITIES + _ARC]
        return np.asarray(at[:, :_QUANTITIES] + part[:, None] * at[:, _QUANTITIES:])

    def _locate(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Map quantities at the feet of `points_m` on the line, shape (n, 10), and lateral offsets (n,)."""
        feet: tuple[FloatArray, FloatArray] = kernels("fgtrack.models.feet").feet(
            np.array(points_m, order="C"), self._segments, self._longest_m
        )
        return feet


def _complex(vectors: FloatArray) -> npt.NDArray[np.complex128]:
    """Complex numbers x + i y of `vectors`, shape (n, 2)."""
    return np.ascontiguousarray(vectors).view(np.complex128)[:, 0]


def _closed(table: FloatArray) -> FloatArray:
    """Return a copy of `table` that ends with its first point.

    Raises `DataError` with the invalid row.
    """
    if table.ndim != 2 or table.shape[1] != len(COLUMNS) or len(table) < 4:
        raise DataError(f"not a map: give at least 4 rows of {len(COLUMNS)} columns")
    if not (np.abs(table) <= LARGEST).all():
        row, column = np.argwhere(~(np.abs(table) <= LARGEST))[0].tolist()
        raise DataError(
            f"not a map: row {row + 1}: {COLUMNS[column]} is not a number up to {LARGEST:g}"
        )
    gap_m = float(np.hypot(*(table[0, :2] - table[-1, :2])))
    closed = table.copy() if gap_m < _SAME_POINT_M else np.vstack([table, table[:1]])
    closed[-1, :2] = table[0, :2]
    if gap_m >= _SAME_POINT_M:
        closed[-1, _ARCS] = table[-1, _ARCS] + gap_m
    steps = np.diff(closed[:, :2], axis=0)
    lengths_m = np.hypot(*steps.T)
    widths_m = closed[:-1, [_COLUMN["width_left_m"], _COLUMN["width_right_m"]]].sum(
        axis=1
    )
    far_m = np.append(np.full(len(steps) - 1, math.inf), 10.0 * lengths_m[:-1].max())
    off_rad = np.abs(
        wrap_angles(
            np.arctan2(steps[:, 1], steps[:, 0]) - closed[:-1, _COLUMN["psi_ref_rad"]]
        )
    )
    for wrong, text in (
        (
            lengths_m < _SAME_POINT_M,
            "the next row repeats this point, remove one of them",
        ),
        (
            lengths_m > far_m,
            "the line does not close, the first point is too far from the last",
        ),
        (
            widths_m <= 0.0,
            "the sum of width_left_m and width_right_m must be positive",
        ),
        (
            off_rad > _MAX_HEADING_ERROR_RAD,
            "psi_ref_rad does not point to the next row; in a file it is 0 along +y",
        ),
    ):
        if wrong.any():
            raise DataError(f"not a map: row {np.argmax(wrong) + 1}: {text}")
    return closed
