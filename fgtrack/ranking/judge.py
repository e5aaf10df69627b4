"""Verdict on methods: errors, deviation from the exact estimate, consistency, order of arrival, time."""

import math
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.types import IntArray
from fgtrack.ranking.crowd_result import CrowdResult
from fgtrack.ranking.crowds import CROWDS, CrowdProblem
from fgtrack.ranking.methods import Answers, Method, MethodError
from fgtrack.ranking.problem import LAGS_S, Answer, Problem
from fgtrack.ranking.result import Ranking, Result
from fgtrack.ranking.scenarios import draw

_PERMUTED = 2
"""Number of runs of a scenario whose arrivals are also given in another order."""


def judge(
    methods: Sequence[Method],
    scenarios: Iterable[str],
    num_runs: int,
    seed: int,
    on_step: Callable[[str], None] = lambda text: None,
) -> Ranking:
    """Run every method in every scenario, with the same draws for all.

    A method that fails in a scenario has a result with the reason. `on_step` is called
    with the name of each step.

    Raises `CallError` for an unknown scenario and for two methods with one name.
    """
    for name, count in Counter(each.name for each in methods).items():
        if count > 1:
            raise CallError(f"{count} methods are called {name}: rename the files")
    results: list[Result | CrowdResult] = []
    for scenario in scenarios:
        seeds = range(seed, seed + num_runs)
        if scenario in CROWDS:
            crowds = [CROWDS[scenario].draw(scenario, number) for number in seeds]
        else:
            problems = [draw(scenario, number) for number in seeds]
        for each in methods:
            on_step(f"{scenario}, {each.name}")
            if scenario in CROWDS:
                results.append(_judged_tracks(each, scenario, crowds))
            else:
                results.append(_judged(each, scenario, problems))
    return Ranking(tuple(results), num_runs)


def _judged_tracks(
    method: Method, scenario: str, problems: Sequence[CrowdProblem]
) -> CrowdResult:
    try:
        found = [method.tracks(problem) for problem in problems]
        method.check_causality_of_tracks(problems[0])
    except MethodError as error:
        return CrowdResult.without_tracks(method.name, scenario, str(error))
    except NotImplementedError as error:
        return CrowdResult.without_tracks(method.name, scenario, str(error), False)
    pairs = zip(problems, found, strict=True)
    return CrowdResult.of(
        method.name,
        scenario,
        problems,
        [each.positions for each in found],
        float(np.median([own.seconds / len(one.scans) for one, own in pairs])),
    )


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
    try:
        found = [method.answers(problem) for problem in problems]
        method.check_causality(problems[0])
        order = _order(method, problems, found)
        peak_bytes = _peak_bytes(method, problems[0])
    except MethodError as error:
        return Result.without_answers(method.name, scenario, str(error))
    except NotImplementedError as error:
        return Result.without_answers(
            method.name, scenario, str(error) or "not implemented", takes_part=False
        )
    reported = [each.refused for each in found if each.refused is not None]
    pairs = list(zip(problems, found, strict=True))
    return Result(
        method.name,
        scenario,
        np.array([_errors(*pair) for pair in pairs]),
        np.array([_deviations(*pair) for pair in pairs]),
        np.array([_nees(*pair) for pair in pairs]),
        order,
        sum(map(Counter, reported), Counter()) if reported else None,
        float(np.median([own.seconds / len(one.arrivals) for one, own in pairs])),
        peak_bytes,
        sum(_is_indefinite(answer) for each in found for answer in each.answers),
        _answered(pairs),
        float(np.max([_covariance_deviation(*pair) for pair in pairs])),
    )


def _answered(pairs: Sequence[tuple[Problem, Answers]]) -> IntArray:
    """Return the numbers of answers and of queries by lag, shape (lags, 2)."""
    numbers = np.zeros((len(LAGS_S), 2), dtype=np.int64)
    for problem, found in pairs:
        for query, answer in zip(problem.queries, found.answers, strict=True):
            numbers[LAGS_S.index(query.lag_s)] += (answer is not None, 1)
    return numbers


def _covariance_deviation(problem: Problem, found: Answers) -> float:
    """Largest difference of the present covariances from the exact ones, relative to their variances.

    NaN if a covariance is missing.
    """

    def one(answer: Answer, number: int) -> float:
        exact = problem.exact[number].covariance
        assert exact is not None
        if answer.covariance is None:
            return math.nan
        stds = np.sqrt(np.diag(exact))
        return float(np.abs((answer.covariance - exact) / np.outer(stds, stds)).max())

    values = _by_lag(problem, found, one)[0]
    return float(np.max(values)) if values else math.nan


def _is_indefinite(answer: Answer | None) -> bool:
    """True for an answer whose covariance is not positive definite."""
    if answer is None or answer.covariance is None:
        return False
    return float(np.linalg.eigvalsh(answer.covariance)[0]) <= 0.0


def _peak_bytes(method: Method, problem: Problem) -> float:
    """Return the largest memory of Python and NumPy during a run; NaN for a program."""
    if not method.is_traced:
        return math.nan
    tracemalloc.start()
    try:
        method.answers(problem)
        return float(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()


def _errors(problem: Problem, found: Answers) -> list[float]:
    """Root mean square position error of the answers at each lag; NaN without answers."""
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
    """Largest deviation of the answers from the exact estimate at each lag; NaN without answers."""
    return [
        max(values, default=math.nan)
        for values in _by_lag(
            problem,
            found,
            lambda answer, number: _deviation(answer, problem.exact[number]),
        )
    ]


def _nees(problem: Problem, found: Answers) -> float:
    """Mean NEES of the present answers; NaN without covariances, or if a covariance is not positive definite."""

    def one(answer: Answer, number: int) -> float:
        if answer.covariance is None or _is_indefinite(answer):
            return math.nan
        error = answer.mean - problem.truth[problem.queries[number].stamp_ns]
        return float(error @ np.linalg.solve(answer.covariance, error))

    return _mean(_by_lag(problem, found, one)[0])


def _by_lag(
    problem: Problem, found: Answers, value: Callable[[Answer, int], float]
) -> list[list[float]]:
    """Return the values of the answers at each lag."""
    result: list[list[float]] = [[] for _ in LAGS_S]
    for number, (query, answer) in enumerate(
        zip(problem.queries, found.answers, strict=True)
    ):
        if answer is not None:
            result[LAGS_S.index(query.lag_s)].append(value(answer, number))
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


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
