"""The map of the published tracker, read from BEHAVIOUR.md section 3: naive, literal, its own yaw convention."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Array = Any  # numpy array of floats


@dataclass(frozen=True)
class Place:
    """What the lane knows about a position."""

    heading: float
    curvature: float
    to_right: float
    to_left: float
    width: float


class PublishedLane:
    """A track or a pit lane from a CSV file of 17 columns; yaw 0 along +y."""

    def __init__(self, path: Path, inner_buffer: float, outer_buffer: float) -> None:
        self.inner_buffer, self.outer_buffer = inner_buffer, outer_buffer
        rows = np.loadtxt(path, delimiter=";", comments="#")
        self.arcs = rows[:, 7]
        self.lap = max(self.arcs)
        table = rows[:-1]
        closing = 0.999 * (table[0] - table[-1]) + table[-1]
        table = np.vstack([table, closing])
        centre, normal = table[:, 0:2], table[:, 4:6]
        width_right, width_left = table[:, 2], table[:, 3]
        self.centre = centre
        self.right = centre + normal * width_right[:, None]
        self.left = centre - normal * width_left[:, None]
        self.widths = width_right + width_left
        self.headings, self.curvatures = table[:, 14], table[:, 15]

    def arc(self, point: Array) -> float:
        """Arc length of the raceline at `point`, with a distance along the reference line added to it."""
        offsets = self.centre - point
        k = int(np.argmin(offsets[:, 0] ** 2 + offsets[:, 1] ** 2))
        segment = self.centre[(k + 1) % len(self.centre)] - self.centre[k]
        along = (
            np.dot(segment, point - self.centre[k]) / np.dot(segment, segment) * segment
        )
        return float((self.arcs[k] + np.hypot(*along)) % self.lap)

    def at(self, point: Array) -> Place:
        """Heading, curvature and distances to the bound points at `point`."""
        arc = self.arc(point)
        first_not_before = int(np.searchsorted(self.arcs, arc, side="left"))
        hi = min(max(first_not_before, 1), len(self.arcs) - 1)
        lo = hi - 1

        def value(column: Array) -> Array:
            return (column[hi] - column[lo]) / (self.arcs[hi] - self.arcs[lo]) * (
                arc - self.arcs[lo]
            ) + column[lo]

        return Place(
            heading=float(value(self.headings)),
            curvature=float(value(self.curvatures)),
            to_right=float(np.hypot(*(point - value(self.right)))),
            to_left=float(np.hypot(*(point - value(self.left)))),
            width=float(value(self.widths)),
        )

    def outside(self, point: Array) -> bool:
        """Whether `point` is off the lane."""
        place = self.at(point)
        return (
            place.to_right - place.width > self.inner_buffer
            or place.to_left - place.width > self.outer_buffer
        )
