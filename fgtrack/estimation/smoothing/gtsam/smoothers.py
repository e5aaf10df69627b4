"""The smoothers of one object that gtsam solves, by name."""

from typing import Any

from fgtrack.estimation.base import Start
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.smoothing.bank import FixedLagSmoother
from fgtrack.estimation.smoothing.gtsam.batch import BatchSolver
from fgtrack.estimation.smoothing.gtsam.incremental import IncrementalSolver
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.motion import MotionModel


# Any: an option may be any value that `SmootherSettings` takes.
def smoother(
    motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
) -> FixedLagSmoother:
    """Fixed-lag smoother, a factor graph that iSAM2 solves incrementally."""
    settings = SmootherSettings.of_options(lag_s, options)
    return FixedLagSmoother(motion, start, settings, IncrementalSolver, initiation)


def smoother_batch(
    motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
) -> FixedLagSmoother:
    """Fixed-lag smoother, a factor graph that Levenberg-Marquardt solves at every update: slow, for checks."""
    settings = SmootherSettings.of_options(lag_s, options)
    return FixedLagSmoother(motion, start, settings, BatchSolver, initiation)


_EXACT = {"exact": "any lag, any number", "nonlinear": "at convergence", "smooths": True, "initiates": True}
vars(smoother).update(_EXACT, rounding=1.0)
# Levenberg-Marquardt compares errors at absolute positions: eps W of 50 m instead of the standard deviation, 0.5 m.
vars(smoother_batch).update(_EXACT, rounding=100.0, tolerance=1e-6)
