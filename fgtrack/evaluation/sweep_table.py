"""The table of a sweep: mean and standard error over the seeds at every point of its grid."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgtrack.core.errors import CallError, DataError, did_you_mean
from fgtrack.core.files import open_text

SWEEP_FILE = "sweep.csv"
_SEED, _ESTIMATOR = "seed", "estimator"


@dataclass(frozen=True)
class PointMean:
    """A metric of one estimator at one point of the grid."""

    point: tuple[str, ...]
    """Cells of the axes."""
    estimator: str
    mean: float
    standard_error: float
    """Of the mean over the seeds; NaN of one seed."""
    seeds: int
    """Seeds with a value."""


@dataclass(frozen=True)
class SweepTable:
    """The rows of sweep.csv."""

    axes: tuple[str, ...]
    """Columns that make a point of the grid."""
    metrics: tuple[str, ...]
    """Columns of the metrics."""
    rows: Sequence[Mapping[str, str]]

    @property
    def shown_axes(self) -> tuple[str, ...]:
        """Axes that vary and tell the points apart, without those of whole mappings where labels do it."""
        varying = [axis for axis in self.axes if len({row[axis] for row in self.rows}) > 1]
        points = [tuple(row[axis] for axis in varying) for row in self.rows]
        return tuple(varying[k] for k in telling(points, len(varying)))

    def means(self, metric: str, axes: Sequence[str] | None = None) -> list[PointMean]:
        """Mean and standard error of `metric` at every point and of every estimator, in the order of the table.

        `axes` are those that make a point, by default `shown_axes`. Cells that are empty or no finite number count for
        nothing; a point without any is left out.

        Raises
        ------
        CallError
            There is no such metric.
        """
        if metric not in self.metrics:
            hint = did_you_mean(metric, self.metrics) or f", there are {', '.join(self.metrics[:5])} ..."
            raise CallError(f"{metric}: the sweep has no such metric{hint}")
        axes = self.shown_axes if axes is None else axes
        values: dict[tuple[tuple[str, ...], str], list[float]] = {}
        for row in self.rows:
            value = number(row[metric])
            if math.isfinite(value):
                values.setdefault((tuple(row[axis] for axis in axes), row[_ESTIMATOR]), []).append(value)
        return [PointMean(*key, *_mean(found), len(found)) for key, found in values.items()]


def read_sweep(folder: Path | str) -> SweepTable:
    """The table of the sweep in `folder`.

    Raises
    ------
    CallError
        There is none.
    DataError
        It is no table of a sweep, or has no rows.
    """
    path = Path(folder) / SWEEP_FILE
    try:
        with open_text(path, newline="") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise CallError(f"{path}: cannot be read ({error.strerror}), make one with `fgtrack sweep`") from error
    except (csv.Error, UnicodeDecodeError) as error:
        raise DataError(f"{path}: is no table ({error}), repeat the sweep") from error
    columns = list(rows[0]) if rows else []
    if _SEED not in columns or _ESTIMATOR not in columns or any(None in row.values() for row in rows):
        raise DataError(f"{path}: holds no rows of a sweep, repeat it")
    place = columns.index(_SEED)
    return SweepTable(tuple(columns[:place]), tuple(columns[place + 2 :]), rows)


def is_sweep(folder: Path) -> bool:
    """Whether `folder` holds the table of a sweep."""
    return (folder / SWEEP_FILE).is_file()


def telling(points: Iterable[tuple[str, ...]], num_axes: int) -> list[int]:
    """Which axes tell `points` apart, without those of whole mappings where labels do it."""
    distinct = set(points)
    plain = [k for k in range(num_axes) if not any(point[k].startswith(("{", "[")) for point in distinct)]
    told = {tuple(point[k] for k in plain) for point in distinct}
    return plain if len(told) == len(distinct) else list(range(num_axes))


def number(cell: str) -> float:
    """The number in a cell; NaN where there is none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _mean(values: Sequence[float]) -> tuple[float, float]:
    error = float(np.std(values, ddof=1)) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return float(np.mean(values)), error
