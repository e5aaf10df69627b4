"""The figure of runs that differ by their seed only: error bands."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.evaluation.consistency import nees_over_runs, position_nees
from fgtrack.evaluation.matching import Matching, track_errors
from fgtrack.evaluation.palette import Look, looks
from fgtrack.evaluation.runs import JudgedRun, Runs, judged, start_ns
from fgtrack.evaluation.statistics import chi_square_band
from fgtrack.plotting.paper import Paper, Sheet, styled
from fgtrack.plotting.style import GREY, broken_line, legend_above, log_axis, usual_step_ns

_QUANTITIES = {"position_m": "position RMSE [m]", "speed_mps": "speed RMSE [m/s]", "yaw_rad": "yaw RMSE [rad]"}
_EDGES = (0.1, 0.9)  # of the bands: quantiles over the runs
_SAME_LENGTH = 0.02  # of the ticks by which runs of several seeds may differ


@dataclass(frozen=True)
class Group:
    """Runs of one estimator and configuration on recordings that differ by their seed only."""

    label: str
    runs: tuple[JudgedRun, ...]

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return str(self.runs[0].run.meta.get("estimator") or self.label)


def group_looks(groups: Sequence[Group]) -> list[Look]:
    """Return how the curves of each of `groups` look: colours are those of the estimators."""
    return looks([one.estimator for one in groups])


def grouped(runs: Sequence[JudgedRun]) -> list[Group]:
    """`runs` by estimator, configuration, objects and length; a run like no other is a group by itself.

    Runs of the same recording are not of several seeds: they are groups by themselves.
    """
    found: list[list[JudgedRun]] = []
    for one in runs:
        home = next((group for group in found if all(_is_other_seed(one, other) for other in group)), None)
        if home is None:
            found.append([one])
        else:
            home.append(one)
    labels: dict[str, int] = {}
    groups = []
    for group in found:
        label = group[0].label if len(group) == 1 else f"{_common_name(group)} ({len(group)} runs)"
        labels[label] = labels.get(label, 0) + 1
        groups.append(Group(label if labels[label] == 1 else f"{label} #{labels[label]}", tuple(group)))
    return groups


def has_seeds(runs: Sequence[JudgedRun]) -> bool:
    """Whether any of `runs` differ by their seed only, and have truth."""
    return any(len(group.runs) > 1 and group.runs[0].matching is not None for group in grouped(runs))


@styled
def error_bands(runs: Runs, **paper: Unpack[Paper]) -> Figure:
    """Errors over time of runs that differ by their seed only: RMSE over the runs, and 10 to 90 % of them.

    Runs of the same estimator and configuration, of as many ticks and with the same objects, are a line and a band;
    times are those after the first tick of each. Below the NEES of the position, averaged over the runs, with the
    band in which 95 % of a consistent estimator's lie: errors of different runs are independent, so this test is
    sharper than that of one run.

    Raises
    ------
    DataError
        No two runs differ by their seed only, or they have no truth.
    """
    groups = [group for group in grouped(judged(runs)) if len(group.runs) > 1 and group.runs[0].matching is not None]
    if not groups:
        raise DataError("no runs with truth differ by their seed only, so there are no error bands to draw")
    sheet = Sheet(10.0, 1.2 + 2.1 * (len(_QUANTITIES) + 1), paper)
    *rows, below = sheet.plots(len(_QUANTITIES) + 1, sharex=True)[:, 0]
    for group, its in zip(groups, group_looks(groups), strict=True):
        for axes, name in zip(rows, _QUANTITIES, strict=True):
            _draw_band(axes, group, name, its)
        _draw_nees(below, group, its, group is groups[0])
    below.fill_between([], [], color=GREY, alpha=0.25, lw=0, label="95 % band")
    for axes, label in zip(rows, _QUANTITIES.values(), strict=True):
        axes.set_ylabel(label)
        axes.set_ylim(0.0, None)
    below.set(ylabel="NEES of the position", yscale="log", xlabel="time since the first tick [s]")
    log_axis(below.yaxis)
    for axes in (rows[0], below):
        legend_above(axes)
    sheet.title("Errors over seeds: RMSE over the runs, shaded 10 to 90 % of the runs")
    return sheet.figure


def _draw_band(axes: Axes, group: Group, name: str, its: Look) -> None:
    times_s, errors = _by_time(group, name)
    known = np.isfinite(errors).any(axis=0)
    if not known.any():
        return
    times_s, errors = times_s[known], errors[:, known]
    rmse = np.sqrt(np.nanmean(errors**2, axis=0))
    low, high = np.nanquantile(errors, _EDGES, axis=0)
    times_ns = np.round(NS_PER_S * times_s).astype(np.int64)
    step_ns = usual_step_ns(times_ns)
    (x_s, low), (_, high), (_, rmse) = (broken_line(times_ns, times_s, y, step_ns) for y in (low, high, rmse))
    axes.fill_between(x_s, low, high, color=its.colour, alpha=0.2, lw=0)
    axes.plot(x_s, rmse, color=its.colour, ls=its.line, lw=1.2, label=group.label)


def _by_time(group: Group, name: str) -> tuple[FloatArray, FloatArray]:
    """Times in s after the first tick, shape (t,), and the error of each run there, shape (runs, t); NaN for none.

    The error of a run is the root mean square over its objects.
    """
    step_ns = max(usual_step_ns(one.run.tables["timing"]["now_ns"]) for one in group.runs)
    step_ns = step_ns if np.isfinite(step_ns) else NS_PER_S
    columns: list[FloatArray] = []
    for one in group.runs:
        found = track_errors(_matching(one))
        known = np.isfinite(found.values[name])
        place = np.round((found.stamps_ns[known] - start_ns([one])) / step_ns).astype(np.int64)
        place, squares = place[place >= 0], found.values[name][known][place >= 0] ** 2
        count = np.bincount(place)
        with np.errstate(invalid="ignore"):
            columns.append(np.sqrt(np.bincount(place, squares) / count))
    errors = np.full((len(columns), max(map(len, columns))), np.nan)
    for row, column in zip(errors, columns, strict=True):
        row[: len(column)] = column
    return np.arange(errors.shape[1]) * step_ns / NS_PER_S, errors


def _draw_nees(axes: Axes, group: Group, its: Look, has_band: bool) -> None:
    """The mean over runs and objects at every stamp."""
    samples = [position_nees(_matching(one)) for one in group.runs]
    shifted = [
        replace(nees, stamps_ns=nees.stamps_ns - start_ns([one])) for nees, one in zip(samples, group.runs, strict=True)
    ]
    found = nees_over_runs(shifted)
    if not len(found.mean):
        return
    stamps_ns, index = np.unique(found.stamps_ns, return_inverse=True)
    count = np.bincount(index, found.num_runs).astype(np.int64)
    mean = np.bincount(index, found.mean * found.num_runs) / count
    low, high = chi_square_band(2.0 * count.astype(np.float64), count)
    step_ns, time_s = usual_step_ns(stamps_ns), stamps_ns / NS_PER_S
    lines = [broken_line(stamps_ns, time_s, y, step_ns) for y in (mean, low, high)]
    inside = float(((mean >= low) & (mean <= high)).mean())
    text = f"{group.label}: mean {found.overall.mean:.3g}, expected 2; {100.0 * inside:.0f} % of the stamps in the band"
    axes.plot(*lines[0], color=its.colour, ls=its.line, lw=1.0, label=text)
    if has_band:
        axes.fill_between(lines[0][0], lines[1][1], lines[2][1], color=GREY, alpha=0.25, lw=0)
        axes.axhline(2.0, color="black", lw=0.9, ls="--")


def _matching(one: JudgedRun) -> Matching:
    if one.matching is None:
        raise DataError(f"{one.label}: has no truth, so there are no errors to draw")
    return one.matching


def _is_other_seed(one: JudgedRun, other: JudgedRun) -> bool:
    """Whether two runs are of the same estimator, configuration, objects and length, on different recordings."""
    a, b = one.run, other.run
    mine, its = a.tables["updates"], b.tables["updates"]
    ticks = a.tables["timing"].num_rows, b.tables["timing"].num_rows
    return (
        a.meta.get("estimator") == b.meta.get("estimator")
        and a.config_text == b.config_text
        and abs(ticks[0] - ticks[1]) <= _SAME_LENGTH * max(ticks)
        and np.array_equal(np.unique(a.tables["truth"]["object_id"]), np.unique(b.tables["truth"]["object_id"]))
        and not all(np.array_equal(mine[name], its[name]) for name in ("stamp_ns", "receipt_ns"))
    )


def _common_name(group: Sequence[JudgedRun]) -> str:
    """The last part of the labels where it is the same in all, else the estimator."""
    names = {one.label.rpartition("/")[2] for one in group}
    return names.pop() if len(names) == 1 else str(group[0].run.meta.get("estimator", "run"))
