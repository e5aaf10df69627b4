"""Figures of runs by name: each function takes runs (or their folders) and gives a matplotlib Figure.

`errors([run, other]).savefig("errors.pdf")` writes one, `save_figures(runs, folder)` all that the runs have data for.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from fgtrack.core.errors import CallError
from fgtrack.evaluation import innovations
from fgtrack.evaluation.figures.arrivals import arrivals
from fgtrack.evaluation.figures.close_up import close_up
from fgtrack.evaluation.figures.errors import errors, lag
from fgtrack.evaluation.figures.map import tracks_on_map as map  # noqa: A004  # the name that users know
from fgtrack.evaluation.figures.residuals import residuals
from fgtrack.evaluation.figures.style import save
from fgtrack.evaluation.figures.times import delays, sensor_delays, timing
from fgtrack.evaluation.runs import JudgedRun, Runs, judged

__all__ = [
    "FIGURES",
    "arrivals",
    "close_up",
    "delays",
    "errors",
    "lag",
    "map",
    "residuals",
    "save",
    "save_figures",
    "timing",
]

_Named = Iterator[tuple[str, Figure]]


def _maps(runs: Sequence[JudgedRun]) -> _Named:
    for one in runs:
        if one.run.tracks.num_rows:
            yield f"map_{one.label}", map(one)


def _residuals(runs: Sequence[JudgedRun]) -> _Named:
    for one in runs:
        if any(np.isfinite(values).any() for values in innovations.residuals(one.run).values()):
            yield f"residuals_{one.label}", residuals(one)


def _delays(runs: Sequence[JudgedRun]) -> _Named:
    """One for each recording: runs of the same have the same delays."""
    groups: dict[bytes, list[JudgedRun]] = {}
    for one in runs:
        if one.run.updates.num_rows:
            content = b"".join(part.tobytes() for by in sensor_delays(one.run).values() for part in by)
            groups.setdefault(content, []).append(one)
    for group in groups.values():
        if len(groups) == 1:
            yield "delays", delays(replace(group[0], label=""))
        else:
            yield f"delays_{group[0].label}", delays(replace(group[0], label=", ".join(one.label for one in group)))


def _arrivals(runs: Sequence[JudgedRun]) -> _Named:
    for one in runs:
        if one.run.updates.num_rows:
            yield f"arrivals_{one.label}", arrivals(one)


def _errors(runs: Sequence[JudgedRun]) -> _Named:
    for object_id in sorted({k for one in runs if one.matching for k in one.matching.object_ids}):
        yield f"errors_object_{object_id}", errors(runs, object_id)


def _lag(runs: Sequence[JudgedRun]) -> _Named:
    if any(entry.is_lagged for one in runs for entry in one.lagged):
        yield "error_against_lag", lag(runs)


def _timing(runs: Sequence[JudgedRun]) -> _Named:
    if any((one.run.timing["num_detections"] > 0).any() for one in runs):
        yield "timing", timing(runs)


#: By the name of the function that draws it: the figures that runs have data for, each with the name of its file.
FIGURES: Mapping[str, Callable[[Sequence[JudgedRun]], _Named]] = {
    "map": _maps,
    "residuals": _residuals,
    "arrivals": _arrivals,
    "delays": _delays,
    "errors": _errors,
    "lag": _lag,
    "timing": _timing,
}


def save_figures(runs: Runs, out_dir: Path | str, form: str = "png") -> list[Path]:
    """Write every figure that `runs` have data for into `out_dir`, as png, svg or pdf; gives the files.

    Raises
    ------
    CallError
        The folder cannot be made or written to, or there is no such format.
    DataError
        The map that a run names is no map.
    """
    out_dir, every = Path(out_dir), judged(runs)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CallError(f"{out_dir}: cannot be made ({error.strerror}), choose another folder") from error
    return save_named(named_figures(every), out_dir, form)


def save_named(named: Iterable[tuple[str, Figure]], folder: Path, form: str) -> list[Path]:
    """Write figures into `folder`, each into a file of its name; raises `CallError` as `save`."""
    return [save(figure, folder / f"{_slug(name)}.{form}") for name, figure in named]


def named_figures(runs: Runs) -> _Named:
    """Every figure that `runs` have data for, with its name. Raises `DataError` as `save_figures`."""
    every = judged(runs)
    return (found for figures in FIGURES.values() for found in figures(every))


def _slug(name: str) -> str:
    """`name` as a file name."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", name).strip("_")
