"""Several lags in one step: all that was measured since counts as one equivalent measurement of the present."""

from typing import ClassVar

from fgtrack.core.time import seconds
from fgtrack.estimation.oosm.crossing import Past
from fgtrack.estimation.oosm.late import CrossingEkf
from fgtrack.estimation.oosm.retrodiction import retrodicted


class _OneStep(CrossingEkf):
    """Retrodiction from the present to the last step m before the late stamp, as one lag."""

    noise_in_state: ClassVar[bool]

    def _past(self, stamp_ns: int) -> Past:
        now = self._history.newest
        before = self._history.predicted(self._history.left(stamp_ns), now.stamp_ns)
        return retrodicted(self._motion, now, before, seconds(now.stamp_ns - stamp_ns), self.noise_in_state)


class Al1(_OneStep):
    """Algorithm Al1: A1 with the equivalent measurement of the last l steps.

    Bar-Shalom, Chen and Mallick, One-step solution for the multistep out-of-sequence-measurement problem in tracking,
    IEEE Transactions on Aerospace and Electronic Systems 40(1), 2004. The equations of `retrodicted` with the
    prediction of step m to the present as x and P: S*^-1 = P^-1 - P^-1 P_k P^-1, S*^-1 y* = P^-1 (x_k - x). It stores
    mean and covariance of the steps. They are not repaired after a late measurement; that one is part of the
    equivalent measurement, like all that came since m.

    Exact for: one lag, the first late measurement since step m. Numerically the same as `Fpfd` in a linear model.
    """

    exact = "one lag, first late measurement"

    noise_in_state = True


class Bl1(_OneStep):
    """Algorithm Bl1: Al1 without the noise in the retrodicted state.

    Bar-Shalom, Chen and Mallick 2004 (see `Al1`): x_tau = F(tau, k) x_k and P_vv = Q, so that of the steps only the
    covariances are needed. The Sensor Fusion and Tracking Toolbox of MathWorks names this paper for its `retrodict`.

    Exact for: nothing, but close to `Al1`.
    """

    noise_in_state = False
