"""Files of a problem for a program: measurements and queries in, states out."""

import csv
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.ranking.problem import STATE, Answer, Problem

COMPONENTS = ("x_m", "y_m", "range_m", "bearing_rad", "range_rate_mps")
"""Measured components that a scenario may have."""
UPPER = tuple(f"p_{row}_{column}" for row in range(4) for column in range(row, 4))
"""Columns of the upper triangle of a covariance, rows and columns numbered from 0."""
MEASUREMENTS = "measurements.csv"
_COLUMNS = (
    "kind",
    "receipt_s",
    "stamp_s",
    "sensor",
    *COMPONENTS,
    *(f"std_{name}" for name in COMPONENTS),
)


def write_problem(folder: Path, problem: Problem) -> Path:
    """Write `measurements.csv`, `prior.csv` and `problem.json` into `folder`; return the path of the measurements.

    Rows are in the order of receipt. A row of the kind `query` asks for the state at
    its stamp, from the rows above. Times are in s after the start of the problem.
    """
    start_ns = problem.start.stamp_ns
    rows: list[Mapping[str, object]] = []
    known = 0
    for query in problem.queries:
        rows += [_row(problem, number) for number in range(known, query.num_known)]
        known = max(known, query.num_known)
        receipt_ns = problem.arrivals[known - 1].receipt_ns
        rows.append(
            {
                "kind": "query",
                "receipt_s": decimal(receipt_ns - start_ns),
                "stamp_s": decimal(query.stamp_ns - start_ns),
            }
        )
    path = folder / MEASUREMENTS
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    write_states(folder / "prior.csv", [problem.prior])
    (folder / "problem.json").write_text(
        json.dumps(described(problem), indent=2), encoding="utf-8"
    )
    return path


def described(problem: Problem) -> dict[str, object]:
    """Return scenario, motion model, and prior of x, y, vx, vy as JSON values."""
    prior = problem.prior
    assert prior.covariance is not None
    motion = type(problem.motion)
    return {
        "scenario": problem.scenario,
        "motion": motion.__name__.lower(),
        "parameters": {
            name: float(getattr(problem.motion, name))
            for name in motion.density_names()
        },
        "state": list(STATE),
        "mean": prior.mean.tolist(),
        "covariance": prior.covariance.tolist(),
    }


def _row(problem: Problem, number: int) -> Mapping[str, object]:
    each = problem.arrivals[number]
    names = each.measurement.model.components
    stds = np.sqrt(np.diag(each.measurement.R)).tolist()
    start_ns = problem.start.stamp_ns
    return {
        "kind": "measurement",
        "receipt_s": decimal(each.receipt_ns - start_ns),
        "stamp_s": decimal(each.measurement.stamp_ns - start_ns),
        "sensor": each.sensor,
        **dict(zip(names, each.measurement.z.tolist(), strict=True)),
        **{f"std_{name}": std for name, std in zip(names, stds, strict=True)},
    }


def decimal(duration_ns: int) -> str:
    """Return a duration in s with all its nanoseconds."""
    sign = "-" if duration_ns < 0 else ""
    whole, rest = divmod(abs(duration_ns), NS_PER_S)
    return f"{sign}{whole}.{rest:09d}"


def read_states(path: Path, count: int) -> list[Answer | None]:
    """Read the answers to `count` queries; a row with an empty `x_m` is no answer.

    Raises `ValueError` with the line for a wrong number of rows or a value that is no
    number, and `KeyError` for a missing column.
    """
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        require_columns(table, STATE)
        rows = list(table)
    if len(rows) != count:
        raise ValueError(
            f"{count} rows are expected, one for each query, not {len(rows)}"
        )
    return [_answer(row, line) for line, row in enumerate(rows, start=2)]


def require_columns(table: "csv.DictReader[str]", names: Iterable[str]) -> None:
    """Raise `KeyError` with the first of the `names` that is missing in the header."""
    for name in names:
        if name not in (table.fieldnames or ()):
            raise KeyError(name)


def _answer(row: Mapping[str, str], line: int) -> Answer | None:
    if not row[STATE[0]]:
        return None
    mean = np.array([finite_number(row[name], name, line) for name in STATE])
    if not row.get(UPPER[0]):
        return Answer(mean, None)
    upper = np.array([finite_number(row[name], name, line) for name in UPPER])
    covariance: FloatArray = np.zeros((4, 4))
    covariance[np.triu_indices(4)] = upper
    covariance = covariance + np.triu(covariance, 1).T
    return Answer(mean, covariance)


def finite_number(text: str | None, name: str, line: int) -> float:
    """Return the number in a cell of column `name`.

    Raises `ValueError` if the row is too short (None), or the cell is no finite number.
    """
    if text is None:
        raise ValueError(f"line {line}: {name} is missing")
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"line {line}: {name}: {text!r} is not a finite number")
    return value


def write_exact(folder: Path, problem: Problem) -> None:
    """Write `truth.csv` and `exact.csv` into `folder`: a row for each query, as in `states.csv`."""
    with (folder / "truth.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(STATE)
        for query in problem.queries:
            writer.writerow(problem.truth[query.stamp_ns].tolist())
    write_states(folder / "exact.csv", problem.exact)


def write_states(path: Path, answers: Iterable[Answer]) -> None:
    """Write answers with covariances in the columns of `states.csv`."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow((*STATE, *UPPER))
        for answer in answers:
            assert answer.covariance is not None
            upper = answer.covariance[np.triu_indices(4)]
            writer.writerow((*answer.mean.tolist(), *upper.tolist()))
