"""Out-of-sequence methods of the literature, each an `Estimator` of one object.

`k` is the newest step, `tau` the stamp of a late measurement, `m` the last step before it; the lag l = k - m is
counted in steps. The methods differ in what they know of the state at tau; most end in `fuse_across`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fgtrack.estimation.base import Estimator, Start
from fgtrack.estimation.oosm.asd import AccumulatedStateDensity
from fgtrack.estimation.oosm.forward import CovarianceIntersection, Fpfd, determinant, trace
from fgtrack.estimation.oosm.held import DelayedHorizon, ReorderBuffer
from fgtrack.estimation.oosm.larsen import Larsen
from fgtrack.estimation.oosm.one_step import Al1, Bl1
from fgtrack.estimation.oosm.policies import AsCurrent, Drop
from fgtrack.estimation.oosm.retrodiction import A1, B1, C
from fgtrack.estimation.oosm.rewind_forget import RewindForget
from fgtrack.estimation.oosm.rts import RtsCrossCovariance
from fgtrack.estimation.oosm.zlz import FixedPoint
from fgtrack.models.motion import MotionModel

__all__ = [
    "A1",
    "OOSM_METHODS",
    "AccumulatedStateDensity",
    "Al1",
    "AsCurrent",
    "B1",
    "RewindForget",
    "Bl1",
    "C",
    "CovarianceIntersection",
    "DelayedHorizon",
    "Drop",
    "FixedPoint",
    "Fpfd",
    "Larsen",
    "Method",
    "ReorderBuffer",
    "RtsCrossCovariance",
    "determinant",
    "trace",
]


@dataclass(frozen=True, slots=True)
class Method:
    """A way to deal with late measurements."""

    start: Callable[[MotionModel, Start, float], Estimator]
    """The estimator of a new object, from motion model, prior and length of the window in s."""
    exact: str
    """For which late measurements a linear model gets the answer of the time order; empty where for none."""


#: Methods by name.
OOSM_METHODS: Mapping[str, Method] = {
    "drop": Method(Drop, ""),
    "as-current": Method(AsCurrent, ""),
    "delayed-horizon": Method(DelayedHorizon, "up to now - D: any lag, any number"),
    "reorder-buffer": Method(ReorderBuffer, "up to D before the newest stamp: any lag, any number"),
    "a1": Method(A1, "one lag, first late measurement"),
    "b1": Method(B1, ""),
    "c": Method(C, "no process noise: any lag, any number"),
    "al1": Method(Al1, "one lag, first late measurement"),
    "bl1": Method(Bl1, ""),
    "rts": Method(RtsCrossCovariance, "any lag, first late measurement"),
    "zlz": Method(FixedPoint, "any lag, first late measurement"),
    "asd": Method(AccumulatedStateDensity, "any lag, any number"),
    "fpfd": Method(Fpfd, "one lag, first late measurement"),
    "ci": Method(CovarianceIntersection, ""),
    "larsen": Method(Larsen, ""),
    "rewind-forget": Method(RewindForget, ""),
}
