"""Comparison of runs of one recording: paired differences of errors at the same objects and stamps."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, sums_by_stamp, within_run
from fgtrack.evaluation.matching import (
    TrackErrors,
    during_truth,
    position_nees,
    scenes,
    track_errors,
)
from fgtrack.evaluation.runs import EvaluatedRun, by_recording
from fgtrack.evaluation.scores.multi_object import gospa
from fgtrack.evaluation.settings import EvaluationConfig, evaluation_settings
from fgtrack.evaluation.tables import Column, Value, short, two_digits

POSITION_NEES = "position_nees"
"""Name of the position NEES. A value near 2 is best."""

STANDING_NOTE = "+: best; ~: not resolved from the best, 0 is in the interval; =: equal up to rounding"
"""Explanation of the marks of `entry_columns`, for a comparison within one run."""

_MARKS: Mapping[Value, str] = {
    "best": "+",
    "unresolved": "~",
    "tie": "=",
    "worse": " ",
}
_ERRORS = {
    "position_rmse_m": "position_m",
    "speed_rmse_mps": "speed_mps",
    "yaw_rmse_rad": "yaw_rad",
}
NEGLIGIBLE = 1e-6
"""A difference below this share of the cost is rounding."""


Standing = Literal["best", "unresolved", "tie", "worse"]


@dataclass(frozen=True)
class Entry:
    """A run or an estimator in the comparison of one quantity."""

    name: str
    """Label of the run, or name of the estimator."""
    value: float
    """Value of the quantity."""
    worse_by: Estimate | None
    """Cost difference to the best entry; None for the best entry itself."""
    standing: Standing
    """Rank: `best`, `unresolved`, `tie` or `worse`.

    `unresolved`: the interval of the difference contains 0, or is not known, although
    the means differ. `tie`: the whole interval is rounding. The first entry is `best`
    only if all others are worse.
    """


@dataclass(frozen=True)
class Comparison:
    """Comparison of the runs of one recording."""

    runs: tuple[str, ...]
    """Labels of the runs."""
    samples: int
    """Number of pairs (object, stamp) at which all runs have a matched track."""
    most_samples: int
    """Largest number of samples of a single run."""
    quantities: Mapping[str, tuple[Entry, ...]]
    """Entries by quantity, best first. The name of a quantity contains its unit.

    Contains only quantities that all runs have.
    """
    sums: Mapping[str, FloatArray] = field(default_factory=dict)
    """Sums at every stamp by quantity, shape (n, runs + 1): of each run, then the number of samples."""


def comparisons(runs: Sequence[EvaluatedRun]) -> list[Comparison]:
    """Return a comparison for every recording with two or more runs with truth."""
    return [comparison(group) for group in comparable(runs) if len(group) > 1]


def comparable(runs: Sequence[EvaluatedRun]) -> list[list[EvaluatedRun]]:
    """Return the runs with truth in groups of one recording and equal evaluation settings."""
    groups: dict[tuple[int, EvaluationConfig], list[EvaluatedRun]] = {}
    for number, group in enumerate(
        by_recording([item for item in runs if item.matching is not None])
    ):
        for item in group:
            groups.setdefault((number, evaluation_settings(item.run)), []).append(item)
    return list(groups.values())


def ranked(
    names: Sequence[str],
    values: Sequence[float] | FloatArray,
    costs: Sequence[float] | FloatArray,
    worse_by: Callable[[int, int], Estimate],
) -> tuple[Entry, ...]:
    """Return the entries in ascending order of `costs`.

    `worse_by` returns the cost of one index minus the cost of another.
    """
    best, *others = np.argsort(costs, kind="stable").tolist()
    differences = {k: worse_by(k, best) for k in others}
    rounding = NEGLIGIBLE * float(np.max(costs))
    standings: dict[int, Standing] = {}
    for k, d in differences.items():
        if max(abs(d.low), abs(d.high)) <= rounding:
            standings[k] = "tie"
        else:
            is_worse = d.is_significant and d.high > rounding
            standings[k] = "worse" if is_worse else "unresolved"
    first: Standing = "best"
    if "unresolved" in standings.values():
        first = "unresolved"
    elif "tie" in standings.values():
        first = "tie"
    return (
        Entry(names[best], float(values[best]), None, first),
        *(
            Entry(names[k], float(values[k]), d, standings[k])
            for k, d in differences.items()
        ),
    )


def entry_record(entry: Entry, name: str = "value") -> dict[str, Any]:
    """Return the record of a table row that `entry_columns` formats; `name` is the key of the entry's value."""
    worse = entry.worse_by or UNKNOWN
    values = {"run": entry.name, name: entry.value, "standing": entry.standing}
    return values | {"worse_by": worse.mean, "low": worse.low, "high": worse.high}


def entry_columns(heading: str, name: str = "value") -> list[Column]:
    """Return columns for the value and standing of an entry, and its difference to the best.

    The value of the best entry is bold, unless another entry ties with it.
    """
    return [
        Column(
            heading,
            f"{name} standing",
            "{} {}",
            text=lambda value: _MARKS.get(value, "") or short(value),
            bold=lambda record: bool(record["standing"] == "best"),
        ),
        Column("worse\nby", "worse_by", text=two_digits),
        Column("95 % interval", "low high", "{} to {}", text=two_digits),
    ]


def comparison(group: Sequence[EvaluatedRun]) -> Comparison:
    """Compare the runs of one recording in `group`, at equal objects and stamps."""
    errors = []
    for matching in (item.matching for item in group if item.matching is not None):
        errors_of = track_errors(matching)
        squares = {
            name: np.square(errors_of.values[error]) for name, error in _ERRORS.items()
        }
        errors.append(
            replace(
                errors_of, values={**squares, POSITION_NEES: position_nees(matching)}
            )
        )
    most, common, sums = common_sums(errors)
    if all(evaluation_settings(item.run).multi_object for item in group):
        sums["gospa_in_view_rms_m"] = _gospa_sums(group)
    labels = tuple(item.label for item in group)
    quantities = {
        name: compared(name, labels, ticks)
        for name, ticks in sums.items()
        if ticks[:, -1].any()
    }
    return Comparison(labels, common, most, quantities, sums)


def common_sums(every: Sequence[TrackErrors]) -> tuple[int, int, dict[str, FloatArray]]:
    """Return sums by stamp of the values of several runs, at the objects and stamps that all have.

    Returns the largest number of samples of a run, the number of common samples, and
    the sums by name. The sums have the shape (n, runs + 1): the sum of each run, then
    the count.
    """
    every_ns = np.unique(np.concatenate([item.stamps_ns for item in every]))
    codes = [
        item.object_index * len(every_ns) + np.searchsorted(every_ns, item.stamps_ns)
        for item in every
    ]
    samples = [np.unique(code, return_index=True) for code in codes]
    common = functools.reduce(np.intersect1d, [distinct for distinct, _ in samples])
    rows = [first[np.searchsorted(distinct, common)] for distinct, first in samples]
    sums = {}
    for name in every[0].values if len(common) else ():
        values = np.stack(
            [item.values[name][row] for item, row in zip(every, rows, strict=True)],
            axis=-1,
        )
        sums[name] = sums_by_stamp(every_ns[common % len(every_ns)], values)
    return max(len(distinct) for distinct, _ in samples), len(common), sums


def compared(name: str, labels: Sequence[str], ticks: FloatArray) -> tuple[Entry, ...]:
    """Return the entries of one quantity in ascending order of cost.

    `ticks` are sums by stamp, see `common_sums`. The cost is the root of the mean
    square. For a NEES it is the distance of the mean from 2.
    """
    is_nees = name == POSITION_NEES

    def cost(mean: FloatArray) -> FloatArray:
        return np.abs(mean - 2.0) if is_nees else np.sqrt(mean)

    def worse_by(one: int, best: int) -> Estimate:
        sums = ticks[:, [one, best, -1]]
        return within_run(sums, lambda S: cost(S[0] / S[2]) - cost(S[1] / S[2]))

    *numerators, count = ticks.sum(axis=0).tolist()
    means = np.array(numerators) / count
    return ranked(labels, means if is_nees else np.sqrt(means), cost(means), worse_by)


def _gospa_sums(group: Sequence[EvaluatedRun]) -> FloatArray:
    """Return squared GOSPA of each run and a count of 1, at the ticks that all runs have.

    It covers the objects that a sensor of any run could see.
    """
    matchings = [item.matching for item in group if item.matching is not None]
    ticks_ns = [
        item.now_ns[during_truth(each.run, item.now_ns)]
        for each, item in zip(group, matchings, strict=True)
    ]
    common_ns = functools.reduce(np.intersect1d, ticks_ns)
    rows = [np.searchsorted(item, common_ns) for item in ticks_ns]
    there = [
        scenes(item.run, matching)
        for item, matching in zip(group, matchings, strict=True)
    ]
    seen = np.any(
        [scene.in_view[mine] for scene, mine in zip(there, rows, strict=True)], axis=0
    )
    columns = []
    for item, scene, mine in zip(group, there, rows, strict=True):
        in_view = scene.in_view.copy()
        in_view[mine] = seen
        squares_m2 = gospa(
            replace(scene, in_view=in_view), evaluation_settings(item.run).gate_m
        )
        columns.append(squares_m2["in_view_m2"][mine])
    return np.stack([*columns, np.ones(len(common_ns))], axis=-1)
