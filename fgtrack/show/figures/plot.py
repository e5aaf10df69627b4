"""Figures of runs by name. Each function takes runs or their folders, and returns a matplotlib Figure.

`errors([run, other]).savefig("errors.pdf")` writes a figure.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.tables.seeds import SweepTable
from fgtrack.show.figures.arrivals import arrivals
from fgtrack.show.figures.close_up import close_up
from fgtrack.show.figures.consistency import consistency, has_squares
from fgtrack.show.figures.errors import errors, lag
from fgtrack.show.figures.map import tracks_on_map as map  # noqa: A004  # the public name
from fgtrack.show.figures.paper import Paper
from fgtrack.show.figures.residuals import residuals
from fgtrack.show.figures.style import save
from fgtrack.show.figures.sweep import (
    error_against_delay,
    has_delays,
    sweep,
    sweep_metrics,
)
from fgtrack.show.figures.window import window

__all__ = [
    "arrivals",
    "close_up",
    "consistency",
    "error_against_delay",
    "errors",
    "lag",
    "map",
    "residuals",
    "sweep",
    "window",
]


def __dir__() -> list[str]:
    """Return the names of the figures, for completion of `fgtrack.plot.`."""
    return sorted(__all__)


# Number of figures per kind, for the worst of many objects or runs.
_SHOWN = 3
# Largest number of runs that all have their own figures.
_MOST_RUNS = 6


@dataclass(frozen=True)
class Planned:
    """A figure that can be drawn."""

    name: str
    draw: Callable[..., Figure]
    """Function that draws the figure; it takes the keyword arguments of `Paper`."""
    is_extra: bool = False
    """True for a figure that is drawn only on request, because there are many figures of its kind."""


def planned(runs: Sequence[EvaluatedRun]) -> list[Planned]:
    """Return all figures that `runs` have data for.

    With many objects or runs, only some figures of each kind are drawn by default, the
    others are extras. These are the figures of the runs and objects with the largest
    errors. Of the figures of arrivals they are the first ones.
    """
    extra = (
        {one.label for one in sorted(runs, key=_rmse_m)[:-_SHOWN]}
        if len(runs) > _MOST_RUNS
        else set()
    )
    plans = []
    for name, draw, has_data in (
        ("map", map, lambda one: one.run.tables["tracks"].num_rows),
        (
            "residuals",
            residuals,
            lambda one: any(each.residuals for each in one.metrics.sensors.values()),
        ),
        ("consistency", consistency, has_squares),
    ):
        mine = [one for one in runs if has_data(one)]
        plans += [
            Planned(f"{name}_{one.label}", partial(draw, one), one.label in extra)
            for one in mine
        ]
    # Estimators on the same data share the figure of arrivals.
    streams: dict[bytes, EvaluatedRun] = {}
    for one in runs:
        if (receipts_ns := one.run.tables["updates"]["receipt_ns"]).size:
            streams.setdefault(np.sort(receipts_ns).tobytes(), one)
    for k, one in enumerate(streams.values()):
        ending = f"_{one.label}" if len(streams) > 1 else ""
        is_extra = len(streams) > _MOST_RUNS and k >= _SHOWN
        plans.append(Planned(f"arrivals{ending}", partial(arrivals, one), is_extra))
    ids = sorted({k for one in runs if one.matching for k in one.matching.object_ids})
    worst = sorted(
        ids, key=lambda object_id: max(_rmse_m(one, object_id) for one in runs)
    )[-_SHOWN:]
    if len(ids) > _SHOWN:
        plans.append(Planned("errors_all_objects", partial(errors, runs)))
    plans += [
        Planned(f"errors_object_{k}", partial(errors, runs, k), k not in worst)
        for k in ids
    ]
    if any(entry.is_lagged for one in runs for entry in one.metrics.lagged):
        plans.append(Planned("error_against_lag", partial(lag, runs)))
    return plans


def _rmse_m(one: EvaluatedRun, object_id: int | None = None) -> float:
    """Position RMSE of a run over one object, or over all objects.

    Infinity if no object is tracked, -1 without truth.
    """
    truth = one.metrics.truth
    if truth is None or (object_id is not None and object_id not in truth.objects):
        return -1.0
    errors_m = (
        truth.overall if object_id is None else truth.objects[object_id]
    ).errors["position_m"]
    return errors_m.rmse if errors_m.count else np.inf


def planned_sweep(table: SweepTable) -> list[Planned]:
    """Return the figures of a sweep: one for each metric, most of them extras, and the error against delay."""
    first, rest = sweep_metrics(table)
    plans = [
        Planned(f"sweep_{metric}", partial(sweep, table, metric), metric in rest)
        for metric in (*first, *rest)
    ]
    if has_delays(table):
        plans.insert(
            0, Planned("error_against_delay", partial(error_against_delay, table))
        )
    return plans


def drawn(
    plans: Iterable[Planned], every: bool = False, **paper: Unpack[Paper]
) -> Iterator[tuple[str, Figure]]:
    """Draw `plans` and return the figures with their names; extras only if `every` is True."""
    return (
        (item.name, item.draw(**paper)) for item in plans if every or not item.is_extra
    )


def save_named(
    named: Iterable[tuple[str, Figure]], folder: Path, form: str
) -> list[Path]:
    """Write each figure into `folder`, to a file with its name, and return the paths."""
    slug = re.compile(r"[^A-Za-z0-9.-]+")
    return [
        save(figure, folder / f"{slug.sub('_', name).strip('_')}.{form}")
        for name, figure in named
    ]
