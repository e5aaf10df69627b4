"""Every estimator that promises an exact answer: a line in `SUBJECTS`, and the whole contract runs on it.

A method that is exact in a linear model gives the mean and covariance of the dense joint Gaussian of all that it has
accepted, whatever the order of arrival. In a nonlinear model it may promise the answer of its own time order: "at
once", or "at convergence" where it linearises at estimates that later ones correct, or "never" where it keeps its
linearisation. A method that is exact for a first or a single late measurement only (such as Al1 or RTS) belongs in
no list here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Start
from fgtrack.estimation.dense_joint import rounding_bound
from fgtrack.estimation.factor_graph import BatchBackend, FixedLagSmoother, IncrementalBackend, SmootherSettings
from fgtrack.estimation.factor_graph.backends.base import Backend
from fgtrack.estimation.oosm import AccumulatedStateDensity
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel

LAG_S = 2.0
START_NS = 1_790_000_000_000_000_000
MOTIONS: dict[str, MotionModel] = {"cv": CV(), "ctrv": CTRV(), "ctra": CTRA()}
NONLINEAR = ("ctrv", "ctra")

TINY = dict.fromkeys(("x_m", "y_m", "yaw_rad", "speed_mps", "yaw_rate_radps", "accel_mps2"), 1e-7)
"""Relinearisation thresholds at which the smoother of a nonlinear model follows every move."""

Late = Literal["fuse", "drop", "raise"]
MakeBackend = Callable[[FloatArray], Backend]
StartEstimator = Callable[[MotionModel, SmootherSettings], Estimator]


def prior() -> Start:
    return Start(
        stamp_ns=START_NS,
        position_m=(3.0, -2.0),
        position_covariance=np.diag([0.5, 0.5]),
        yaw_rad=0.4,
        yaw_std_rad=0.3,
        speed_mps=20.0,
        speed_std_mps=3.0,
        yaw_rate_radps=0.1,
        yaw_rate_std_radps=0.3,
    )


def settings(lag_s: float = LAG_S, late: Late = "fuse", ring_s: float = 10.0) -> SmootherSettings:
    return SmootherSettings(lag_s=lag_s, late=late, ring_s=ring_s, relinearise=TINY, lagged_s=())


def _replay(motion: MotionModel, chosen: SmootherSettings) -> ReplayEkf:
    return ReplayEkf(motion, prior(), chosen.lag_s)


def _accumulated(motion: MotionModel, chosen: SmootherSettings) -> AccumulatedStateDensity:
    return AccumulatedStateDensity(motion, prior(), chosen.lag_s)


def smoother(motion: MotionModel, chosen: SmootherSettings, make_backend: MakeBackend) -> FixedLagSmoother:
    return FixedLagSmoother(motion, prior(), chosen, make_backend)


@dataclass(frozen=True)
class Subject:
    """An estimator under the contract."""

    start: StartEstimator
    smooths: bool
    """Whether a state of the past knows later measurements; a filter's does not."""
    linear_bar: float
    """Largest difference to the dense joint in a linear model, in standard deviations."""
    nonlinear: Literal["at once", "at convergence", "never"]
    """When any order of arrival gives the answer of the time order in a nonlinear model."""
    examples: int
    """Random streams per property in the default suite."""
    rounding: float
    """How many times the `rounding_bound` it may be off where stamps nearly coincide."""

    def bar(self, motion: MotionModel, stamps_ns: list[int]) -> float:
        """`linear_bar`, or what rounding leaves of it."""
        return max(self.linear_bar, self.rounding * rounding_bound(motion, [START_NS, *stamps_ns]))


def _smoother(make: MakeBackend) -> StartEstimator:
    return lambda motion, chosen: smoother(motion, chosen, make)


BACKENDS: dict[str, MakeBackend] = {"smoother": IncrementalBackend, "smoother-batch": BatchBackend}

SUBJECTS: dict[str, Subject] = {
    "ekf-replay": Subject(_replay, False, 1e-9, "at once", 40, rounding=0.0),
    # Splits the state between two neighbours off a joint covariance, which costs digits where they are close.
    "asd": Subject(_accumulated, True, 1e-7, "never", 10, rounding=0.0),
    "smoother": Subject(_smoother(IncrementalBackend), True, 1e-9, "at convergence", 40, rounding=1.0),
    # Levenberg-Marquardt compares errors at absolute positions: eps W of 50 m instead of the deviation, 0.5 m.
    "smoother-batch": Subject(_smoother(BatchBackend), True, 1e-6, "at convergence", 8, rounding=100.0),
}
SMOOTHERS = tuple(BACKENDS)


def converged(estimator: Estimator) -> Estimator:
    """`estimator`, relinearised until nothing moves where it is of the kind that does."""
    if isinstance(estimator, FixedLagSmoother):
        estimator.converge(10)
    return estimator
