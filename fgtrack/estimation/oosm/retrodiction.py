"""One-lag retrodiction: from the present back to the late stamp, with the process noise that the last step shows."""

from typing import ClassVar

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.oosm.crossing import Past
from fgtrack.estimation.oosm.history import FilterStep
from fgtrack.estimation.oosm.late import CrossingEkf
from fgtrack.models.motion import MotionModel


def retrodicted(
    motion: MotionModel, now: FilterStep, before: tuple[FloatArray, FloatArray], back_s: float, noise_in_state: bool
) -> Past:
    """The state `back_s` before `now`, from `now` and the state `before` the measurements that made it.

    Mean (n,) and covariance (n, n) of `before` are x and P, those of `now` x_k and P_k; Q is the process noise since
    tau, v its value. What was measured since enters as H' S^-1 y = P^-1 (x_k - x) and H' S^-1 H = P^-1 (P - P_k) P^-1:

        x_tau = F(tau, k) (x_k - Q H' S^-1 y)
        P_vv = Q - Q H' S^-1 H Q,   P_xv = Q - P H' S^-1 H Q
        P_tau = F(tau, k) (P_k + P_vv - P_xv - P_xv') F(tau, k)',   P_k,tau = (P_k - P_xv) F(tau, k)'

    Without the noise in the state x_tau = F(tau, k) x_k and P_vv = Q, for then v is not estimated; P_xv stays. See
    Bar-Shalom 2002 for one step, Bar-Shalom, Chen and Mallick 2004 for several taken as one.
    """
    mean, covariance = before
    Q = motion.process_noise(motion.predict(now.mean, -back_s), back_s)
    weighted = psd_solve(covariance, Q)  # P^-1 Q
    gained = covariance - now.covariance
    seen = gained @ weighted  # P H' S^-1 H Q
    P_vv, P_xv, end = Q, Q - seen, now.mean
    if noise_in_state:
        P_vv, end = Q - weighted.T @ seen, now.mean - weighted.T @ (now.mean - mean)
    start, back = motion.predict(end, -back_s), motion.jacobian(end, -back_s)
    spread = back @ (now.covariance + P_vv - P_xv - P_xv.T) @ back.T
    return Past(start, symmetrise(spread), (now.covariance - P_xv) @ back.T)


class _OneLag(CrossingEkf):
    """Retrodiction through the measurements of the newest stamp only, whatever the lag."""

    noise_in_state: ClassVar[bool]

    def _past(self, stamp_ns: int) -> Past:
        now, first = self._history.newest, self._history.first_at_newest
        before = first.predicted_mean, first.predicted_covariance
        return retrodicted(self._motion, now, before, seconds(now.stamp_ns - stamp_ns), self.noise_in_state)


class A1(_OneLag):
    """Algorithm A for one lag: retrodict the state with the process noise estimated from the last innovation.

    Bar-Shalom, Update with out-of-sequence measurements in tracking: exact solution, IEEE Transactions on Aerospace and
    Electronic Systems 38(3), 2002. The equations are those of `retrodicted`, with x and P = x_{k|k-1}, P_{k|k-1}, then
    `fuse_across`. It stores nothing of older steps, so at l lags the same equations are used with the whole noise
    Q(k, tau) and the last innovation alone, and an earlier late measurement counts as one of the newest stamp.

    Exact for: one lag, the first late measurement since the newest stamp. At several lags it takes away more
    covariance than there is, the more so the larger Q is; where none would be left the measurement is `failed`.
    """

    exact = "one lag, first late measurement"

    noise_in_state = True


class B1(_OneLag):
    """Algorithm B for one lag: A1 without the noise in the retrodicted state.

    Hilton, Martin and Blair, Tracking with time-delayed data in multisensor systems, NSWCDD technical report, 1993;
    Blackman and Popoli, Design and analysis of modern tracking systems, 1999; called B in Bar-Shalom 2002.
    x_tau = F(tau, k) x_k and P_vv = Q, the rest as in `A1`, and so are its ways with lags and further late
    measurements.

    Exact for: nothing, but close at one lag. Overconfident at many.
    """

    noise_in_state = False


class C(CrossingEkf):
    """Algorithm C: retrodict as if there were no process noise.

    Bar-Shalom 2002 (see `A1`). x_tau = F(tau, k) x_k, P_tau = F(tau, k) P_k F(tau, k)', P_k,tau = P_k F(tau, k)', then
    `fuse_across`. It needs no history, and a further late measurement finds the present as it is.

    Exact for: no process noise, any lag and number. Else overconfident, at many lags badly.
    """

    exact = "no process noise: any lag, any number"

    def _past(self, stamp_ns: int) -> Past:
        now = self._history.newest
        dt_s = seconds(stamp_ns - now.stamp_ns)
        mean, back = self._motion.predict(now.mean, dt_s), self._motion.jacobian(now.mean, dt_s)
        cross = now.covariance @ back.T
        return Past(mean, symmetrise(back @ cross), cross)
