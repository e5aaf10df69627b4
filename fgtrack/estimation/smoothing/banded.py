"""The smoother of one object that is solved without gtsam, by name."""

from typing import Any

from fgtrack.estimation.base import Start
from fgtrack.estimation.filters.initiation import DEFAULT
from fgtrack.estimation.smoothing.bank import FixedLagSmoother
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.motion import MotionModel


# Any: an option may be any value that `SmootherSettings` takes.
def smoother_banded(
    motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
) -> FixedLagSmoother:
    """Fixed-lag smoother, solved in covariance form by compiled code, all objects of a tracker together."""
    return FixedLagSmoother(motion, start, SmootherSettings.of_options(lag_s, options), initiation=initiation)


vars(smoother_banded).update(exact="any lag, any number", nonlinear="at convergence", smooths=True, initiates=True)
