"""The late state carried along as a fixed point."""

from fgtrack.core.linalg import symmetrise
from fgtrack.estimation.oosm.crossing import Past
from fgtrack.estimation.oosm.late import CrossingEkf


class FixedPoint(CrossingEkf):
    """Carry the state at the late stamp, and its cross-covariance with the filter's, through the steps since.

    Zhang, Li and Zhu, Optimal update with out-of-sequence measurements, IEEE Transactions on Signal Processing 53(6),
    2005. From x_{tau|m}, P_{tau|m} and U- = F(m + 1, tau) P_{tau|m}, at each step j = m + 1 ... k:

        x_tau += U-' H' S^-1 y,   P_tau -= U-' H' S^-1 H U-,   U = (I - K H) U-,   U- = F_{j+1} U

    and at last P_k,tau = U, then `fuse_across`. No state is smoothed and no measurement applied again. A late
    measurement stays in the history as an equivalent measurement of the step at which it was fused (see `CrossingEkf`).

    Exact for: any lag, the first late measurement since step m.
    """

    exact = "any lag, first late measurement"

    def _past(self, stamp_ns: int) -> Past:
        steps = self._history.steps
        left, mean, covariance, F = self._predicted(stamp_ns)
        cross = covariance
        for place in range(left + 1, len(steps)):
            step = steps[place]
            cross = (F if place == left + 1 else self._history.transition_to(place)) @ cross
            weighted = step.weight @ cross
            mean = mean + cross.T @ step.score
            covariance = symmetrise(covariance - cross.T @ weighted)
            cross = cross - step.predicted_covariance @ weighted
        return Past(mean, covariance, cross)
