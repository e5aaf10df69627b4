"""Without compensation: ignore late measurements, or take them as current."""

from dataclasses import replace

from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection
from fgtrack.estimation.oosm.late import LateEkf


class Drop(LateEkf):
    """Ignore a late measurement: it is `too_old`.

    The floor of every comparison ("neglect" in the Sensor Fusion and Tracking Toolbox of MathWorks).

    Exact for: nothing; but consistent, for what is left is in sequence.
    """

    def _fuse_late(self, measurement: Measurement) -> None:
        """Nothing."""


class AsCurrent(LateEkf):
    """Take a late measurement as if it had been made at the newest stamp fused.

    What a filter without stamps does (no source): x+ = x_k + K (z - h(x_k)). The object has moved on by speed times
    lag since, which the covariance leaves out.

    Exact for: nothing; overconfident.
    """

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        return self._fuse_next(replace(measurement, stamp_ns=self._newest_ns))
