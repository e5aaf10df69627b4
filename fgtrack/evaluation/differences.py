"""The table of paired differences between runs of one recording."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fgtrack.evaluation.contest import Contest, Entry
from fgtrack.evaluation.paired import UNKNOWN
from fgtrack.evaluation.tables import NO_VALUE, Column, Table, Value, short

_HEADINGS = {
    "position_rmse_m": "pos. [m]",
    "speed_rmse_mps": "speed [m/s]",
    "yaw_rmse_rad": "yaw [rad]",
    "position_nees": "NEES pos.",
    "gospa_in_sight_rms_m": "GOSPA [m]",
}
_MARKS: Mapping[Value, str] = {"best": "+", "tie": "=", "worse": " "}
_MOST_DECIMALS = 5
_LARGE_SHARE = 0.9  # of the samples that all runs have in common; below it the note says how many


@dataclass(frozen=True)
class _Row:
    quantity: str
    entry: Entry


def differences(contests: Sequence[Contest]) -> Table:
    """A row for each contest, quantity and run: its value, and how much worse than the best it is."""
    rows = [_Row(q.name, entry) for contest in contests for q in contest.quantities for entry in q.entries]

    def interval(row: _Row) -> tuple[Value, ...] | None:
        found = row.entry.worse_by
        return (found.low, found.high) if found is not None and found.is_known else None

    columns: list[Column[_Row]] = [
        Column("", ("quantity",), lambda row: (row.quantity,)),
        Column("quantity", (), lambda row: (_HEADINGS[row.quantity],), left=True),
        Column("run", ("run",), lambda row: (row.entry.run,), left=True),
        Column(
            "value  ",
            ("value", "standing"),
            lambda row: (row.entry.value, row.entry.standing),
            "{} {}",
            text=lambda value: _MARKS.get(value, "") or short(value),
            bold=lambda row: row.entry.standing == "best",
        ),
        Column(
            "worse\nby",
            ("worse_by",),
            lambda row: None if row.entry.worse_by is None else (row.entry.worse_by.mean,),
            text=two_digits,
        ),
        Column("95 % interval", ("low", "high"), interval, "{} to {}", text=two_digits),
        Column("", ("blocks",), lambda row: ((row.entry.worse_by or UNKNOWN).count,)),
    ]
    notes = [
        "RMSE where all runs track the object; NEES: worse is farther from 2",
        "+: best; =: ties with the best, as the interval has 0 inside (block bootstrap)",
    ]
    for contest in contests:
        if contest.samples < _LARGE_SHARE * contest.most_samples:
            notes.append(
                f"{', '.join(contest.runs)}: {contest.samples} samples in common, of up to {contest.most_samples}"
            )
    return Table("Differences of runs of the same recording", columns, rows, row_keys=("run", "quantity"), notes=notes)


def two_digits(value: Value) -> str:
    """`value` with two significant digits and at most five decimals, whole numbers in full; a dash for NaN."""
    if isinstance(value, str | int):
        return str(value)
    if not math.isfinite(value):
        return NO_VALUE
    size = abs(float(f"{value:.1e}"))
    if round(size, _MOST_DECIMALS) == 0.0:
        return "0"
    decimals = min(max(0, 1 - math.floor(math.log10(size))), _MOST_DECIMALS)
    return f"{value:.{decimals}f}"
