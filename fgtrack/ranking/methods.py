"""Methods that are ranked: the interface, estimators of fgtrack, and programs in any language."""

import csv
import math
import os
import signal
import subprocess
import tempfile
import time
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from fgtrack.config.settings import Config
from fgtrack.core.errors import CallError, FgtrackError, one_line
from fgtrack.core.geometry import rotation
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import Detection, DetectionList, Frame, TrackStatus
from fgtrack.estimation.registry import estimator
from fgtrack.pipeline.live import Tracker
from fgtrack.ranking.causality import with_more_queries, with_more_scan_queries
from fgtrack.ranking.crowd_files import read_tracks, write_crowd
from fgtrack.ranking.crowds import CrowdProblem, Positions, Scan
from fgtrack.ranking.files import read_states, write_problem
from fgtrack.ranking.problem import Answer, Problem, answer_of, cut_after

WINDOW_S = 10.0
"""Window of the shipped estimators; it is longer than a scenario."""
TIME_LIMIT_S = 60.0
"""Longest time of a run of a program."""
NO_PART = 77
"""Exit code of a program that is not made for a scenario, as of a skipped test of GNU Automake."""
_SPARE_S = 1.5
"""Window of the shipped trackers beyond the longest delay; it reaches the oldest query."""
_SAME = 1e-6
"""Largest difference of two answers that count as equal, in standard deviations or m."""

T = TypeVar("T")


class MethodError(FgtrackError):
    """A method failed, or gave answers that cannot be read."""


@dataclass(frozen=True)
class Answers:
    """Answers of a method to the queries of a problem."""

    answers: tuple[Answer | None, ...]
    """Answer of each query; None where the method gives none."""
    seconds: float
    """Processor time, for a program the time on the clock."""
    refused: Mapping[str, int] | None = None
    """Number of measurements that were not fused, by reason; None if the method does not report it."""


@dataclass(frozen=True)
class Tracks:
    """Tracks of a method at the queries of a problem with several objects."""

    positions: tuple[Positions, ...]
    """Positions of the tracks by id for each query."""
    seconds: float
    """Processor time, for a program the time on the clock."""


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

    def tracks(self, problem: CrowdProblem) -> Tracks:
        """Answer all queries of a problem with several objects. Raises as `answers`."""
        raise NotImplementedError("it takes one object")

    def check_causality(self, problem: Problem) -> None:
        """Compare the answers with those to the problem without its later arrivals.

        Raises `MethodError` with the query whose answer changes.
        """
        asked, cuts = with_more_queries(problem)
        found = self.answers(asked).answers
        for num_known in cuts:
            alone = self.answers(cut_after(asked, num_known)).answers
            for query, one, other in zip(asked.queries, alone, found, strict=False):
                if not _are_same(one, other):
                    time_s = (query.stamp_ns - problem.start.stamp_ns) / NS_PER_S
                    raise MethodError(_not_causal(query.num_known, time_s))

    def check_causality_of_tracks(self, problem: CrowdProblem) -> None:
        """Compare the tracks with the tracks of a run without the later scans. Raises as `check_causality`."""
        asked, cuts = with_more_scan_queries(problem)
        found = self.tracks(asked).positions
        for num_known in cuts:
            alone = self.tracks(asked.cut_after(num_known)).positions
            for query, one, other in zip(asked.queries, alone, found, strict=False):
                if not _are_same_tracks(one, other):
                    time_s = (query.stamp_ns - problem.start_ns) / NS_PER_S
                    raise MethodError(_not_causal(query.num_known, time_s))


def _not_causal(num_known: int, time_s: float) -> str:
    return (
        f"not causal: the answer for {time_s:.3f} s, after {num_known} arrivals, "
        "changes where later rows are missing, or from run to run"
    )


def _are_same(a: Answer | None, b: Answer | None) -> bool:
    if a is None or b is None:
        return a is b
    if a.covariance is None or b.covariance is None:
        is_same = a.covariance is b.covariance
    else:
        is_same = np.allclose(a.covariance, b.covariance, rtol=_SAME, atol=_SAME)
    return is_same and bool(np.allclose(a.mean, b.mean, rtol=0.0, atol=_SAME))


def _are_same_tracks(a: Positions, b: Positions) -> bool:
    return a.keys() == b.keys() and all(
        np.allclose(a[track_id], b[track_id], rtol=0.0, atol=_SAME) for track_id in a
    )


class Shipped(Method):
    """An estimator of fgtrack, or of a plug-in; for several objects the tracker with this estimator."""

    def __init__(self, name: str) -> None:
        self.name = name

    def check_causality(self, problem: Problem) -> None:
        """Do nothing: the estimator gets the measurements one by one."""

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

    def check_causality_of_tracks(self, problem: CrowdProblem) -> None:
        """Do nothing: the tracker gets the scans one by one."""

    def tracks(self, problem: CrowdProblem) -> Tracks:
        """Answer all queries with the confirmed tracks."""
        started_s = time.process_time()
        tracker = Tracker(_configuration(self.name, problem))
        ego = deque(problem.ego)
        found = []
        known = 0
        for query in problem.queries:
            for scan in problem.scans[known : query.num_known]:
                while ego and ego[0].receipt_ns <= scan.receipt_ns:
                    tracker.receive(ego.popleft())
                tracker.receive(_list(problem, scan))
                tracker.tick(scan.receipt_ns)
            known = query.num_known
            found.append(
                {
                    each.track_id: each.state.mean[:2]
                    for each in tracker.tracks_at(query.stamp_ns)
                    if each.status == TrackStatus.CONFIRMED
                }
            )
        return Tracks(tuple(found), time.process_time() - started_s)


def _list(problem: CrowdProblem, scan: Scan) -> DetectionList:
    """Return a scan as a list, relative to the vehicle if there is one."""
    points_m = scan.points_m
    frame: Frame = "map"
    if problem.ego:
        points_m = (points_m - scan.pose[:2]) @ rotation(scan.pose[2])
        frame = "ego"
    objects = [Detection(x_m=x, y_m=y) for x, y in points_m.tolist()]
    return DetectionList(scan.sensor, scan.stamp_ns, scan.receipt_ns, objects, frame)


def _configuration(estimator_name: str, problem: CrowdProblem) -> Config:
    """Return the model of a problem as a configuration of the tracker."""
    longest_s = problem.max_delay_s + _SPARE_S
    return Config.from_dict(
        {
            "estimator": estimator_name,
            "sensors": {
                name: {
                    "std": {"x_m": sensor.std_m, "y_m": sensor.std_m},
                    "detection_probability": sensor.detection_probability,
                    "clutter_per_m2": sensor.clutter_per_m2,
                    "field_of_view_rad": sensor.field_of_view_rad,
                    "max_range_m": sensor.max_range_m,
                    "max_range_behind_m": sensor.max_range_behind_m,
                    "max_delay_s": longest_s,
                }
                for name, sensor in problem.sensors.items()
            },
            "clock": {"node_hz": None},
            "motion": {
                "kind": "cv",
                "std_per_s": {
                    "velocity": math.sqrt(100.0 * problem.acceleration_density_m2ps3)
                },
            },
            "birth": {"speed_std_mps": problem.speed_mps * math.sqrt(2.0)},
            "filter": {"storage_s": longest_s},
            "smoother": {"lag_s": longest_s},
        }
    )


class Program(Method):
    """A program that is called as `PROGRAM measurements.csv states.csv`."""

    is_traced = False

    def __init__(self, path: Path, time_limit_s: float = TIME_LIMIT_S) -> None:
        self.name = path.name
        self._time_limit_s = time_limit_s
        self._path = path.resolve()

    def answers(self, problem: Problem) -> Answers:
        """Answer all queries. Raises `MethodError` if the program fails or its file cannot be read."""
        count = len(problem.queries)
        found, seconds = self._called(
            lambda folder: write_problem(folder, problem),
            lambda states: tuple(read_states(states, count)),
        )
        return Answers(found, seconds)

    def tracks(self, problem: CrowdProblem) -> Tracks:
        """Answer all queries of a problem with several objects. Raises as `answers`."""
        count = len(problem.queries)
        found, seconds = self._called(
            lambda folder: write_crowd(folder, problem),
            lambda states: read_tracks(states, count),
        )
        return Tracks(found, seconds)

    def _called(
        self,
        write: Callable[[Path], Path],
        read: Callable[[Path], T],
    ) -> tuple[T, float]:
        """Return the content of the program's file, and the time of the call in s."""
        with tempfile.TemporaryDirectory() as folder:
            measurements = write(Path(folder))
            states = Path(folder) / "states.csv"
            started_s = time.perf_counter()
            exit_code, errors = self._run([str(measurements), str(states)])
            seconds = time.perf_counter() - started_s
            last = one_line((errors.strip().splitlines() or ["no message"])[-1])
            if exit_code == NO_PART:
                raise NotImplementedError(f"exit code {exit_code}: {last}")
            if exit_code:
                raise MethodError(f"exit code {exit_code}: {last}")
            if not states.exists():
                raise MethodError(
                    "the program ended with exit code 0 but wrote no states.csv: "
                    "its second argument is the path of that file"
                )
            try:
                return read(states), seconds
            except KeyError as error:
                raise MethodError(
                    f"states.csv: column {error} is missing; the first line must be the header"
                ) from error
            except (OSError, ValueError, csv.Error) as error:
                raise MethodError(f"states.csv: {one_line(str(error))}") from error

    def _run(self, arguments: list[str]) -> tuple[int, str]:
        """Return the exit code of the program, and its messages. Raises `MethodError` if it does not start or end."""
        try:
            process = subprocess.Popen(
                [str(self._path), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,
            )
        except FileNotFoundError as error:
            raise MethodError(
                "the interpreter in its first line (#!) does not exist"
            ) from error
        except OSError as error:
            raise MethodError(
                f"it cannot be started: {error.strerror}; the first line of a script begins with #!"
            ) from error
        with process:
            try:
                _, errors = process.communicate(timeout=self._time_limit_s)
            except subprocess.TimeoutExpired as error:
                _end(process)
                raise MethodError(
                    f"a run takes more than {self._time_limit_s:g} s; --time-limit allows more"
                ) from error
            except BaseException:
                _end(process)
                raise
        return process.returncode, errors


def _end(process: subprocess.Popen[str]) -> None:
    """End a program and the programs that it has started."""
    if hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()
