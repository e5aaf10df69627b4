"""Methods that are ranked: the interface, estimators of fgtrack, and programs in any language."""

import csv
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgtrack.core.errors import CallError, FgtrackError, one_line
from fgtrack.estimation.registry import estimator
from fgtrack.ranking.files import read_states, write_problem
from fgtrack.ranking.problem import Answer, Problem, answer_of, cut_after

WINDOW_S = 10.0
"""Window of the shipped estimators; it is longer than a scenario."""
_TIMEOUT_S = 600.0
_SAME = 1e-6
"""Largest difference of two answers that count as equal, in standard deviations or m."""


class MethodError(FgtrackError):
    """A method failed, or gave answers that cannot be read."""


@dataclass(frozen=True)
class Answers:
    """Answers of a method to the queries of a problem."""

    answers: tuple[Answer | None, ...]
    """Answer of each query; None where the method gives none."""
    seconds: float
    """Processor time, for a program the time on the clock."""
    refused: Mapping[str, int] = field(default_factory=dict)
    """Number of measurements that were not fused, by reason; programs do not report it."""


class Method(ABC):
    """A method with a name."""

    name: str
    is_traced = True
    """True if the memory of the method is that of this process."""

    @abstractmethod
    def answers(self, problem: Problem) -> Answers:
        """Answer all queries.

        Raises `MethodError` if the method fails, and `NotImplementedError` if it is not
        made for the scenario.
        """

    def is_causal(self, problem: Problem, found: Answers) -> bool:
        """True if answers do not change where all later arrivals are missing.

        The first query and a query in the middle are tested. `found` holds the answers
        to the whole problem.
        """
        times = sorted({query.num_known for query in problem.queries})
        for num_known in sorted({times[0], times[len(times) // 2]} - {times[-1]}):
            cut = cut_after(problem, num_known)
            alone = self.answers(cut).answers
            if not all(map(_are_same, alone, found.answers)):
                return False
        return True


def _are_same(a: Answer | None, b: Answer | None) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.allclose(a.mean, b.mean, rtol=0.0, atol=_SAME))


class Shipped(Method):
    """An estimator of fgtrack, or of a plug-in."""

    def __init__(self, name: str) -> None:
        self.name = name

    def is_causal(self, problem: Problem, found: Answers) -> bool:
        """True: the estimator gets the measurements one by one."""
        return True

    def answers(self, problem: Problem) -> Answers:
        """Answer all queries."""
        started_s = time.process_time()
        one = estimator(self.name, problem.motion, problem.start, lag_s=WINDOW_S)
        found: list[Answer | None] = []
        refused: Counter[str] = Counter()
        known = 0
        for query in problem.queries:
            for arrival in problem.arrivals[known : query.num_known]:
                result = one.update(arrival.measurement)
                if result.innovation is None:
                    refused[str(result.status)] += 1
            known = query.num_known
            try:
                state = one.state_at(query.stamp_ns)
            except CallError:
                found.append(None)
            else:
                found.append(answer_of(problem.motion, state))
        return Answers(tuple(found), time.process_time() - started_s, refused)


class Program(Method):
    """A program that is called as `PROGRAM measurements.csv states.csv`."""

    is_traced = False

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self._path = path.resolve()

    def answers(self, problem: Problem) -> Answers:
        """Answer all queries. Raises `MethodError` if the program fails or its file cannot be read."""
        with tempfile.TemporaryDirectory() as folder:
            measurements = write_problem(Path(folder), problem)
            states = Path(folder) / "states.csv"
            started_s = time.perf_counter()
            try:
                done = subprocess.run(
                    [str(self._path), str(measurements), str(states)],
                    capture_output=True,
                    text=True,
                    timeout=_TIMEOUT_S,
                    check=False,
                )
            except (OSError, subprocess.TimeoutExpired) as error:
                raise MethodError(f"{self.name}: {one_line(str(error))}") from error
            seconds = time.perf_counter() - started_s
            if done.returncode:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                raise MethodError(
                    f"{self.name}: {problem.scenario}: exit code {done.returncode}: {one_line(last)}"
                )
            try:
                found = read_states(states, len(problem.queries))
            except (OSError, ValueError, KeyError, csv.Error) as error:
                raise MethodError(
                    f"{self.name}: {problem.scenario}: states.csv: {one_line(str(error))}"
                ) from error
            return Answers(tuple(found), seconds)
