"""Runs of one recording compared: paired differences of their errors, at the same objects and stamps."""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import UNKNOWN, Estimate, by_stamp, within_run
from fgtrack.evaluation.matching import (
    TrackErrors,
    position_nees,
    recorded,
    scenes,
    track_errors,
)
from fgtrack.evaluation.runs import EvaluatedRun, by_recording
from fgtrack.evaluation.scores.multi_object import gospa
from fgtrack.evaluation.settings import EvaluationConfig, evaluation_settings
from fgtrack.evaluation.tables import Column, Value, short, two_digits

POSITION_NEES = "position_nees"
"""The quantity that is the better the nearer it is to 2."""

STANDING_NOTE = "+: best; =: not resolved from the best, 0 is in the interval"
"""Meaning of the marks of `entry_columns`, for a table within a run."""

_MARKS: Mapping[Value, str] = {"best": "+", "tie": "=", "worse": " "}
_ERRORS = {
    "position_rmse_m": "position_m",
    "speed_rmse_mps": "speed_mps",
    "yaw_rmse_rad": "yaw_rad",
}
NEGLIGIBLE = 1e-6
"""Share of a cost that is rounding: of sums in another order."""


@dataclass(frozen=True)
class Entry:
    """A run or an estimator, compared in one quantity."""

    name: str
    value: float
    worse_by: Estimate | None
    """Difference to the best; None of the best itself."""
    standing: Literal["best", "tie", "worse"]
    """`tie` where the interval of the difference contains 0 or nothing but rounding; `best` only without any tie."""


@dataclass(frozen=True)
class Comparison:
    """Runs of one recording."""

    runs: tuple[str, ...]
    """Labels."""
    samples: int
    """Objects and stamps at which all runs have a paired track."""
    most_samples: int
    """Samples of the run with most of them."""
    quantities: Mapping[str, tuple[Entry, ...]]
    """By name, with the unit in it, the entries from the best to the worst; those that all runs have."""
    sums: Mapping[str, FloatArray] = field(default_factory=dict)
    """By quantity: of every stamp the sum of each run, and in the last column the count, shape (n, runs + 1)."""


def comparisons(runs: Sequence[EvaluatedRun]) -> list[Comparison]:
    """A comparison for every recording of which there are several runs with truth."""
    return [comparison(group) for group in comparable(runs) if len(group) > 1]


def comparable(runs: Sequence[EvaluatedRun]) -> list[list[EvaluatedRun]]:
    """The runs with truth, those of the same recording and evaluated by the same settings together."""
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
    """Entries from the least of the `costs` to the largest; `worse_by` gives the cost of one index minus another's."""
    best, *others = np.argsort(costs, kind="stable").tolist()
    differences = {k: worse_by(k, best) for k in others}
    rounding = NEGLIGIBLE * float(np.max(costs))
    worse = {k: d.is_significant and d.high > rounding for k, d in differences.items()}
    return (
        Entry(
            names[best],
            float(values[best]),
            None,
            "best" if all(worse.values()) else "tie",
        ),
        *(
            Entry(names[k], float(values[k]), d, "worse" if worse[k] else "tie")
            for k, d in differences.items()
        ),
    )


def entry_record(entry: Entry, name: str = "value") -> dict[str, Any]:
    """Numbers of an entry, its value as `name`, which `entry_columns` show."""
    worse, values = (
        entry.worse_by or UNKNOWN,
        {"run": entry.name, name: entry.value, "standing": entry.standing},
    )
    return values | {"worse_by": worse.mean, "low": worse.low, "high": worse.high}


def entry_columns(heading: str, name: str = "value") -> list[Column]:
    """The value of an entry with its standing, the best one bold, and how much worse it is."""
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
    """Return the comparison of `group`, runs of one recording, at the same objects and stamps."""
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
    """Return the sums by stamp of the values of several runs at the objects and stamps that all have.
    The most samples of a run, the common ones, and by name the sums of each run and, last, the counts: (n, runs + 1).
    """
    every_ns = np.unique(np.concatenate([item.stamps_ns for item in every]))
    codes = [
        item.object_index * len(every_ns) + np.searchsorted(every_ns, item.stamps_ns)
        for item in every
    ]
    samples = [np.unique(of, return_index=True) for of in codes]
    common = functools.reduce(np.intersect1d, [distinct for distinct, _ in samples])
    rows = [first[np.searchsorted(distinct, common)] for distinct, first in samples]
    sums = {}
    for name in every[0].values if len(common) else ():
        values = np.stack(
            [item.values[name][row] for item, row in zip(every, rows, strict=True)],
            axis=-1,
        )
        sums[name] = by_stamp(every_ns[common % len(every_ns)], values)
    return max(len(distinct) for distinct, _ in samples), len(common), sums


def compared(name: str, labels: Sequence[str], ticks: FloatArray) -> tuple[Entry, ...]:
    """The runs by rising cost (root of the mean; of a NEES its distance from 2), and the excess over the best."""
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
    """Squared GOSPA, and 1, at the ticks that all runs have, of the objects that a sensor of any run could see."""
    matchings = [item.matching for item in group if item.matching is not None]
    ticks_ns = [
        item.now_ns[recorded(each.run, item.now_ns)]
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
