"""The table of what failed inside estimators."""

from collections.abc import Sequence

from fgtrack.estimation.failures import Failure
from fgtrack.evaluation.metrics import Metrics
from fgtrack.evaluation.table_rows import Row, run_column
from fgtrack.evaluation.tables import Column, Table
from fgtrack.tracking.soundness import IN_A_ROW, RARE

_NOTES = {
    Failure.DIVERGED: (
        f"diverged: {IN_A_ROW} measurements in a row with a NIS that fewer than 1 in {1.0 / RARE:,.0f} should have"
    ),
    Failure.NOT_FINITE: "not finite: states that were not published, for that reason",
    Failure.NOT_DEFINITE: "not positive definite: covariances that were not published, for that reason",
    Failure.OUT_OF_BOUNDS: "out of bounds: states that were not published, as no object can have them",
    Failure.TRACK_ENDED: "ended: tracks that failed; their objects may be born again as new tracks",
}


def failures_table(rows: Sequence[Row[Metrics]]) -> Table:
    """A row for each run that counted its failures; without any failure it is a detail."""
    rows = [row for row in rows if row.of.failures]
    absent = [kind for kind in Failure if not any(row.of.failures.get(kind) for row in rows)]

    def column(kind: Failure) -> Column[Row[Metrics]]:
        return Column(
            "" if kind in absent else kind.value.replace(" ", "\n"),
            (kind.value.replace(" ", "_"),),
            lambda row: (row.of.failures.get(kind, 0),),
            note=_NOTES.get(kind, ""),
        )

    columns = [run_column(rows), *map(column, Failure)]
    columns.append(Column("sum", ("failures",), lambda row: (sum(row.of.failures.values()),)))
    own = [f"none: {', '.join(absent)}"] if absent else []
    return Table("Failures inside the estimator", columns, rows, notes=own, detail=len(absent) == len(Failure))
