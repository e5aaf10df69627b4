"""Rewind to the late stamp, correct there, predict to now, and forget the rest."""

from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection
from fgtrack.estimation.oosm.late import LateEkf


class RewindForget(LateEkf):
    """Update at the late stamp, and forget what was fused after it.

    Karle, Fent, Huch, Sauerbeck and Lienkamp, Multi-modal sensor fusion and object tracking for autonomous racing, IEEE
    Transactions on Intelligent Vehicles, 2023, section III-G: x_1 = f(x_{tau|tau}), P_1 = F P_{tau|tau} F' + Q from tau
    to now. Here at the stamp itself; `fgtrack.estimation.filters.backward_forward` has the paper's time grid.

    Exact for: nothing. For what it keeps it is the filter in order of stamps, so it stays consistent, but all
    measurements between the late stamp and the present are lost.
    """

    def _fuse_next(self, measurement: Measurement) -> OneCorrection:
        place = self._history.left(measurement.stamp_ns)
        step, result = self._history.stepped(place, measurement)
        self._history.forget_after(place)
        self._history.append(step)
        return result

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        return self._fuse_next(measurement)
