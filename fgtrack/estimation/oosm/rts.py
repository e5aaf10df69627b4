"""Smoother gains from the present back to the late stamp."""

from fgtrack.estimation.filters.ekf import Prediction
from fgtrack.estimation.oosm.crossing import Past
from fgtrack.estimation.oosm.late import CrossingEkf
from fgtrack.estimation.rts import rts_step


class RtsCrossCovariance(CrossingEkf):
    """Smooth back to the late stamp, with the product of the smoother gains as cross-covariance.

    Rauch, Tung and Striebel, Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3(8), 1965, for the
    gains; Challa, Evans and Wang, A Bayesian solution and its approximations to out-of-sequence measurement problems,
    Information Fusion 4(3), 2003, for their use. With C_j = P_{j|j} F_{j+1}' P_{j+1|j}^-1, from j = k - 1 to tau:

        x_j = x_{j|j} + C_j (x_{j+1} - x_{j+1|j}),   P_j = P_{j|j} + C_j (P_{j+1} - P_{j+1|j}) C_j'
        P_k,tau = (C_tau C_{m+1} ... C_{k-1} P_k)'

    where tau lies between the steps m and m + 1 with x_{tau|m}, P_{tau|m}. Then `fuse_across`. The history is not
    repaired after a late measurement: the next one starts from the corrected present.

    Exact for: any lag, the first late measurement since step m.
    """

    exact = "any lag, first late measurement"

    def _past(self, stamp_ns: int) -> Past:
        steps = self._history.steps
        left, mean, covariance, F = self._predicted(stamp_ns)
        smoothed, P, path = steps[-1].mean, steps[-1].covariance, steps[-1].covariance
        for place in range(len(steps) - 1, left, -1):
            after, before = steps[place], steps[place - 1]
            at_tau = place == left + 1
            x, P_x = (mean, covariance) if at_tau else (before.mean, before.covariance)
            transition = F if at_tau else self._history.transition_to(place)
            predicted = Prediction(after.predicted_mean, after.predicted_covariance, transition @ P_x)
            smoothed, P, gain = rts_step(x, P_x, predicted, smoothed - after.predicted_mean, P)
            path = gain @ path
        return Past(smoothed, P, path.T)
