"""Methods in Python: classes with `update` and `state_at`, and functions `fuse`."""

import importlib.util
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from fgtrack.core.errors import CallError, one_line
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.models.motion import MotionModel
from fgtrack.ranking.methods import Answers, Method, MethodError
from fgtrack.ranking.problem import Answer, Problem


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
    z: FloatArray
    """Measured components, shape (k,)."""
    R: FloatArray
    """Covariance of `z`, shape (k, k)."""


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
    model: MotionModel
    """Motion model of fgtrack."""

    def transition(self, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """Return F and Q of x, y, vx, vy for constant velocity, shapes (4, 4); `dt_s` may be negative.

        Raises `NotImplementedError` for other motion models.
        """
        if self.motion != "cv":
            raise NotImplementedError(f"no linear transition for {self.motion}")
        F = self.model.jacobian(self.mean, dt_s)
        return F, self.model.process_noise(self.mean, abs(dt_s))


class PythonMethod(Method):
    """A class with `update` and `state_at`, or a function `fuse`."""

    def __init__(self, name: str, code: Callable[..., Any]) -> None:
        self.name = name
        self._code = code

    @property
    def _is_class(self) -> bool:
        return isinstance(self._code, type)

    def is_causal(self, problem: Problem, found: Answers) -> bool:
        """True for a class, which gets the measurements one by one; a function is tested."""
        return self._is_class or super().is_causal(problem, found)

    def answers(self, problem: Problem) -> Answers:
        """Answer all queries. Raises `MethodError` if the code raises, see `Method.answers`."""
        started_s = time.process_time()
        refused: Counter[str] = Counter()
        try:
            raw = (
                self._one_by_one(problem, refused)
                if self._is_class
                else self._at_once(problem)
            )
        except NotImplementedError:
            raise
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
            refused,
        )

    def _one_by_one(self, problem: Problem, refused: Counter[str]) -> list[Any]:
        one = self._code(_given(problem))
        observations = _observations(problem)
        found = []
        known = 0
        for query in problem.queries:
            for observation in observations[known : query.num_known]:
                if one.update(observation) is False:
                    refused["refused"] += 1
            known = query.num_known
            found.append(one.state_at(_after_start_s(problem, query.stamp_ns)))
        return found

    def _at_once(self, problem: Problem) -> list[Any]:
        queries = [
            (query.num_known, _after_start_s(problem, query.stamp_ns))
            for query in problem.queries
        ]
        return list(self._code(_given(problem), _observations(problem), queries))


def python_file(path: Path, wanted: str = "") -> PythonMethod:
    """Return the method in a Python file: the class or function `wanted`, or the only one.

    Raises `CallError` if the file cannot be imported, or holds no method or several.
    """
    module = _module(path)
    own = {
        name: each
        for name, each in vars(module).items()
        if getattr(each, "__module__", None) == module.__name__
        and _is_method(name, each)
        and not name.startswith("_")
    }
    if wanted:
        if wanted not in own:
            raise CallError(
                f"{path}: {wanted}: is no method: {', '.join(own) or 'the file holds none'}"
            )
        return PythonMethod(wanted, own[wanted])
    if not own:
        raise CallError(
            f"{path}: define a class with update(observation) and state_at(time_s), "
            "or a function fuse(given, observations, queries)"
        )
    if len(own) > 1:
        raise CallError(
            f"{path}: holds {', '.join(own)}: name one, for instance {path}:{next(iter(own))}"
        )
    return PythonMethod(path.stem, next(iter(own.values())))


def _is_method(name: str, code: object) -> bool:
    if isinstance(code, type):
        return hasattr(code, "update") and hasattr(code, "state_at")
    return name == "fuse" and callable(code)


def _given(problem: Problem) -> Given:
    prior = problem.prior
    assert prior.covariance is not None
    parameters = {
        name: float(getattr(problem.motion, name))
        for name in type(problem.motion).density_names()
    }
    return Given(
        type(problem.motion).__name__.lower(),
        parameters,
        prior.mean,
        prior.covariance,
        problem.motion,
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
                z,
                each.measurement.R,
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
