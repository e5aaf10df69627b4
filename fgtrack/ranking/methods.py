"""Methods that are ranked: estimators of fgtrack, Python files, and programs in any language."""

import csv
import importlib.util
import math
import os
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError, FgtrackError, one_line
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.registry import ESTIMATORS, estimator
from fgtrack.ranking.files import read_states, write_problem
from fgtrack.ranking.problem import Answer, Problem, answer_of

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
    """Number of measurements that were not fused, by reason; only shipped estimators report it."""


class Method(ABC):
    """A method with a name."""

    name: str

    @abstractmethod
    def answers(self, problem: Problem) -> Answers:
        """Answer all queries. Raises `MethodError` if the method fails."""

    def is_causal(self, problem: Problem) -> bool:
        """True if the answers to the first queries do not change where all later arrivals are missing."""
        first = problem.queries[0].num_known
        queries = [query for query in problem.queries if query.num_known == first]
        cut = Problem(
            problem.scenario,
            problem.motion,
            problem.start,
            problem.arrivals[:first],
            tuple(queries),
            problem.truth,
        )
        alone = self.answers(cut).answers
        return all(map(_are_same, alone, self.answers(problem).answers))


def _are_same(a: Answer | None, b: Answer | None) -> bool:
    if a is None or b is None:
        return a is b
    return bool(np.allclose(a.mean, b.mean, rtol=0.0, atol=_SAME))


class Shipped(Method):
    """An estimator of fgtrack, or of a plug-in."""

    def __init__(self, name: str) -> None:
        self.name = name

    def is_causal(self, problem: Problem) -> bool:
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


@dataclass(frozen=True)
class Observation:
    """A measurement for a method in a Python file; times are in s after the start of the problem."""

    stamp_s: float
    receipt_s: float
    sensor: str
    values: Mapping[str, float]
    """Measured components by name: `x_m`, `y_m`, `range_m`, `bearing_rad`, `range_rate_mps`."""
    stds: Mapping[str, float]
    """Standard deviations by the same names."""


@dataclass(frozen=True)
class Given:
    """Description of a problem for a method in a Python file."""

    motion: str
    """Motion model: `cv` or `ctrv`."""
    parameters: Mapping[str, float]
    """Noise densities of the motion model."""
    mean: FloatArray
    """Mean of x, y, vx, vy at time 0, shape (4,)."""
    covariance: FloatArray
    """Covariance of the mean, shape (4, 4)."""


class PythonFile(Method):
    """A class with `update` and `state_at`, or a function `fuse`, in a Python file."""

    def __init__(self, path: Path) -> None:
        self.name = path.stem
        module = _module(path)
        self._fuse: Callable[..., Any] | None = getattr(module, "fuse", None)
        self._make = next(
            (
                each
                for each in vars(module).values()
                if isinstance(each, type)
                and each.__module__ == module.__name__
                and hasattr(each, "update")
                and hasattr(each, "state_at")
            ),
            None,
        )
        if self._fuse is None and self._make is None:
            raise CallError(
                f"{path}: define a class with update(observation) and state_at(time_s), "
                "or a function fuse(given, observations, queries)"
            )

    def is_causal(self, problem: Problem) -> bool:
        """True for a class, which gets the measurements one by one; a function is tested."""
        return self._fuse is None or super().is_causal(problem)

    def answers(self, problem: Problem) -> Answers:
        """Answer all queries. Raises `MethodError` if the code raises."""
        started_s = time.process_time()
        try:
            raw = (
                self._from_function(problem)
                if self._fuse
                else self._one_by_one(problem)
            )
        except Exception as error:
            raise MethodError(
                f"{self.name}: {problem.scenario}: {type(error).__name__}: {one_line(str(error))}"
            ) from error
        if len(raw) != len(problem.queries):
            raise MethodError(
                f"{self.name}: {problem.scenario}: {len(problem.queries)} answers are expected, {len(raw)} came"
            )
        return Answers(
            tuple(_checked(self.name, each) for each in raw),
            time.process_time() - started_s,
        )

    def _one_by_one(self, problem: Problem) -> list[Any]:
        assert self._make is not None
        one = self._make(_given(problem))
        found = []
        known = 0
        for query in problem.queries:
            for observation in _observations(problem)[known : query.num_known]:
                one.update(observation)
            known = query.num_known
            found.append(one.state_at(_after_start_s(problem, query.stamp_ns)))
        return found

    def _from_function(self, problem: Problem) -> list[Any]:
        assert self._fuse is not None
        queries = [
            (query.num_known, _after_start_s(problem, query.stamp_ns))
            for query in problem.queries
        ]
        return list(self._fuse(_given(problem), _observations(problem), queries))


class Program(Method):
    """A program that is called as `PROGRAM measurements.csv states.csv`."""

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


def method(text: str) -> Method:
    """Return the method that `text` names: an estimator, a Python file, or a program.

    Raises `CallError` for anything else.
    """
    path = Path(text)
    if path.suffix == ".py" and path.is_file():
        return PythonFile(path)
    if path.is_file() and os.access(path, os.X_OK):
        return Program(path)
    if path.is_file():
        raise CallError(f"{text}: is neither a Python file nor an executable program")
    return Shipped(ESTIMATORS.resolve(text))


def _given(problem: Problem) -> Given:
    prior = problem.prior
    assert prior.covariance is not None
    parameters = {
        name: float(getattr(problem.motion, name))
        for name in type(problem.motion).density_names()
    }
    return Given(
        type(problem.motion).__name__.lower(), parameters, prior.mean, prior.covariance
    )


def _observations(problem: Problem) -> Sequence[Observation]:
    found = []
    for each in problem.arrivals:
        z = each.measurement.z
        names = each.measurement.model.components
        stds = np.sqrt(np.diag(each.measurement.R)).tolist()
        found.append(
            Observation(
                _after_start_s(problem, each.measurement.stamp_ns),
                _after_start_s(problem, each.receipt_ns),
                each.sensor,
                dict(zip(names, z.tolist(), strict=True)),
                dict(zip(names, stds, strict=True)),
            )
        )
    return found


def _after_start_s(problem: Problem, stamp_ns: int) -> float:
    return (stamp_ns - problem.start.stamp_ns) / NS_PER_S


def _checked(name: str, raw: Any) -> Answer | None:
    """Return an answer: None, a mean, or a mean and a covariance. Raises `MethodError` for anything else."""
    if raw is None:
        return None
    mean, covariance = raw if isinstance(raw, tuple) else (raw, None)
    mean = np.asarray(mean, dtype=np.float64)
    if mean.shape != (4,):
        raise MethodError(
            f"{name}: a mean must be x, y, vx, vy, shape (4,); its shape is {mean.shape}"
        )
    if covariance is None:
        return Answer(mean, None)
    covariance = np.asarray(covariance, dtype=np.float64)
    if covariance.shape != (4, 4):
        raise MethodError(
            f"{name}: a covariance must have shape (4, 4); its shape is {covariance.shape}"
        )
    if not math.isfinite(float(mean.sum() + covariance.sum())):
        raise MethodError(f"{name}: an answer is not finite")
    return Answer(mean, covariance)


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"fgtrack_ranked_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise CallError(
            f"{path}: cannot be imported: {type(error).__name__}: {one_line(str(error))}"
        ) from error
    return module
