"""Figures of runs by name: each function takes runs (or their folders) and gives a matplotlib Figure.

`errors([run, other]).savefig("errors.pdf")` writes one, `save_figures(runs, folder)` those that the runs have data for.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Unpack

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import CallError
from fgtrack.evaluation import innovations
from fgtrack.evaluation.matching import track_errors
from fgtrack.evaluation.roads import roads
from fgtrack.evaluation.runs import JudgedRun, Runs, judged
from fgtrack.evaluation.statistics import Moments
from fgtrack.evaluation.sweep_table import SweepTable
from fgtrack.plotting.arrivals import arrivals
from fgtrack.plotting.close_up import close_up
from fgtrack.plotting.consistency import consistency, has_squares
from fgtrack.plotting.errors import errors, lag
from fgtrack.plotting.frenet import frenet
from fgtrack.plotting.map import tracks_on_map as map  # noqa: A004  # the name that users know
from fgtrack.plotting.paper import Paper
from fgtrack.plotting.residuals import residuals
from fgtrack.plotting.seeds import error_bands, has_seeds
from fgtrack.plotting.style import save
from fgtrack.plotting.sweep import error_against_delay, sweep, sweep_metrics
from fgtrack.plotting.times import delays, timing

__all__ = [
    "arrivals",
    "close_up",
    "consistency",
    "delays",
    "error_against_delay",
    "error_bands",
    "errors",
    "frenet",
    "lag",
    "map",
    "residuals",
    "sweep",
    "timing",
]


def __dir__() -> list[str]:
    """Return the names of the figures: what `fgtrack.plot.` completes to."""
    return sorted(__all__)


_FEW = 3  # of objects, and of runs where they are many: the worst are drawn
_MOST_RUNS = 6  # that have figures of their own
_DETECTION = ("index", "sensor", "stamp_ns", "receipt_ns")  # what is the same of a detection in all runs


@dataclass(frozen=True)
class Planned:
    """A figure that can be drawn."""

    name: str
    draw: Callable[..., Figure]
    """Takes the keywords of `Paper`."""
    is_extra: bool = False
    """Whether it is one of many, and drawn on request only."""


_Plans = Iterator[Planned]


def _of_each(
    runs: Sequence[JudgedRun], name: str, has_data: Callable[[JudgedRun], bool], draw: Callable[..., Figure]
) -> _Plans:
    """One for each run with data; of many the worst come first."""
    found = [one for one in runs if has_data(one)]
    kept = {one.label for one in found} if len(found) <= _MOST_RUNS else {one.label for one in _worst(found)[:_FEW]}
    for one in found:
        yield Planned(f"{name}_{one.label}", partial(draw, one), one.label not in kept)


def _maps(runs: Sequence[JudgedRun]) -> _Plans:
    return _of_each(runs, "map", lambda one: bool(one.run.tables["tracks"].num_rows), map)


def _along(runs: Sequence[JudgedRun]) -> _Plans:
    def has_data(one: JudgedRun) -> bool:
        return bool(one.run.tables["tracks"].num_rows) and "track" in roads(one.run)[0]

    return _of_each(runs, "frenet", has_data, frenet)


def _residuals(runs: Sequence[JudgedRun]) -> _Plans:
    def has_data(one: JudgedRun) -> bool:
        return any(np.isfinite(values).any() for values in innovations.residuals(one.run).values())

    return _of_each(runs, "residuals", has_data, residuals)


def _consistency(runs: Sequence[JudgedRun]) -> _Plans:
    return _of_each(runs, "consistency", has_squares, consistency)


def _alike(runs: Sequence[JudgedRun], *names: str) -> list[list[JudgedRun]]:
    """Runs with detections, together those whose columns `names` of updates.csv are the same."""
    groups: dict[bytes, list[JudgedRun]] = {}
    for one in runs:
        if one.run.tables["updates"].num_rows:
            updates = one.run.tables["updates"]
            order = np.lexsort([updates[name] for name in _DETECTION])  # estimators may take them in another order
            content = b"".join(updates[name][order].tobytes() for name in (*_DETECTION, *names))
            groups.setdefault(content, []).append(one)
    return list(groups.values())


def _of_groups(groups: Sequence[Sequence[JudgedRun]], name: str, draw: Callable[..., Figure]) -> _Plans:
    """One for each of `groups`; of many the first."""
    for place, group in enumerate(groups):
        label = "" if len(groups) == 1 else ", ".join(one.label for one in group)
        file = name if len(groups) == 1 else f"{name}_{group[0].label}"
        is_extra = len(groups) > _MOST_RUNS and place >= _FEW
        yield Planned(file, partial(draw, replace(group[0], label=label)), is_extra)


def _arrivals(runs: Sequence[JudgedRun]) -> _Plans:
    """One for all runs in which the same became of every detection."""
    return _of_groups(_alike(runs, "disposition"), "arrivals", arrivals)


def _delays(runs: Sequence[JudgedRun]) -> _Plans:
    """One for each recording, but for those without any delay."""
    late = [
        one for one in runs if (one.run.tables["updates"]["receipt_ns"] != one.run.tables["updates"]["stamp_ns"]).any()
    ]
    return _of_groups(_alike(late), "delays", delays)


def _errors(runs: Sequence[JudgedRun]) -> _Plans:
    """Of several seeds only the bands, else one for each object; of many all together and the worst."""
    if has_seeds(runs):
        return
    ids = sorted({k for one in runs if one.matching for k in one.matching.object_ids})
    many = len(ids) > _FEW
    if many:
        yield Planned("errors_all_objects", partial(errors, runs))
    kept = _worst_objects(runs, ids)[:_FEW]
    for object_id in ids:
        yield Planned(f"errors_object_{object_id}", partial(errors, runs, object_id), many and object_id not in kept)


def _error_bands(runs: Sequence[JudgedRun]) -> _Plans:
    if has_seeds(runs):
        yield Planned("error_bands", partial(error_bands, runs))


def _lag(runs: Sequence[JudgedRun]) -> _Plans:
    if any(entry.is_lagged for one in runs for entry in one.lagged):
        yield Planned("error_against_lag", partial(lag, runs))


def _timing(runs: Sequence[JudgedRun]) -> _Plans:
    if any((one.run.tables["timing"]["num_detections"] > 0).any() for one in runs):
        yield Planned("timing", partial(timing, runs))


#: By the name of the function that draws them: the figures that runs have data for, each with the name of its file.
FIGURES: Mapping[str, Callable[[Sequence[JudgedRun]], _Plans]] = {
    "map": _maps,
    "frenet": _along,
    "residuals": _residuals,
    "consistency": _consistency,
    "arrivals": _arrivals,
    "delays": _delays,
    "errors": _errors,
    "error_bands": _error_bands,
    "lag": _lag,
    "timing": _timing,
}


def _rmse_m(one: JudgedRun, object_id: int | None = None) -> float:
    """Position RMSE of a run, of one object or over all; -1 where there is none."""
    if one.matching is None or (object_id is not None and object_id not in one.matching.object_ids):
        return -1.0
    found = track_errors(one.matching)
    values = found.values["position_m"]
    if object_id is not None:
        values = values[found.object_index == one.matching.object_ids.index(object_id)]
    moments = Moments.of(values)
    return moments.rmse if moments.count else -1.0


def _worst(runs: Sequence[JudgedRun]) -> list[JudgedRun]:
    """`runs` from the largest position RMSE to the smallest; those that tracked no true object come first."""

    def badness(one: JudgedRun) -> float:
        lost = one.matching is not None and not one.matching.paired.any()
        return np.inf if lost else _rmse_m(one)

    return sorted(runs, key=badness, reverse=True)


def _worst_objects(runs: Sequence[JudgedRun], ids: Sequence[int]) -> list[int]:
    """`ids` from the largest position RMSE in any run to the smallest."""
    if len(ids) <= _FEW:
        return list(ids)
    return sorted(ids, key=lambda object_id: max(_rmse_m(one, object_id) for one in runs), reverse=True)


def save_figures(
    runs: Runs, out_dir: Path | str, form: str = "png", every: bool = False, **paper: Unpack[Paper]
) -> list[Path]:
    """Write the figures that `runs` have data for into `out_dir`, as png, svg or pdf; gives the files.

    Of many objects and runs the worst few are drawn, all where `every` is set. `paper`: `width`, `font`, `style`.

    Raises
    ------
    CallError
        The folder cannot be made or written to, or there is no such format.
    DataError
        The map that a run names is no map.
    """
    out_dir, found = Path(out_dir), judged(runs)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CallError(f"{out_dir}: cannot be made ({error.strerror}), choose another folder") from error
    return save_named(drawn(planned(found), every, **paper), out_dir, form)


def save_named(named: Iterable[tuple[str, Figure]], folder: Path, form: str) -> list[Path]:
    """Write figures into `folder`, each into a file of its name; raises `CallError` as `save`."""
    return [save(figure, folder / f"{_slug(name)}.{form}") for name, figure in named]


def named_figures(runs: Runs) -> Iterator[tuple[str, Figure]]:
    """The figures that `runs` have data for, with their names; of many the worst few. Raises as `save_figures`."""
    return drawn(planned(judged(runs)))


def planned(runs: Sequence[JudgedRun]) -> list[Planned]:
    """Every figure that `runs` have data for. Raises `DataError` as `save_figures`."""
    return [one for figures in FIGURES.values() for one in figures(runs)]


def planned_sweep(table: SweepTable) -> list[Planned]:
    """The figures of a sweep, one for each metric; a few of them are no extras."""
    first, rest = sweep_metrics(table)
    return [Planned(f"sweep_{metric}", partial(sweep, table, metric), metric in rest) for metric in (*first, *rest)]


def drawn(plans: Iterable[Planned], every: bool = False, **paper: Unpack[Paper]) -> Iterator[tuple[str, Figure]]:
    """The figures of `plans`, with their names; extras only where `every` is set."""
    return ((one.name, one.draw(**paper)) for one in plans if every or not one.is_extra)


def _slug(name: str) -> str:
    """`name` as a file name."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", name).strip("_")
