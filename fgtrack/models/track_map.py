"""The closed line of a race track or pit lane with its bounds, and the road coordinates along it."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

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
_ARCS = (_COLUMN["s_racetraj_m"], _COLUMN["s_ref_m"])

_FILE_HEADING_OFFSET_RAD = math.pi / 2  # a file's heading is 0 along +y, REP-103 is 0 along +x
_SAME_POINT_M = 1e-3
_LARGEST_MB = 20.0  # some 100,000 rows
_DENSE = 1 << 16  # so many distances are faster than a tree
_UNKNOWN = np.empty(0, dtype=np.int64)
_MAX_GAP = 10.0  # closing segment, in lengths of the longest other segment
_MAX_HEADING_ERROR_RAD = 1.0  # coarse maps turn much in a row; a wrong convention is off by pi / 2

# A segment row holds these quantities where the segment starts, and then the changes to its end. A point is complex,
# x + i y; times `_BACK`, exp(-i heading), a vector is along + i left. `_ALONG` is the segment's own part along.
_POINT, _BACK, (_HEADING, _CURVATURE, _LEFT, _RIGHT, _ARC, _ALONG) = slice(0, 2), slice(2, 4), range(4, 10)
_QUANTITIES = 10

ComplexArray = npt.NDArray[np.complex128]


class RoadView(NamedTuple):
    """The map at n places."""

    yaw_rad: FloatArray
    """Heading of the traffic, shape (n,)."""
    curvature_radpm: FloatArray
    """Left turn positive, shape (n,)."""
    outside: BoolArray
    """True where no object can be, shape (n,)."""


@dataclass(frozen=True, eq=False)
class TrackMap:
    """A closed reference line with widths to both bounds.

    The line runs straight from row to row. Its normals turn evenly within a segment, from the heading of one
    row to that of the next, so road coordinates (arc length s, lateral offset) are continuous and one-to-one
    as far as the centre of curvature. s is measured along the segments from the first row; lateral is
    positive to the left of the driving direction. Angles are REP-103. Points must be finite.

    Raises
    ------
    DataError
        If `table` is no closed line in driving direction.
    """

    table: FloatArray
    """Rows of `COLUMNS`, shape (n + 1, 17), headings in REP-103; the last row closes the line."""
    length_m: float = field(init=False)
    """Length of one lap."""
    counter_clockwise: bool = field(init=False)
    """True if the line is driven counter-clockwise, so that the inner bound is the left one."""
    _points: FloatArray = field(init=False, repr=False)
    _arc: FloatArray = field(init=False, repr=False)
    _segments: FloatArray = field(init=False, repr=False)
    _tree: "cKDTree[None]" = field(init=False, repr=False)

    def __post_init__(self) -> None:
        table = np.asarray(self.table, dtype=np.float64)
        fault = _fault(table)
        if fault is not None:
            raise DataError(f"no map: row {fault[0] + 1}: {fault[1]}")
        table = _closed(table)
        table[:, _HEADINGS] = wrap_angles(table[:, _HEADINGS])
        x, y = points = np.ascontiguousarray(table[:, :2].T)
        arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
        heading = np.unwrap(table[:, _COLUMN["psi_ref_rad"]])
        line, back = x + 1j * y, np.exp(-1j * heading)
        knots = np.stack(
            [  # in the order of a segment row
                x,
                y,
                back.real,
                back.imag,
                heading,
                table[:, _COLUMN["kappa_ref_radpm"]],
                table[:, _COLUMN["width_left_m"]],
                table[:, _COLUMN["width_right_m"]],
                arc,
            ]
        )
        starts, changes = knots[:, :-1], np.diff(knots)
        along = (np.diff(line) * [back[:-1], np.diff(back)]).real
        segments = np.concatenate([starts, along[:1], changes, along[1:]]).T.copy()
        for array in (table, points, arc, segments):
            array.flags.writeable = False
        for name, value in (
            ("table", table),
            ("length_m", float(arc[-1])),
            ("counter_clockwise", bool(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) > 0.0)),
            ("_points", points.T[:-1]),
            ("_arc", arc),
            ("_segments", segments),
            ("_tree", cKDTree(points.T[:-1])),
        ):
            object.__setattr__(self, name, value)

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Map of a semicolon-separated file with the 17 `COLUMNS`; `#` starts a comment line.

        The last row may repeat the first. The file's headings (0 along +y) become REP-103 here.

        Raises
        ------
        DataError
            If the file cannot be read or is no map, with its line.
        """
        rows: list[list[float]] = []
        lines: list[int] = []
        try:
            text = read_whole(Path(path), _LARGEST_MB).decode()
        except UnicodeDecodeError as error:
            raise DataError(f"{path}: cannot read the map (it is no text file)") from error
        for number, line in enumerate(text.splitlines(), start=1):
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            cells = line.split(";")
            if len(cells) != len(COLUMNS):
                raise DataError(
                    f"{path}:{number}: no map: {len(cells)} columns, expected {len(COLUMNS)} separated by ';'"
                )
            try:
                rows.append([float(cell) for cell in cells])
            except ValueError as error:
                raise DataError(f"{path}:{number}: no map: {error}") from error
            lines.append(number)
        table = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS))
        table[:, _HEADINGS] += _FILE_HEADING_OFFSET_RAD
        fault = _fault(table)
        if fault is not None:
            place = f"{path}:{lines[fault[0]]}" if lines else f"{path}"
            raise DataError(f"{place}: no map: {fault[1]}")
        return cls(table)

    def write(self, path: str | Path) -> None:
        """Write the layout that `read` reads, with nine decimals."""
        table = self.table.copy()
        table[:, _HEADINGS] = wrap_angles(table[:, _HEADINGS] - _FILE_HEADING_OFFSET_RAD)
        table = np.round(table, 9) + 0.0  # no negative zeros
        np.savetxt(path, table, fmt="%.9f", delimiter="; ", header="; ".join(COLUMNS), encoding="utf-8")

    def frenet(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Arc length s in [0, length) and lateral offset (left positive) of `points_m`, shape (n, 2)."""
        foot, lateral = self._locate(points_m)
        s = foot[:, _ARC]
        return np.where(s < self.length_m, s, 0.0), lateral

    def position(self, s_m: FloatArray, lateral_m: FloatArray) -> FloatArray:
        """Points, shape (n, 2), at arc length `s_m` (any lap) and `lateral_m`; the inverse of `frenet`."""
        foot = self._at(s_m)
        back = _complex(foot[:, _BACK])
        points = _complex(foot[:, _POINT]) + 1j * lateral_m * np.abs(back) / back
        return points.view(np.float64).reshape(-1, 2)

    def heading(self, points_m: FloatArray) -> FloatArray:
        """Driving direction of the line beside `points_m`, shape (n,), interpolated along the circle."""
        foot, _ = self._locate(points_m)
        return wrap_angles(foot[:, _HEADING])

    def bounds(self, s_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Widths (left, right) from the line to the bounds at arc length `s_m`, shapes (n,)."""
        foot = self._at(s_m)
        return foot[:, _LEFT], foot[:, _RIGHT]

    def outside(self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float) -> BoolArray:
        """Which of `points_m` lie outside the bounds, shape (n,).

        A positive buffer lets points in that lie up to that far beyond the bound; a negative one shrinks the
        track. The inner bound is the one that the lap encloses: the left one if driven counter-clockwise.
        """
        return self.view(points_m, inner_buffer_m, outer_buffer_m).outside

    def view(self, points_m: FloatArray, inner_buffer_m: float, outer_buffer_m: float) -> RoadView:
        """Heading and curvature of the line beside `points_m`, shape (n, 2), and which of them are `outside`."""
        foot, lateral = self._locate(points_m)
        left_m, right_m = (
            (inner_buffer_m, outer_buffer_m) if self.counter_clockwise else (outer_buffer_m, inner_buffer_m)
        )
        outside = (lateral > foot[:, _LEFT] + left_m) | (-lateral > foot[:, _RIGHT] + right_m)
        return RoadView(wrap_angles(foot[:, _HEADING]), foot[:, _CURVATURE], outside)

    def _at(self, s_m: FloatArray) -> FloatArray:
        """Quantities at arc length `s_m`, shape (n, 10)."""
        s = np.mod(np.asarray(s_m, dtype=np.float64), self.length_m)
        index: IntArray = np.minimum(np.searchsorted(self._arc, s, side="right") - 1, len(self._segments) - 1)
        at = self._segments[index]
        return _interpolated(at, (s - at[:, _ARC]) / at[:, _QUANTITIES + _ARC])

    def _locate(self, points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Quantities at the feet of `points_m` on the line, shape (n, 10), and lateral offsets, shape (n,)."""
        points_m = np.array(points_m, order="C")
        nearest = _UNKNOWN
        if len(points_m) * len(self._segments) > _DENSE:
            nearest = np.asarray(self._tree.query(points_m)[1])
        found: tuple[FloatArray, FloatArray] = kernels("fgtrack.models.feet").feet(points_m, nearest, self._segments)
        return found


def _complex(vectors: FloatArray) -> ComplexArray:
    """x + i y of `vectors`, shape (n, 2)."""
    return np.ascontiguousarray(vectors).view(np.complex128)[:, 0]


def _interpolated(at: FloatArray, part: FloatArray) -> FloatArray:
    """Quantities, shape (n, 10), at `part` (n,) of the segment rows `at` (n, 20)."""
    return np.asarray(at[:, :_QUANTITIES] + part[:, None] * at[:, _QUANTITIES:])


def _closed(table: FloatArray) -> FloatArray:
    """Copy of `table` that ends with its first point, arc lengths carried on over the closing segment."""
    gap = float(np.hypot(*(table[0, :2] - table[-1, :2])))
    if gap < _SAME_POINT_M:
        closed = table.copy()
        closed[-1, :2] = table[0, :2]
        return closed
    last = table[0].copy()
    for column in _ARCS:
        last[column] = table[-1, column] + gap
    return np.vstack([table, last])


def _fault(table: FloatArray) -> tuple[int, str] | None:
    """Row and reason why `table`, headings in REP-103, is no closed line in driving direction, or None."""
    if table.ndim != 2 or table.shape[1] != len(COLUMNS) or len(table) < 4:
        return max(len(table) - 1, 0), f"at least 4 rows of {len(COLUMNS)} columns are needed"
    bad = np.argwhere(~(np.abs(table) <= LARGEST))
    if len(bad):
        return int(bad[0, 0]), f"{COLUMNS[bad[0, 1]]} is no number up to {LARGEST:g}"
    closed = _closed(table)
    if len(closed) < 5:
        return len(table) - 1, "at least 4 rows besides the one that repeats the first are needed"
    steps = np.diff(closed[:, :2], axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    if lengths.min() < _SAME_POINT_M:
        return int(np.argmax(lengths < _SAME_POINT_M)), "the next row holds the same point"
    if lengths[-1] > _MAX_GAP * lengths[:-1].max():
        return len(table) - 1, f"the line does not close: {lengths[-1]:.1f} m from its last point to its first"
    widths = table[:, [_COLUMN["width_left_m"], _COLUMN["width_right_m"]]].sum(axis=1)
    if widths.min() <= 0.0:
        return int(np.argmax(widths <= 0.0)), "the widths do not add up to a positive one"
    heading = closed[:-1, _COLUMN["psi_ref_rad"]]
    error = np.abs(wrap_angles(np.arctan2(steps[:, 1], steps[:, 0]) - heading))
    if error.max() > _MAX_HEADING_ERROR_RAD:
        row = int(np.argmax(error > _MAX_HEADING_ERROR_RAD))
        return row, (f"psi_ref_rad is {error[row]:.2f} rad off the way to the next row; a file counts it from +y")
    return None
