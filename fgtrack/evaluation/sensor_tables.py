"""Tables of a comparison about the sensors: whether the noise fits, residuals, what became of the detections."""

from collections.abc import Callable, Iterable, Iterator, Sequence

from fgtrack.core.types import FUSED, LATE, Disposition
from fgtrack.evaluation.cautions import USED
from fgtrack.evaluation.consistency import Consistency
from fgtrack.evaluation.innovations import FEWEST, LAGS, RESIDUAL_NAMES, Autocorrelation
from fgtrack.evaluation.metrics import Metrics, SensorMetrics
from fgtrack.evaluation.statistics import ChiSquareMean
from fgtrack.evaluation.table_rows import MS, PERCENT, Row, Values, named, run_column
from fgtrack.evaluation.tables import Column, Table

_UNITS = {"m": "m", "rad": "rad", "mps": "m/s"}

_Square = tuple[ChiSquareMean, Autocorrelation | None]


def consistency_table(rows: Sequence[Row[Metrics]]) -> Table:
    """A row for each run and normalised square: NEES of the present states, NIS and whiteness of every sensor."""
    entries = [Row(row.run, values, name) for row in rows for name, values in _squares(row.of.consistency)]
    columns: list[Column[Row[_Square]]] = [
        run_column(entries),
        Column("of", ("of",), lambda row: (row.part,), left=True),
        Column("samples", ("num_samples",), lambda row: (row.of[0].count,)),
        Column("mean", ("mean",), lambda row: (row.of[0].mean,)),
        Column("expected", ("expected",), lambda row: (row.of[0].dof,)),
        Column("95 % band", ("band_low", "band_high"), lambda row: row.of[0].band, "{} to {}"),
        Column(
            "correlation\nat lag 1",
            ("lag1_correlation", "lag1_band"),
            lambda row: (row.of[1].lag1, row.of[1].lag1_band) if row.of[1] else None,
            "{} ± {}",
        ),
        Column(
            "outside\n[%]",
            ("share_outside",),
            lambda row: (row.of[1].share_outside,) if row.of[1] else None,
            scale=PERCENT,
        ),
    ]
    own = [
        "band: of the mean of independent samples; errors along one run are correlated,",
        "so the NEES of a single run may leave it (average over several runs)",
        f"correlation: of innovations, tracks with {FEWEST}+ of them; ± 95 % band if white",
        f"outside: share of tracks and lags 1 to {LAGS} outside their bands; 5 if white",
    ]
    title = "Consistency (mean NEES and NIS, and their expected values)"
    return Table(title, columns, entries, row_keys=("run", "of"), notes=own, detail=True)


def _squares(found: Consistency) -> Iterator[tuple[str, _Square]]:
    for name, nees in (("NEES position", found.position_nees), ("NEES state", found.state_nees)):
        if nees.count:
            yield name, (nees, None)
    for sensor, nis in found.nis.items():
        if nis.count:
            yield f"NIS {sensor}", (nis, next(iter(found.autocorrelation[sensor].values()), None))


def residuals_table(sensor: str, rows: Sequence[Row[SensorMetrics]]) -> Table:
    """A row for each run with the sensor: mean and standard deviation of the innovations, NIS, delay."""

    def mean_std(name: str) -> Callable[[Row[SensorMetrics]], Values | None]:
        return lambda row: (
            (row.of.residuals[name].mean, row.of.residuals[name].std) if name in row.of.residuals else None
        )

    occurring = [name for name in RESIDUAL_NAMES if any(name in row.of.residuals for row in rows)]
    columns: list[Column[Row[SensorMetrics]]] = [run_column(rows)]
    for name in occurring:
        quantity, _, unit = name.rpartition("_")
        heading = f"{quantity.replace('_', ' ')}\n[{_UNITS[unit]}]"
        if "along_m" in occurring and name in ("x_m", "y_m"):
            heading = ""
        columns.append(Column(heading, (named(name, "mean"), named(name, "std")), mean_std(name), "{} ± {}"))
    columns += [
        Column("NIS", ("nis_mean",), lambda row: (row.of.nis.mean,)),
        Column("NIS\nexpected", ("nis_expected",), lambda row: (row.of.nis_dof.mean,)),
        Column(
            "delay [ms]\nmean/p90",
            ("delay_mean_s", "delay_p90_s"),
            lambda row: (row.of.delay_s.mean, row.of.delay_s.p90),
            "{}/{}",
            MS,
        ),
    ]
    title = f"Residuals of {sensor} (measured minus predicted: mean ± standard deviation)"
    return Table(title, columns, rows, detail=True)


def dispositions_table(rows: Sequence[Row[SensorMetrics]], left_out: Iterable[str] = ()) -> Table:
    """A row for each run and sensor: what became of the detections, and their sum; `left_out` is noted below."""

    def count(*names: Disposition) -> Callable[[Row[SensorMetrics]], Values]:
        return lambda row: (sum(row.of.dispositions[name] for name in names),)

    absent = [name for name in Disposition if not any(row.of.dispositions[name] for row in rows)]
    refused = [name for name in Disposition if name not in USED]
    columns: list[Column[Row[SensorMetrics]]] = [
        run_column(rows),
        Column("sensor", ("sensor",), lambda row: (row.part,), left=True),
        Column("fused", (), count(*FUSED), when="few", note="fused: also those that started a track"),
        Column("late", (), count(*LATE), when="few", note="late: of the fused ones, those out of sequence"),
        Column(
            "merged", (), count(Disposition.MERGED), when="few", note="merged: with another detection of their list"
        ),
        Column("refused", (), count(*refused), when="few"),
        *(Column("" if k in absent else k.replace("_", "\n"), (k.value,), count(k), when="full") for k in Disposition),
        Column("sum", ("detections",), lambda row: (row.of.detections,)),
    ]
    own = [f"no detection was {' or '.join(name.replace('_', ' ') for name in absent)}"] if absent else []
    own += left_out
    title = "Dispositions (what became of every detection)"
    return Table(title, columns, rows, row_keys=("run", "sensor"), notes=own)
