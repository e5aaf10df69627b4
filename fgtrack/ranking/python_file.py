"""Methods in Python: classes with `update` and `state_at`, and functions `fuse`."""

import importlib
import importlib.util
import inspect
import sys
import time
import traceback
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
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CV, MotionModel
from fgtrack.ranking.crowds import CrowdProblem, CrowdSensor
from fgtrack.ranking.methods import Answers, Method, MethodError, Tracks
from fgtrack.ranking.problem import Answer, Problem

_CARTESIAN = CV()
"""Motion model with the state x, y, vx, vy."""


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

    def innovation(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return `z` minus its prediction from x, y, vx, vy, shape (k,), and the Jacobian of the prediction, (k, 4).

        The difference of two bearings lies in (-pi, pi].
        """
        model = measurement_model(tuple(self.values), _CARTESIAN)
        return model.linearised(self.z, np.asarray(x, dtype=np.float64))


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


@dataclass(frozen=True)
class ScanInPython:
    """Scan of several objects for a method in a Python file; times are in s after the start of the problem."""

    stamp_s: float
    receipt_s: float
    sensor: str
    points_m: FloatArray
    """Measured positions in the map, shape (n, 2)."""
    pose: FloatArray
    """Position x, y and yaw of the vehicle with the sensor, shape (3,); 0 if the sensor is at rest."""


@dataclass(frozen=True)
class GivenCrowd:
    """Description of a problem with several objects for a method in a Python file."""

    speed_mps: float
    """Standard deviation of a component of the velocity of an object that appears."""
    acceleration_density_m2ps3: float
    """Density of the white noise of the acceleration."""
    max_delay_s: float
    """Longest delay of a scan."""
    sensors: Mapping[str, CrowdSensor]
    """Standard deviation, detection probability, clutter and field of view by name of the sensor."""


class PythonMethod(Method):
    """A class with `update` and `state_at` or `tracks_at`, or a function `fuse`."""

    def __init__(self, name: str, code: Callable[..., Any]) -> None:
        self.name = name
        self._code = code

    @property
    def _is_class(self) -> bool:
        return isinstance(self._code, type)

    def check_causality(self, problem: Problem) -> None:
        """Check a function; a class gets the measurements one by one. Raises as `Method.check_causality`."""
        if not self._is_class:
            super().check_causality(problem)

    def answers(self, problem: Problem) -> Answers:
        """Answer all queries. Raises `MethodError` if the code raises, see `Method.answers`."""
        started_s = time.process_time()
        refused: Counter[str] = Counter()
        if self._is_class and not hasattr(self._code, "state_at"):
            raise NotImplementedError("it has no state_at")
        try:
            raw = (
                self._one_by_one(problem, refused)
                if self._is_class
                else self._at_once(problem)
            )
        except (MethodError, NotImplementedError):
            raise
        except Exception as error:
            raise self._failure(error) from error
        if len(raw) != len(problem.queries):
            raise MethodError(
                f"{len(problem.queries)} answers are expected, {len(raw)} came"
            )
        return Answers(
            tuple(_checked(each) for each in raw),
            time.process_time() - started_s,
            refused if self._is_class else None,
        )

    def check_causality_of_tracks(self, problem: CrowdProblem) -> None:
        """Do nothing: a class gets the scans one by one."""

    def tracks(self, problem: CrowdProblem) -> Tracks:
        """Answer all queries with the tracks of a class with `tracks_at`. Raises as `answers`."""
        if not hasattr(self._code, "tracks_at"):
            raise NotImplementedError("it has no tracks_at")
        started_s = time.process_time()
        try:
            found = self._scan_by_scan(problem)
        except (MethodError, NotImplementedError):
            raise
        except Exception as error:
            raise self._failure(error) from error
        return Tracks(tuple(found), time.process_time() - started_s)

    def _scan_by_scan(self, problem: CrowdProblem) -> list[dict[int, FloatArray]]:
        one = self._made(
            GivenCrowd(
                problem.speed_mps,
                problem.acceleration_density_m2ps3,
                problem.max_delay_s,
                problem.sensors,
            )
        )
        found = []
        known = 0
        for query in problem.queries:
            for scan in problem.scans[known : query.num_known]:
                one.update(
                    ScanInPython(
                        (scan.stamp_ns - problem.start_ns) / NS_PER_S,
                        (scan.receipt_ns - problem.start_ns) / NS_PER_S,
                        scan.sensor,
                        scan.points_m,
                        scan.pose,
                    )
                )
            known = query.num_known
            tracks = one.tracks_at((query.stamp_ns - problem.start_ns) / NS_PER_S)
            found.append(
                {
                    int(track_id): _position(state)
                    for track_id, state in dict(tracks).items()
                }
            )
        return found

    def _failure(self, error: Exception) -> MethodError:
        """Return the error of the method, with its last line in the file of the method."""
        text = f"{type(error).__name__}: {one_line(str(error))}"
        file = getattr(sys.modules.get(self._code.__module__), "__file__", None)
        frames = traceback.extract_tb(error.__traceback__)
        lines = [frame.lineno for frame in frames if frame.filename == file]
        where = f"{Path(file).name}, line {lines[-1]}: " if file and lines else ""
        return MethodError(where + text)

    def _made(self, given: Given | GivenCrowd) -> Any:
        """Return an object of the class. Raises `MethodError` if the class does not take `given`."""
        try:
            inspect.signature(self._code).bind(given)
        except TypeError as error:
            raise MethodError(
                f"{self._code.__name__}: define __init__(self, given): {error}"
            ) from error
        return self._code(given)

    def _one_by_one(self, problem: Problem, refused: Counter[str]) -> list[Any]:
        one = self._made(_given(problem))
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
        return PythonMethod(f"{path.stem}.{wanted}", own[wanted])
    if not own:
        raise CallError(
            f"{path}: define a class with update(observation) and state_at(time_s) or tracks_at(time_s), "
            "or a function fuse(given, observations, queries)"
        )
    if len(own) > 1:
        raise CallError(
            f"{path}: holds {', '.join(own)}: name one, for instance {path}:{next(iter(own))}"
        )
    return PythonMethod(path.stem, next(iter(own.values())))


def python_module(module: str, wanted: str) -> PythonMethod:
    """Return the class or function `wanted` of an installed module.

    Raises `CallError` if the module cannot be imported, or has no such method.
    """
    try:
        code = getattr(importlib.import_module(module), wanted, None)
    except Exception as error:
        raise _not_imported(module, error) from error
    if not callable(code):
        raise CallError(f"{module}: has no class or function {wanted}")
    return PythonMethod(f"{module}.{wanted}", code)


def _not_imported(what: object, error: Exception) -> CallError:
    text = f"{type(error).__name__}: {one_line(str(error))}"
    return CallError(f"{what}: cannot be imported: {text}")


def _is_method(name: str, code: object) -> bool:
    if isinstance(code, type):
        return hasattr(code, "update") and (
            hasattr(code, "state_at") or hasattr(code, "tracks_at")
        )
    return name == "fuse" and callable(code)


def _position(state: Any) -> FloatArray:
    """Return the position of a track: its state begins with x and y."""
    position_m = np.asarray(state, dtype=np.float64)[:2]
    if position_m.shape != (2,) or not np.isfinite(position_m).all():
        raise MethodError(f"a track must be finite x, y ..., not {state!r}")
    return position_m


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


def _checked(raw: Any) -> Answer | None:
    """Return an answer: None, a mean, or a mean and a covariance. Raises `MethodError` for anything else."""
    if raw is None:
        return None
    mean, covariance = raw if _is_pair(raw) else (raw, None)
    return Answer(
        _finite("a mean must be x, y, vx, vy", mean, (4,)),
        None
        if covariance is None
        else _finite("a covariance must be a matrix", covariance, (4, 4)),
    )


def _is_pair(raw: Any) -> bool:
    """True for a mean with a covariance: two parts, the first with four numbers."""
    return isinstance(raw, tuple | list) and len(raw) == 2


def _finite(wanted: str, raw: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return `raw` as an array of finite numbers. Raises `MethodError` for anything else."""
    try:
        values = np.asarray(raw, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MethodError(f"{wanted}: {one_line(str(error))}") from error
    if values.shape != shape:
        raise MethodError(f"{wanted}, shape {shape}; its shape is {values.shape}")
    if not np.isfinite(values).all():
        raise MethodError("an answer is not finite")
    return values


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"fgtrack_ranked_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module.__name__] = module  # dataclasses look their module up there
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise _not_imported(path, error) from error
    return module
