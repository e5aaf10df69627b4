"""Tracks as sliding-window factor graphs: the only importer of gtsam.

One node per distinct stamp, one motion factor per pair of neighbours, one measurement factor per detection. A late
detection splits the motion factor that it falls into; nodes that leave the window are marginalised.
"""

from fgtrack.estimation.factor_graph.bank import SmootherBank
from fgtrack.estimation.factor_graph.batch import BatchBackend
from fgtrack.estimation.factor_graph.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.settings import SmootherSettings
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother

__all__ = ["BatchBackend", "FixedLagSmoother", "IncrementalBackend", "SmootherBank", "SmootherSettings"]
