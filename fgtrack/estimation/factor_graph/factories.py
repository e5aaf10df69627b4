"""The smoother of one object, by name."""

from collections.abc import Callable
from typing import Any

from fgtrack.estimation.base import Start
from fgtrack.estimation.factor_graph.backends.batch import BatchBackend
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.initiation import DEFAULT
from fgtrack.estimation.smoother_settings import SmootherSettings
from fgtrack.models.motion import MotionModel


# Any: an option may be any value that `SmootherSettings` takes.
def smoother(
    motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
) -> FixedLagSmoother:
    """Fixed-lag smoother, a factor graph that iSAM2 solves incrementally."""
    settings = SmootherSettings.of_options(lag_s, options)
    return FixedLagSmoother(motion, start, settings, initiation=initiation)


def smoother_batch(
    motion: MotionModel, start: Start, lag_s: float, initiation: str = DEFAULT, **options: Any
) -> FixedLagSmoother:
    """Fixed-lag smoother, a factor graph that Levenberg-Marquardt solves anew at every update: slow, for checks."""
    settings = SmootherSettings.of_options(lag_s, options)
    return FixedLagSmoother(motion, start, settings, BatchBackend, initiation)


def _claim(factory: Callable[..., FixedLagSmoother], rounding: float, tolerance: float = 1e-9) -> None:
    """See `registry.Claims`."""
    vars(factory).update(
        exact="any lag, any number",
        nonlinear="at convergence",
        smooths=True,
        initiates=True,
        tolerance=tolerance,
        rounding=rounding,
    )


_claim(smoother, rounding=1.0)
# Levenberg-Marquardt compares errors at absolute positions: eps W of 50 m instead of the standard deviation, 0.5 m.
_claim(smoother_batch, rounding=100.0, tolerance=1e-6)
