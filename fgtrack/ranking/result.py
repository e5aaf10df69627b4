"""Results of methods: measures, sentences, ranks and tables."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from fgtrack.core.types import FloatArray, IntArray
from fgtrack.evaluation.intervals import average
from fgtrack.evaluation.tables import Column, Table, Tables
from fgtrack.ranking.crowd_result import CrowdResult, crowd_table
from fgtrack.ranking.problem import LAGS_S
from fgtrack.ranking.ranks import WithInterval, interval, positive, ranked
from fgtrack.ranking.scenarios import SCENARIOS

EXACT = 1e-6
"""Largest deviation, in standard deviations, of a method that counts as exact."""
_NUM_STATES = 4
_US = 1e6
_KB = 1e-3


@dataclass(frozen=True)
class Result:
    """Answers of a method in one scenario, compared with truth and exact estimate."""

    method: str
    scenario: str
    rmse_m: FloatArray
    """Root mean square position error by run and lag, shape (runs, lags); NaN without an answer."""
    deviations: FloatArray
    """Largest deviation from the exact mean in standard deviations by run and lag, shape (runs, lags)."""
    nees: FloatArray
    """Mean NEES of the present x, y, vx, vy by run, shape (runs,); NaN without covariances."""
    order: float
    """Largest change of the last answers, in standard deviations, if the arrivals come in another order."""
    refused: Mapping[str, int] | None
    """Number of measurements that were not fused, by reason; None if the method does not report it."""
    seconds: float
    """Time for one measurement."""
    peak_bytes: float = math.nan
    """Largest memory of Python and NumPy during a run; NaN for a program."""
    num_indefinite: int = 0
    """Number of answers whose covariance is not positive definite."""
    answered: IntArray = field(
        default_factory=lambda: np.zeros((len(LAGS_S), 2), dtype=np.int64)
    )
    """Numbers of answers and of queries by lag over the runs, shape (lags, 2)."""
    covariance_deviation: float = math.nan
    """Largest difference of the present covariances from the exact ones, relative to the variances; NaN if unknown."""
    problem: str | None = None
    """Reason why the method has no answers; None if it has."""
    takes_part: bool = True
    """False if the method is not made for the scenario."""

    @classmethod
    def without_answers(
        cls, method: str, scenario: str, problem: str, takes_part: bool = True
    ) -> "Result":
        """Return the result of a method that has no answers."""
        empty = np.full((0, len(LAGS_S)), math.nan)
        return cls(
            method,
            scenario,
            empty,
            empty,
            np.zeros(0),
            math.nan,
            None,
            math.nan,
            problem=problem,
            takes_part=takes_part,
        )

    @property
    def error(self) -> FloatArray:
        """Present error by run, which ranks the methods."""
        return self.rmse_m[:, 0]

    @property
    def deviation(self) -> float:
        """Largest deviation of the present estimate over the runs; NaN without answers."""
        return self.farthest[0]

    @property
    def farthest(self) -> list[float]:
        """Largest deviation over the runs at each lag; NaN without answers."""
        columns = [column[~np.isnan(column)] for column in self.deviations.T]
        return [float(column.max()) if len(column) else math.nan for column in columns]

    @property
    def is_complete(self) -> bool:
        """True if the method has answered all queries for the present."""
        answers, queries = self.answered[0].tolist()
        return self.problem is None and answers == queries

    @property
    def is_exact(self) -> bool:
        """True if mean and covariance of the present equal the exact estimate."""
        return self.deviation < EXACT and self.covariance_deviation < EXACT

    @property
    def sentence(self) -> str:
        """Departure from the exact estimate in words."""
        if not self.takes_part:
            return f"{self.scenario}: takes no part: {self.problem}"
        if self.problem is not None:
            return f"{self.scenario}: no result: {self.problem}"
        parts = [
            _departure(lag_s, value, *counts)
            for lag_s, value, counts in zip(
                LAGS_S, self.farthest, self.answered.tolist(), strict=True
            )
        ]
        if self.order < EXACT:
            parts.append("the order of arrival does not matter")
        elif math.isfinite(self.order):
            parts.append(
                f"another order of arrival changes an estimate by {self.order:.2g} standard deviations"
            )
        parts += self._on_covariances()
        if self.num_indefinite:
            parts.append(
                f"covariances that are not positive definite: {self.num_indefinite}"
            )
        if self.refused:
            parts.append(
                f"{sum(self.refused.values())} measurements not fused "
                f"({', '.join(f'{reason} {number}' for reason, number in sorted(self.refused.items()))})"
            )
        return f"{self.scenario}: {'; '.join(parts)}"

    def _on_covariances(self) -> list[str]:
        """Return in words whether the covariance is too small or too large; nothing for an exact estimate."""
        anees = positive(self.nees)
        if self.is_exact or not anees.is_known:
            return []
        if anees.low <= _NUM_STATES <= anees.high:
            return []
        size = "small" if anees.low > _NUM_STATES else "large"
        return [
            f"its covariance is too {size}: ANEES {anees.mean:.2g} instead of {_NUM_STATES}"
        ]


def _departure(
    lag_s: float, deviation: float, num_answers: int, num_queries: int
) -> str:
    """Return the departure from the exact estimate at a lag in words, with the number of missing answers."""
    name = f"estimate {lag_s:g} s ago" if lag_s else "present estimate"
    if not num_answers:
        return f"there is no {name}"
    missing = ""
    if num_answers < num_queries:
        names = name.replace("estimate", "estimates")
        verb = "is" if num_queries - num_answers == 1 else "are"
        missing = (
            f"{num_queries - num_answers} of {num_queries} {names} {verb} missing; "
        )
    if deviation < EXACT:
        return f"{missing}the {name} is exact"
    return f"{missing}the {name} departs by up to {deviation:.2g} standard deviations"


@dataclass(frozen=True)
class Ranking:
    """Results of all methods in all scenarios."""

    results: tuple[Result | CrowdResult, ...]
    num_runs: int

    @property
    def tables(self) -> Tables:
        """A table for each scenario, the best method first."""
        scenarios = dict.fromkeys(result.scenario for result in self.results)
        return Tables({name: self._table(name) for name in scenarios})

    def __str__(self) -> str:
        return str(self.tables)

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the methods in the order of the call."""
        return tuple(dict.fromkeys(each.method for each in self.results))

    def sentences(self, method: str) -> list[str]:
        """Return a sentence for each scenario on where, and by how much, `method` departs from the exact estimate."""
        return [each.sentence for each in self.results if each.method == method]

    def summary(self, method: str) -> str:
        """Return a sentence on the departure of `method` over the scenarios of one object."""
        own = [
            each
            for each in self.results
            if isinstance(each, Result)
            and each.method == method
            and each.problem is None
        ]
        if not own:
            return "there are no answers about one object"
        exact = [each for each in own if each.is_complete and each.deviation < EXACT]
        text = f"the present estimate is exact in {len(exact)} of {len(own)} scenarios of one object"
        farthest = max(own, key=lambda each: np.nan_to_num(each.deviation, nan=-1.0))
        if farthest.deviation >= EXACT:
            text += (
                f"; it departs most in {farthest.scenario}, "
                f"by {farthest.deviation:.2g} standard deviations"
            )
        return text

    def page(self, method: str) -> str:
        """Return the page of `method` as Markdown: a summary, and a sentence for each scenario."""
        lines = [f"# {method}", "", _as_sentences(self.summary(method)), ""]
        for sentence in self.sentences(method):
            scenario, text = sentence.split(": ", 1)
            lines.append(f"- `{scenario}`: {_as_sentences(text)}")
        return "\n".join([*lines, ""])

    def deviations(self) -> Table:
        """Return the present deviation of each method in each scenario of one object, the most exact method first."""
        one = [each for each in self.results if isinstance(each, Result)]
        scenarios = list(dict.fromkeys(each.scenario for each in one))
        records: dict[str, dict[str, object]] = {}
        for each in one:
            record = records.setdefault(each.method, {"method": each.method})
            record[each.scenario] = each.deviation if each.is_complete else math.nan
        columns = [
            Column("method", left=True),
            *(Column(name, text=_scientific) for name in scenarios),
        ]
        note = (
            "largest deviation of the present x, y, vx, vy from the exact joint estimate, in its standard deviations; "
            f"{self.num_runs} runs; a dash: no result, or present answers are missing"
        )
        ordered = sorted(records.values(), key=lambda record: _farthest(record))
        return Table(
            "deviation from the exact estimate", ordered, columns, ("method",), [note]
        )

    def _table(self, scenario: str) -> Table:
        own = [each for each in self.results if each.scenario == scenario]
        crowds = [each for each in own if isinstance(each, CrowdResult)]
        if crowds:
            return crowd_table(scenario, crowds, self.num_runs)
        results = [each for each in own if isinstance(each, Result)]
        records = [{**_record(each), "rank": rank} for each, rank in ranked(results)]
        notes = [
            f"{SCENARIOS[scenario].about}; {self.num_runs} runs; brackets: 95 % intervals over the runs",
            "rank: methods whose error now does not differ significantly from the best one of the rank share it; "
            "a dash: present answers are missing",
            "deviation: largest deviation of x, y, vx, vy from the exact joint estimate, in its standard deviations",
            f"ANEES: {_NUM_STATES} for a covariance that is right; order: largest change by another order of arrival",
            "time: processor time for a measurement; memory: peak of Python and NumPy during a run",
        ]
        return Table(scenario, records, _COLUMNS, ("method",), notes)


_COLUMNS = (
    Column("method", left=True),
    Column("rank"),
    WithInterval("error now\n[m]", "error_m error_low_m error_high_m", "{} ({} to {})"),
    *(
        Column(f"error {lag_s:g} s\nago [m]", f"error_{k}_m")
        for k, lag_s in enumerate(LAGS_S)
        if k
    ),
    Column("deviation\nnow", "deviation_0", text=lambda value: _scientific(value)),
    *(
        Column(
            f"{lag_s:g} s\nago", f"deviation_{k}", text=lambda value: _scientific(value)
        )
        for k, lag_s in enumerate(LAGS_S)
        if k
    ),
    WithInterval("ANEES", "anees anees_low anees_high", "{} ({} to {})"),
    Column("order", text=lambda value: _scientific(value)),
    Column("not\nfused", "refused"),
    Column("time\n[us]", "seconds", scale=_US),
    Column("memory\n[kB]", "peak_bytes", scale=_KB),
)


def _record(result: Result) -> dict[str, object]:
    if result.problem is not None:
        return {"method": result.method, "problem": result.problem}
    now, anees = positive(result.rmse_m[:, 0]), positive(result.nees)
    record: dict[str, object] = {
        "method": result.method,
        **interval("error", now, "_m"),
        **interval("anees", anees, ""),
        "order": result.order,
        "refused": None if result.refused is None else sum(result.refused.values()),
        "seconds": result.seconds,
        "peak_bytes": result.peak_bytes,
    }
    for k, _ in enumerate(LAGS_S):
        record[f"error_{k}_m"] = average(result.rmse_m[:, k]).mean
        record[f"deviation_{k}"] = result.farthest[k]
    return record


def _as_sentences(text: str) -> str:
    """Return clauses that semicolons divide as sentences."""
    return " ".join(f"{each[0].upper()}{each[1:]}." for each in text.split("; "))


def _farthest(record: Mapping[str, object]) -> float:
    """Return the largest deviation in a record; a missing deviation counts as infinite."""
    values = [value for value in record.values() if isinstance(value, float)]
    return max(math.inf if math.isnan(value) else value for value in values)


def _scientific(value: str | int | float) -> str:
    if not isinstance(value, float) or not math.isfinite(value):
        return "-"
    return "0" if not value else f"{value:.1e}" if value < 0.01 else f"{value:.2g}"
