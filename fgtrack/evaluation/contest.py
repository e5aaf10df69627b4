"""Runs of one recording against each other: paired differences of their errors, at the same objects and stamps.

The sums behind a value are kept for every stamp, so that the difference of two runs has the interval of a block
bootstrap over time (`fgtrack.evaluation.paired`).
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.consistency import position_nees
from fgtrack.evaluation.matching import scenes, track_errors
from fgtrack.evaluation.multi_object import gospa
from fgtrack.evaluation.paired import UNKNOWN, Estimate, by_stamp, within_run
from fgtrack.evaluation.ranking import STANDING_NOTE, Entry, ranked, value_column, worse_columns
from fgtrack.evaluation.recordings import by_recording
from fgtrack.evaluation.runs import JudgedRun
from fgtrack.evaluation.tables import Column, Table
from fgtrack.io.run import EvaluationConfig

_SEED = 20040101  # of the bootstrap: the same runs give the same intervals

#: Quantities that are root mean squares, and the errors that they are made of.
_ERRORS = {"position_rmse_m": "position_m", "speed_rmse_mps": "speed_mps", "yaw_rmse_rad": "yaw_rad"}
POSITION_NEES = "position_nees"
"""The quantity that is the better the nearer it is to 2."""

_HEADINGS = {
    "position_rmse_m": "pos. [m]",
    "speed_rmse_mps": "speed [m/s]",
    "yaw_rmse_rad": "yaw [rad]",
    "position_nees": "NEES pos.",
    "gospa_in_sight_rms_m": "GOSPA [m]",
}
_MAIN = ("position_rmse_m", "gospa_in_sight_rms_m")
BEST_NOTE = "bold: the best run of its recording in this, with 95 % confidence"
"""What a bold value means in a table of runs."""
_LARGE_SHARE = 0.9  # of the samples that all runs have in common; below it the note says how many


@dataclass(frozen=True)
class Quantity:
    """What runs are compared in; less is better, but for the NEES."""

    name: str
    """With its unit: `position_rmse_m`."""
    entries: tuple[Entry, ...]
    """From the best run to the worst."""


@dataclass(frozen=True)
class Contest:
    """Runs of one recording."""

    runs: tuple[str, ...]
    samples: int
    """Objects and stamps at which all runs have a paired track."""
    most_samples: int
    """Those of the run with most of them."""
    quantities: tuple[Quantity, ...]
    """Those that all runs have."""


@dataclass(frozen=True)
class _Row:
    quantity: str
    entry: Entry


def contests(runs: Sequence[JudgedRun]) -> list[Contest]:
    """A contest for every recording of which there are several runs; runs without truth take no part."""
    return [_contest(group) for group in judged_alike(runs) if len(group) > 1]


def judged_alike(runs: Sequence[JudgedRun]) -> list[list[JudgedRun]]:
    """The runs with truth, those of the same recording and judged by the same settings together."""
    groups: dict[tuple[int, EvaluationConfig], list[JudgedRun]] = {}
    for number, group in enumerate(by_recording([one for one in runs if one.matching is not None])):
        for one in group:
            groups.setdefault((number, one.options), []).append(one)
    return list(groups.values())


def differences(found: Sequence[Contest]) -> Table:
    """A row for each contest, quantity and run: its value, and how much worse than the best it is."""
    rows = [_Row(q.name, entry) for contest in found for q in contest.quantities for entry in q.entries]
    columns: list[Column[_Row]] = [
        Column("", ("quantity",), lambda row: (row.quantity,)),
        Column("quantity", (), lambda row: (_HEADINGS[row.quantity],), left=True),
        Column("run", ("run",), lambda row: (row.entry.name,), left=True),
        value_column("value", "value", lambda row: row.entry),
        *worse_columns(lambda row: row.entry),
        Column("", ("blocks",), lambda row: ((row.entry.worse_by or UNKNOWN).count,)),
    ]
    notes = [
        "RMSE where all runs track the object; NEES: worse is farther from 2",
        STANDING_NOTE,
    ]
    for contest in found:
        if contest.samples < _LARGE_SHARE * contest.most_samples:
            notes.append(
                f"{', '.join(contest.runs)}: {contest.samples} samples in common, of up to {contest.most_samples}"
            )
    return Table(
        "Differences of runs of the same recording",
        columns,
        rows,
        row_keys=("run", "quantity"),
        notes=notes,
        detail_rows=lambda row: row.quantity not in _MAIN,
    )


def is_best(found: Sequence[Contest], quantity: str, run: str) -> bool:
    """Whether `run` is better than all other runs of its recording, none of which ties with it."""
    quantities = (one for contest in found for one in contest.quantities if one.name == quantity)
    return any(one.entries[0].name == run and one.entries[0].standing == "best" for one in quantities)


class Paired(NamedTuple):
    """What runs of one recording are compared by."""

    samples: int
    """Objects and stamps at which all runs have a paired track."""
    most_samples: int
    """Those of the run with most of them."""
    sums: Mapping[str, FloatArray]
    """By quantity: of every stamp the sum of each run, and in the last column the count, shape (n, runs + 1)."""


def paired_sums(group: Sequence[JudgedRun]) -> Paired:
    """The errors of `group`, runs of one recording, at the same objects and stamps, stamp by stamp."""
    codes, stamps_ns, values = _samples(group)
    common = functools.reduce(np.intersect1d, codes)
    rows = [np.searchsorted(code, common) for code in codes]
    at_ns = stamps_ns[common % len(stamps_ns)]
    sums: dict[str, FloatArray] = {}
    for name in values[0] if len(common) else ():
        sums[name] = by_stamp(at_ns, np.stack([value[name][row] for value, row in zip(values, rows, strict=True)], -1))
    of_gospa = _gospa_sums(group)
    if of_gospa is not None:
        sums["gospa_in_sight_rms_m"] = of_gospa
    return Paired(len(common), max(map(len, codes)), sums)


def _contest(group: Sequence[JudgedRun]) -> Contest:
    found = paired_sums(group)
    labels = tuple(one.label for one in group)
    quantities = [quantity(name, labels, ticks) for name, ticks in found.sums.items() if ticks[:, -1].any()]
    return Contest(labels, found.samples, found.most_samples, tuple(quantities))


def _samples(group: Sequence[JudgedRun]) -> tuple[list[IntArray], IntArray, list[dict[str, FloatArray]]]:
    """Of every run the rising codes of its objects and stamps, and what is averaged there; all stamps.

    A code is the number of the object times the number of stamps, plus the number of the stamp.
    """
    matchings = [one.matching for one in group if one.matching is not None]
    errors, nees = [track_errors(one) for one in matchings], [position_nees(one).values for one in matchings]
    stamps_ns = np.unique(np.concatenate([one.stamps_ns for one in errors]))
    codes, values = [], []
    for one, squares in zip(errors, nees, strict=True):
        every = one.object_index * len(stamps_ns) + np.searchsorted(stamps_ns, one.stamps_ns)
        code, rows = np.unique(every, return_index=True)
        codes.append(code)
        of_errors = {name: np.square(one.values[error][rows]) for name, error in _ERRORS.items()}
        values.append({**of_errors, POSITION_NEES: squares[rows]})
    return codes, stamps_ns, values


def _gospa_sums(group: Sequence[JudgedRun]) -> FloatArray | None:
    """Squared GOSPA in sight of every run, and 1, at the ticks that all have; None where it is not asked for.

    In sight is what a sensor of any run could see, so that all are measured alike; runs that do not know it are not
    asked, unless none does.
    """
    matchings = [one.matching for one in group if one.matching is not None and one.options.multi_object]
    if len(matchings) < len(group):
        return None
    common_ns = functools.reduce(np.intersect1d, [one.scored_ticks_ns for one in group])
    rows = [np.searchsorted(one.scored_ticks_ns, common_ns) for one in group]
    there = [scenes(one.run, matching) for one, matching in zip(group, matchings, strict=True)]
    asked = [k for k, matching in enumerate(matchings) if matching.is_sight_known] or list(range(len(group)))
    seen = np.any([there[k].in_sight[rows[k]] for k in asked], axis=0)
    columns = []
    for one, scene, mine in zip(group, there, rows, strict=True):
        in_sight = scene.in_sight.copy()
        in_sight[mine] = seen
        parts = gospa(replace(scene, in_sight=in_sight), one.options.gate_m)
        columns.append(np.square(parts.in_sight_m[mine]))
    return np.stack([*columns, np.ones(len(common_ns))], axis=-1)


def quantity(name: str, labels: Sequence[str], ticks: FloatArray) -> Quantity:
    """The runs by rising cost, and how much worse than the best they are.

    `ticks` has a column of sums for each run and one of counts, shape (n, runs + 1).
    """
    value_of, cost_of = (_plain, _from_two) if name == POSITION_NEES else (np.sqrt, np.sqrt)
    *numerators, count = ticks.sum(axis=0).tolist()
    means = np.array(numerators) / count

    def worse_by(one: int, best: int) -> Estimate:
        def statistic(S: FloatArray) -> FloatArray:
            return cost_of(S[0] / S[2]) - cost_of(S[1] / S[2])

        return within_run(ticks[:, [one, best, -1]], statistic, np.random.default_rng(_SEED))

    return Quantity(name, ranked(labels, value_of(means), cost_of(means), worse_by))


def _plain(mean: FloatArray) -> FloatArray:
    return mean


def _from_two(mean: FloatArray) -> FloatArray:
    """Distance of a mean NEES of the position from what a consistent estimator has."""
    return np.abs(mean - 2.0)
