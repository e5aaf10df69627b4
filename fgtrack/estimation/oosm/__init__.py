"""Out-of-sequence methods of the literature, each an `Estimator` of one object.

`k` is the newest step, `tau` the stamp of a late measurement, `m` the last step before it; the lag l = k - m is
counted in steps. The methods differ in their estimate of the state at tau; most end in `fuse_across`.
"""

from fgtrack.estimation.oosm.asd import AccumulatedStateDensity
from fgtrack.estimation.oosm.buffers import DelayedHorizon, ReorderBuffer
from fgtrack.estimation.oosm.crossing import A1, B1, Al1, Bl1, C, FixedPoint, Larsen, RtsCrossCovariance
from fgtrack.estimation.oosm.forward import CovarianceIntersection, Fpfd
from fgtrack.estimation.oosm.late import AsCurrent, Drop, RewindForget

__all__ = [
    "A1",
    "AccumulatedStateDensity",
    "Al1",
    "AsCurrent",
    "B1",
    "Bl1",
    "C",
    "CovarianceIntersection",
    "DelayedHorizon",
    "Drop",
    "FixedPoint",
    "Fpfd",
    "Larsen",
    "ReorderBuffer",
    "RewindForget",
    "RtsCrossCovariance",
]
