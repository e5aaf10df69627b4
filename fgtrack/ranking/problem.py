"""One object, its measurements in the order of arrival, the questions to a method, and the exact answers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fgtrack.core.geometry import cartesian, cartesian_gradient
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.models.motion import MotionModel
from fgtrack.testing.references import dense_joint

STATE = ("x_m", "y_m", "vx_mps", "vy_mps")
"""Components of an answer, in the map."""
LAGS_S = (0.0, 0.3, 1.0)
"""Times of the questions before the newest stamp."""


@dataclass(frozen=True)
class Arrival:
    """A measurement that is received."""

    receipt_ns: int
    sensor: str
    measurement: Measurement
    """The stamp comes from the clock of the sensor."""
    true_stamp_ns: int

    @property
    def key(self) -> tuple[str, int, bytes]:
        """Value that is equal for two copies of one measurement."""
        return self.sensor, self.measurement.stamp_ns, self.measurement.z.tobytes()

    @property
    def at_true_stamp(self) -> Measurement:
        """Measurement with its true stamp."""
        return replace(self.measurement, stamp_ns=self.true_stamp_ns)


@dataclass(frozen=True)
class Query:
    """Question for the state at a stamp, from the measurements that have been received."""

    num_known: int
    """Number of arrivals that are known."""
    stamp_ns: int
    lag_s: float
    """Time from the stamp to the newest true stamp that is known."""


@dataclass(frozen=True)
class Answer:
    """Mean of x, y, vx, vy, shape (4,), and its covariance, shape (4, 4)."""

    mean: FloatArray
    covariance: FloatArray | None
    """None if the method gives no covariance."""


@dataclass(frozen=True)
class Problem:
    """A scenario that was drawn: what a method is given, and what it is judged by."""

    scenario: str
    motion: MotionModel
    start: Start
    """State before the first measurement."""
    arrivals: tuple[Arrival, ...]
    queries: tuple[Query, ...]
    truth: Mapping[int, FloatArray]
    """True x, y, vx, vy, shape (4,), at the stamp of each query."""

    @property
    def prior(self) -> Answer:
        """State before the first measurement as an answer."""
        mean, covariance = initial_state(self.motion, self.start)
        return answer_of(self.motion, TrackState(self.start.stamp_ns, mean, covariance))

    @cached_property
    def exact(self) -> tuple[Answer, ...]:
        """Exact joint estimate of each query, from the measurements that are known then, copies once.

        The measurements have their true stamps. For nonlinear models it is the maximum of
        the posterior density, with the covariance of its Gaussian approximation.
        """
        answers: dict[Query, Answer] = {}
        for num_known in sorted({query.num_known for query in self.queries}):
            known = {each.key: each.at_true_stamp for each in self.arrivals[:num_known]}
            asked = [query for query in self.queries if query.num_known == num_known]
            states = dense_joint(
                self.motion,
                self.start,
                list(known.values()),
                [query.stamp_ns for query in asked],
            )
            for query in asked:
                answers[query] = answer_of(self.motion, states[query.stamp_ns])
        return tuple(answers[query] for query in self.queries)


def answer_of(motion: MotionModel, state: TrackState) -> Answer:
    """Return x, y, vx, vy of a state of `motion`, with the covariance to first order."""
    if motion.cartesian:
        return Answer(state.mean[:4].copy(), state.covariance[:4, :4].copy())
    mean = state.mean[:4].copy()
    mean[2:] = cartesian(state.mean[2:4])
    gradient = np.eye(4)
    gradient[2:, 2:] = cartesian_gradient(state.mean[2:4])
    return Answer(mean, gradient @ state.covariance[:4, :4] @ gradient.T)


def cut_after(problem: Problem, num_known: int) -> Problem:
    """Return the problem with its first `num_known` arrivals, and the queries that they answer."""
    return replace(
        problem,
        arrivals=problem.arrivals[:num_known],
        queries=tuple(each for each in problem.queries if each.num_known <= num_known),
    )


def queries_of(
    stamps_ns: Sequence[int], start_ns: int, num_times: int
) -> tuple[Query, ...]:
    """Return queries after `num_times` arrivals, evenly spread, and after the latest one.

    Each time asks for the present and for the past. `stamps_ns` are the true stamps of
    the arrivals in their order. The evenly spread queries begin after the first third
    of the arrivals. The latest arrival has the longest time from its stamp to the newest
    stamp. A stamp before `start_ns` is not asked for.
    """
    last = len(stamps_ns)
    newest_ns = np.maximum.accumulate(np.array(stamps_ns))
    latest = int(np.argmax(newest_ns - np.array(stamps_ns))) + 1
    spread = np.linspace(last // 3, last, num_times).round().astype(np.int64)
    queries = []
    for num_known in np.union1d(spread, [latest]).tolist():
        for lag_s in LAGS_S:
            stamp_ns = int(newest_ns[num_known - 1]) - round(lag_s * NS_PER_S)
            if stamp_ns >= start_ns:
                queries.append(Query(num_known, stamp_ns, lag_s))
    return tuple(queries)
