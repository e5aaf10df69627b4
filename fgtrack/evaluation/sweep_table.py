"""The table of a sweep: mean and standard error over the seeds at every point of its grid."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import sem

from fgtrack.core.errors import CallError, DataError, did_you_mean

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
        """Return mean and standard error of `metric` at every point, by estimator, in the order of the table.

        `axes` are those that make a point, by default `shown_axes`. Cells without a finite number are left out, and a
        point without any. Raises `CallError` where there is no such metric.
        """
        if metric not in self.metrics:
            hint = did_you_mean(metric, self.metrics) or f", there are {', '.join(self.metrics[:5])} ..."
            raise CallError(f"{metric}: the sweep has no such metric{hint}")
        axes = self.shown_axes if axes is None else axes
        values: dict[tuple[tuple[str, ...], str], list[float]] = {}
        for row in self.rows:
            if math.isfinite(value := number(row[metric])):
                values.setdefault((tuple(row[axis] for axis in axes), row[_ESTIMATOR]), []).append(value)
        return [
            PointMean(*key, float(np.mean(found)), float(sem(found)) if len(found) > 1 else math.nan, len(found))
            for key, found in values.items()
        ]


def read_sweep(folder: Path | str) -> SweepTable:
    """Return the table of the sweep in `folder`.

    Raises `CallError` where there is none, and `DataError` where it is another table.
    """
    path = Path(folder) / SWEEP_FILE
    try:
        frame = pd.read_csv(path, dtype=str, keep_default_na=False)
    except OSError as error:
        raise CallError(f"{path}: cannot be read ({error.strerror}), make one with `fgtrack sweep`") from error
    except ValueError as error:
        raise DataError(f"{path}: is no table ({error}), repeat the sweep") from error
    columns = list(frame.columns)
    if _SEED not in columns or _ESTIMATOR not in columns or frame.empty:
        raise DataError(f"{path}: holds no rows of a sweep, repeat it")
    index = columns.index(_SEED)
    return SweepTable(tuple(columns[:index]), tuple(columns[index + 2 :]), frame.to_dict("records"))


def is_sweep(folder: Path) -> bool:
    """True if `folder` holds the table of a sweep."""
    return (folder / SWEEP_FILE).is_file()


def telling(points: Iterable[tuple[str, ...]], num_axes: int) -> list[int]:
    """Indices of the axes that tell `points` apart, without those of whole mappings where labels do it."""
    distinct = set(points)
    plain = [k for k in range(num_axes) if not any(point[k].startswith(("{", "[")) for point in distinct)]
    return (
        plain if len({tuple(point[k] for k in plain) for point in distinct}) == len(distinct) else list(range(num_axes))
    )


def number(cell: str) -> float:
    """Number in a cell; NaN where there is none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan
