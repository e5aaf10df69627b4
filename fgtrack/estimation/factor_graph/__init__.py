"""Tracks as sliding-window factor graphs: the only importer of gtsam.

One node per distinct stamp, one motion factor per pair of neighbours, one measurement factor per detection. A late
detection splits the motion factor that it falls into; nodes that leave the window are marginalised.
"""

from fgtrack.estimation.factor_graph.backends.batch import BatchBackend
from fgtrack.estimation.factor_graph.backends.incremental import IncrementalBackend
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.estimation.factor_graph.smoother_bank import SmootherBank
from fgtrack.estimation.smoother_settings import SmootherSettings

__all__ = ["BatchBackend", "FixedLagSmoother", "IncrementalBackend", "SmootherBank", "SmootherSettings"]
