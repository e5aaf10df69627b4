"""Where the time of an update of `smoother` goes: gtsam's own elimination, what Python adds, what callbacks would add.

    python experiments/bench_gtsam_floor.py

One object is tracked with the paper's sensors and delays (`bench_tracker.traffic`) and configs/smoother.yaml. All
that its window asks of gtsam is recorded and asked again of a new solver: the time of that is the floor of any tracker
that solves these windows by gtsam. The same factors as Python functions, which iSAM2 relinearises itself, give the
price of the callbacks. Processor time, median over the rounds.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Annotated, NamedTuple
from unittest.mock import patch

import gtsam
import numpy as np
import typer
from bench_tracker import traffic

from fgtrack.core.types import FloatArray
from fgtrack.estimation.factor_graph import IncrementalBackend
from fgtrack.estimation.factor_graph.backends.base import Change
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.pipeline import build
from fgtrack.pipeline.clock import Tick
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load

CONFIG = Path(__file__).parent.parent / "configs" / "smoother.yaml"
Asked = Change | tuple[int, ...] | list[int]
"""What a window asks: a change, a covariance of one or two variables, or means."""


class Recorder(IncrementalBackend):
    """Remembers what it was asked."""

    def __init__(self, asked: list[Asked]) -> None:
        super().__init__()
        self._asked = asked

    def update(self, change: Change) -> list[int]:
        """See `Backend.update`."""
        self._asked.append(change)
        return super().update(change)

    def means(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.means`."""
        self._asked.append(list(keys))
        return super().means(keys)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.covariance`."""
        self._asked.append(tuple(keys))
        return super().covariance(keys)


class LinearBackend(IncrementalBackend):
    """Times how long it takes to make the factors."""

    spent_ns = 0

    def graph(self, change: Change) -> gtsam.NonlinearFactorGraph:
        """See `IncrementalBackend.graph`."""
        before = time.process_time_ns()
        graph = self._factors(change)
        self.spent_ns += time.process_time_ns() - before
        return graph

    def _factors(self, change: Change) -> gtsam.NonlinearFactorGraph:
        return super().graph(change)


class CallbackBackend(LinearBackend):
    """The same solver with factors that are Python functions; iSAM2 relinearises them."""

    def __init__(self, thresholds: FloatArray) -> None:
        super().__init__()
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")
        params.findUnusedFactorSlots = True
        params.relinearizeSkip = 1
        gauss_newton = gtsam.ISAM2GaussNewtonParams()
        gauss_newton.setWildfireThreshold(0.0)
        params.setOptimizationParams(gauss_newton)
        by_kind = gtsam.ISAM2ThresholdMap()
        by_kind.insert(("x", thresholds))
        params.setRelinearizeThreshold(by_kind)
        self._smoother = gtsam.IncrementalFixedLagSmoother(1e9, params)

    def _factors(self, change: Change) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for factor in change.factors:
            graph.add(factor.nonlinear())
        return graph

    def means(self, keys: Sequence[int]) -> FloatArray:
        """See `Backend.means`."""
        return np.array([self._smoother.calculateEstimateVector(key) for key in keys])


class Parts(NamedTuple):
    """Microseconds per update."""

    factors: float
    """Making the factors."""
    elimination: float
    """iSAM2's update, with what marginalises."""
    means: float
    covariances: float

    @property
    def whole(self) -> float:
        """All of it."""
        return sum(self)


def record(ticks: Sequence[Tick]) -> tuple[list[Asked], float]:
    """What the window of one object asked of gtsam, and the whole time of its tracker, in us per update."""
    asked: list[Asked] = []
    with patch.dict(build._BANKS, smoother=build._smoother(lambda: Recorder(asked))):
        _tracked(ticks)
    num_updates = sum(isinstance(each, Change) for each in asked)
    before = time.process_time_ns()
    _tracked(ticks)
    return asked, (time.process_time_ns() - before) / 1e3 / num_updates


def _tracked(ticks: Sequence[Tick]) -> None:
    tracker = build.build_tracker(load(Config, CONFIG, ["map.track=oval", "map.pit=oval"]))
    for tick in ticks:
        for message in tick.messages:
            tracker.receive(message)
        tracker.tick(tick.now_ns)


def replayed(asked: Sequence[Asked], make: Callable[[], LinearBackend]) -> tuple[Parts, list[FloatArray]]:
    """Times of all that was `asked`, of a new solver, and the means that it gave."""
    backend, means = make(), list[FloatArray]()
    spent_ns = dict.fromkeys(("update", "means", "covariances"), 0)
    for each in asked:
        before = time.process_time_ns()
        if isinstance(each, Change):
            what = "update"
            backend.update(each)
        elif isinstance(each, tuple):
            what = "covariances"
            backend.covariance(each)
        else:
            what = "means"
            means.append(backend.means(each))
        spent_ns[what] += time.process_time_ns() - before
    num_updates = sum(isinstance(each, Change) for each in asked)
    parts = (backend.spent_ns, spent_ns["update"] - backend.spent_ns, spent_ns["means"], spent_ns["covariances"])
    return Parts(*(part / 1e3 / num_updates for part in parts)), means


def table(ticks: Sequence[Tick], rounds: int) -> str:
    """Where the time goes, in Markdown."""
    thresholds = SmootherSettings().thresholds(Config().motion_model(), curved=False)
    recorded = [record(ticks) for _ in range(rounds)]
    asked = recorded[0][0]
    for each in asked:  # linearised by the window, not by the solver
        for factor in each.factors if isinstance(each, Change) else ():
            factor.rows()
    rows = [replayed(asked, LinearBackend)[0] for _ in range(rounds)]
    calls = [replayed(asked, lambda: CallbackBackend(thresholds))[0] for _ in range(rounds)]
    whole = median(us for _, us in recorded)
    lines = ["| us per update | linear factors | callbacks |", "| --- | --- | --- |"]
    names = ("making the factors", "iSAM2's update", "means", "covariances")
    for k, name in enumerate(names):
        lines.append(f"| {name} | {median(part[k] for part in rows):.0f} | {median(part[k] for part in calls):.0f} |")
    floor = median(part.whole for part in rows)
    lines.append(f"| all that is asked of gtsam | {floor:.0f} | {median(part.whole for part in calls):.0f} |")
    lines.append(f"| the whole tracker with one object | {whole:.0f} | - |")
    lines.append(f"| share of gtsam | {floor / whole:.2f} | - |")
    return "\n".join(lines)


def main(
    rounds: Annotated[int, typer.Option(min=1)] = 5,
    num_ticks: Annotated[int, typer.Option(min=20, help="Of 50 per second.")] = 250,
) -> None:
    """Print the table."""
    print(table(traffic(1)[:num_ticks], rounds))


if __name__ == "__main__":
    typer.run(main)
