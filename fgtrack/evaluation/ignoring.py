"""What the truth says is not to be judged: objects of a neighbouring class, and regions nobody has labelled.

As in the evaluation of the KITTI data set (Geiger, Lenz, Urtasun 2012): a track that is paired with an ignored object,
or with none and lies in an ignored region, is neither right nor false; and no track need be there.
"""

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.geometry import in_polygon
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.io.run import Run, Table

__all__ = ["ignored_objects", "in_regions"]


def ignored_objects(ignored: Table) -> Table:
    """The rows of `ignored` that are objects, with the columns of a truth that says no more than where they are."""
    rows = ignored.where(ignored["outline_m"] == "")
    unknown = np.full(rows.num_rows, np.nan)
    return Table({**rows, **dict.fromkeys(("yaw_rad", "speed_mps", "yaw_rate_radps"), unknown)})


def in_regions(run: Run, stamps_ns: IntArray, points_m: FloatArray) -> BoolArray:
    """Whether each of `points_m`, shape (n, 2), at `stamps_ns`, shape (n,), lies in an ignored region; shape (n,).

    Between two stamps of the truth the regions of the nearer one count.
    """
    regions = run.tables["ignored"].where(run.tables["ignored"]["outline_m"] != "")
    found = np.zeros(len(stamps_ns), dtype=np.bool_)
    if not regions.num_rows:
        return found
    known_ns = np.union1d(run.tables["truth"]["stamp_ns"], run.tables["ignored"]["stamp_ns"])
    nearest_ns = known_ns[np.searchsorted(known_ns[:-1] + np.diff(known_ns) // 2, stamps_ns)]
    for stamp_ns, text in zip(regions["stamp_ns"], regions["outline_m"], strict=True):
        rows = np.flatnonzero((nearest_ns == stamp_ns) & ~found)
        if len(rows):
            found[rows] = in_polygon(points_m[rows], _corners(run, text))
    return found


def _corners(run: Run, text: str) -> FloatArray:
    try:
        return np.array(text.split(), dtype=np.float64).reshape(-1, 2)
    except ValueError as error:
        raise DataError(f"{run.path}: ignored.csv holds a bad outline ({error}), repeat the run") from error
