"""Verdict on methods: errors, deviation from the exact estimate, consistency, order of arrival, time."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import Estimate, average, paired
from fgtrack.evaluation.tables import Column, Table
from fgtrack.ranking.methods import Answers, Method, MethodError
from fgtrack.ranking.problem import LAGS_S, Answer, Problem
from fgtrack.ranking.scenarios import SCENARIOS, draw

EXACT = 1e-6
"""Largest deviation, in standard deviations, of a method that counts as exact."""
_NUM_STATES = 4
_PERMUTED = 2
"""Number of runs of a scenario whose arrivals are also given in another order."""
_US = 1e6


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
    refused: Mapping[str, int]
    """Number of measurements that were not fused, by reason."""
    seconds: float
    """Time for one measurement."""
    problem: str | None = None
    """Reason why the method has no answers; None if it has."""

    @property
    def deviation(self) -> float:
        """Largest deviation of the present estimate over the runs."""
        return float(self.deviations[:, 0].max()) if len(self.deviations) else math.nan

    @property
    def sentence(self) -> str:
        """Departure from the exact estimate in words."""
        if self.problem is not None:
            return f"{self.scenario}: no result: {self.problem}"
        parts = [
            _departure(lag_s, value)
            for lag_s, value in zip(
                LAGS_S, self.deviations.max(axis=0).tolist(), strict=True
            )
        ]
        if self.order < EXACT:
            parts.append("the order of arrival does not matter")
        elif math.isfinite(self.order):
            parts.append(
                f"another order of arrival changes it by {self.order:.2g} standard deviations"
            )
        anees = average(self.nees)
        if anees.is_known and anees.low > _NUM_STATES:
            parts.append(
                f"its covariance is too small: ANEES {anees.mean:.2g} instead of {_NUM_STATES}"
            )
        elif anees.is_known and anees.high < _NUM_STATES:
            parts.append(
                f"its covariance is too large: ANEES {anees.mean:.2g} instead of {_NUM_STATES}"
            )
        if self.refused:
            parts.append(
                f"{sum(self.refused.values())} measurements not fused "
                f"({', '.join(f'{reason} {number}' for reason, number in sorted(self.refused.items()))})"
            )
        return f"{self.scenario}: {'; '.join(parts)}"


def _departure(lag_s: float, deviation: float) -> str:
    """Return the departure from the exact estimate at a lag in words."""
    when = f"{lag_s:g} s ago" if lag_s else "now"
    if math.isnan(deviation):
        return f"{when} no answer"
    if deviation < EXACT:
        return f"{when} exact"
    return f"{when} up to {deviation:.2g} standard deviations off"


@dataclass(frozen=True)
class Ranking:
    """Results of all methods in all scenarios."""

    results: tuple[Result, ...]
    num_runs: int

    def tables(self) -> list[Table]:
        """Return a table for each scenario, the best method first."""
        scenarios = dict.fromkeys(result.scenario for result in self.results)
        return [self._table(name) for name in scenarios]

    def sentences(self, method: str) -> list[str]:
        """Return a sentence for each scenario on where, and by how much, `method` departs from the exact estimate."""
        return [each.sentence for each in self.results if each.method == method]

    def _table(self, scenario: str) -> Table:
        results = [each for each in self.results if each.scenario == scenario]
        records = [{**_record(each), "rank": rank} for each, rank in _ranked(results)]
        notes = [
            f"{SCENARIOS[scenario].about}; {self.num_runs} runs; brackets: 95 % intervals over the runs",
            "rank: methods whose error now does not differ significantly from the best one of the rank share it",
            "deviation: largest deviation of x, y, vx, vy from the exact joint estimate, in its standard deviations",
            f"ANEES: {_NUM_STATES} for a covariance that is right; order: largest change by another order of arrival",
        ]
        return Table(scenario, records, _COLUMNS, ("method",), notes)


_COLUMNS = (
    Column("method", left=True),
    Column("rank"),
    Column("error now\n[m]", "error_m error_low_m error_high_m", "{} ({} to {})"),
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
    Column("ANEES", "anees"),
    Column("ANEES, 95 %", "anees_low anees_high", "{} to {}", is_extra=True),
    Column("order", text=lambda value: _scientific(value)),
    Column("not\nfused", "refused"),
    Column("time\n[us]", "seconds", scale=_US),
)


def rank(
    methods: Sequence[Method],
    scenarios: Iterable[str] = tuple(SCENARIOS),
    *,
    num_runs: int = 10,
    seed: int = 1,
    on_step: Callable[[str], None] = lambda text: None,
) -> Ranking:
    """Run every method in every scenario, with the same draws for all.

    A method that fails in a scenario has a result with the reason. `on_step` is called
    with the name of each step.

    Raises `CallError` for an unknown scenario.
    """
    results = []
    for scenario in scenarios:
        problems = [draw(scenario, seed + number) for number in range(num_runs)]
        for each in methods:
            on_step(f"{scenario}, {each.name}")
            results.append(_judged(each, scenario, problems))
    return Ranking(tuple(results), num_runs)


def permuted(problem: Problem, rng: np.random.Generator) -> Problem:
    """Return the problem with all arrivals in a random order, and the last queries alone."""
    order = rng.permutation(len(problem.arrivals))
    receipts_ns = [each.receipt_ns for each in problem.arrivals]
    arrivals = tuple(
        replace(problem.arrivals[number], receipt_ns=receipt_ns)
        for number, receipt_ns in zip(order.tolist(), receipts_ns, strict=True)
    )
    last = len(problem.arrivals)
    queries = tuple(query for query in problem.queries if query.num_known == last)
    return replace(problem, arrivals=arrivals, queries=queries)


def _judged(method: Method, scenario: str, problems: Sequence[Problem]) -> Result:
    empty = np.full((0, len(LAGS_S)), math.nan)
    try:
        if not method.is_causal(problems[0]):
            raise MethodError("its answers change where later rows are missing")
        found = [method.answers(problem) for problem in problems]
        order = _order(method, problems, found)
    except MethodError as error:
        return Result(
            method.name,
            scenario,
            empty,
            empty,
            np.zeros(0),
            math.nan,
            {},
            math.nan,
            str(error),
        )
    refused: Counter[str] = Counter()
    for each in found:
        refused.update(each.refused)
    num_arrivals = sum(len(problem.arrivals) for problem in problems)
    return Result(
        method.name,
        scenario,
        np.array([_errors(*pair) for pair in zip(problems, found, strict=True)]),
        np.array([_deviations(*pair) for pair in zip(problems, found, strict=True)]),
        np.array([_nees(*pair) for pair in zip(problems, found, strict=True)]),
        order,
        refused,
        sum(each.seconds for each in found) / num_arrivals,
    )


def _errors(problem: Problem, found: Answers) -> list[float]:
    """Root mean square position error at each lag; NaN where an answer is missing."""
    return [
        math.sqrt(_mean(squares))
        for squares in _by_lag(
            problem,
            found,
            lambda answer, number: float(
                np.square(
                    answer.mean[:2]
                    - problem.truth[problem.queries[number].stamp_ns][:2]
                ).sum()
            ),
        )
    ]


def _deviations(problem: Problem, found: Answers) -> list[float]:
    """Largest deviation from the exact estimate at each lag; NaN where an answer is missing."""
    return [
        max(values, default=math.nan) if not any(map(math.isnan, values)) else math.nan
        for values in _by_lag(
            problem,
            found,
            lambda answer, number: _deviation(answer, problem.exact[number]),
        )
    ]


def _nees(problem: Problem, found: Answers) -> float:
    def one(answer: Answer, number: int) -> float:
        if answer.covariance is None:
            return math.nan
        error = answer.mean - problem.truth[problem.queries[number].stamp_ns]
        return float(error @ np.linalg.solve(answer.covariance, error))

    return _mean(_by_lag(problem, found, one)[0])


def _by_lag(
    problem: Problem, found: Answers, value: Callable[[Answer, int], float]
) -> list[list[float]]:
    """Return the values of the answers at each lag; NaN for a missing answer."""
    result: list[list[float]] = [[] for _ in LAGS_S]
    for number, (query, answer) in enumerate(
        zip(problem.queries, found.answers, strict=True)
    ):
        result[LAGS_S.index(query.lag_s)].append(
            math.nan if answer is None else value(answer, number)
        )
    return result


def _order(
    method: Method, problems: Sequence[Problem], found: Sequence[Answers]
) -> float:
    """Return the largest change of the last answers in another order of arrival; NaN without answers."""
    largest = math.nan
    for number, problem in enumerate(problems[:_PERMUTED]):
        other = permuted(problem, np.random.default_rng(number))
        last = len(other.queries)
        before = found[number].answers[-last:]
        after = method.answers(other).answers
        for one, two, exact in zip(before, after, problem.exact[-last:], strict=True):
            if one is not None and two is not None:
                change = _deviation(
                    Answer(exact.mean + two.mean - one.mean, None), exact
                )
                largest = change if math.isnan(largest) else max(largest, change)
    return largest


def _deviation(answer: Answer, exact: Answer) -> float:
    """Largest deviation of a component from the exact mean, in its exact standard deviations."""
    assert exact.covariance is not None
    stds = np.sqrt(np.diag(exact.covariance))
    return float(np.abs((answer.mean - exact.mean) / stds).max())


def _ranked(results: Sequence[Result]) -> list[tuple[Result, int | None]]:
    """Return the results with their ranks, the best first; a method without answers has no rank."""
    known = [each for each in results if len(each.rmse_m)]
    known.sort(key=lambda each: (_mean(each.rmse_m[:, 0].tolist()), each.method))
    ranked: list[tuple[Result, int | None]] = []
    first: Result | None = None
    rank = 0
    for number, each in enumerate(known, start=1):
        if first is None or paired(each.rmse_m[:, 0], first.rmse_m[:, 0]).low > 0.0:
            first, rank = each, number
        ranked.append((each, rank))
    return [*ranked, *((each, None) for each in results if not len(each.rmse_m))]


def _record(result: Result) -> dict[str, object]:
    if result.problem is not None:
        return {"method": result.method, "problem": result.problem}
    now, anees = average(result.rmse_m[:, 0]), average(result.nees)
    record: dict[str, object] = {
        "method": result.method,
        **_interval("error", now, "_m"),
        **_interval("anees", anees, ""),
        "order": result.order,
        "refused": sum(result.refused.values()),
        "seconds": result.seconds,
    }
    for k, _ in enumerate(LAGS_S):
        record[f"error_{k}_m"] = _mean(result.rmse_m[:, k].tolist())
        record[f"deviation_{k}"] = float(result.deviations[:, k].max())
    return record


def _interval(name: str, estimate: Estimate, unit: str) -> dict[str, float]:
    return {
        f"{name}{unit}": estimate.mean,
        f"{name}_low{unit}": estimate.low,
        f"{name}_high{unit}": estimate.high,
    }


def _scientific(value: str | int | float) -> str:
    if not isinstance(value, float) or not math.isfinite(value):
        return "-"
    return "0" if not value else f"{value:.1e}" if value < 0.01 else f"{value:.2g}"


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
