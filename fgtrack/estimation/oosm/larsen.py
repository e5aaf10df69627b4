"""The late innovation, carried to the present as the filter would have carried its effect."""

import numpy as np

from fgtrack.estimation.oosm.crossing import Past
from fgtrack.estimation.oosm.late import CrossingEkf


class Larsen(CrossingEkf):
    """Correct the present with the innovation against the old prediction, carried through the gains since.

    Larsen, Andersen, Ravn and Poulsen, Incorporation of time delayed measurements in a discrete-time Kalman filter,
    IEEE Conference on Decision and Control, 1998; like Alexander, SPIE 1991. With M the product of (I - K_j H_j) F_j
    over the steps since tau and K_tau the gain at tau:

        x+ = x_k + M K_tau (z - h(x_{tau|m})),   P+ = P_k - M K_tau H P_{tau|m} M'

    that is `fuse_across` with x_{tau|m}, P_{tau|m} and P_k,tau = M P_{tau|m}. The gains since are those that were used,
    for at tau the measurement was unknown. A late measurement stays in the history as an equivalent
    measurement of the step at which it was fused (see `CrossingEkf`).

    Exact for: nothing. It would be, had the covariance been updated at tau already, and all gains since with it. Else
    consistent and suboptimal: what was measured since does not sharpen the innovation.
    """

    def _past(self, stamp_ns: int) -> Past:
        steps = self._history.steps
        left, mean, covariance, M = self._predicted(stamp_ns)
        for place in range(left + 1, len(steps)):
            step = steps[place]
            if place > left + 1:
                M = self._history.transition_to(place) @ M
            M = M - step.predicted_covariance @ (step.weight @ M)
        return Past(mean, covariance, np.asarray(M @ covariance))
