"""Methods that correct the present through its cross-covariance with the state at the late stamp."""

from abc import abstractmethod

import numpy as np

from fgtrack.core.linalg import congruence, identity, psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import (
    Correction,
    OneCorrection,
    Prediction,
    propagated,
    robust_weight,
)
from fgtrack.estimation.oosm.late import FilterStep, RewindForget
from fgtrack.estimation.rts import rts_step

Past = tuple[FloatArray, FloatArray, FloatArray]
"""Mean x_tau (n,) and covariance P_tau (n, n) of the estimate at the stamp tau of a late measurement, and the
covariance (m, n) of the present state with the state at tau.
"""


def fuse_across(
    mean: FloatArray, covariance: FloatArray, past: Past, measurement: Measurement
) -> OneCorrection:
    """Return the state x, `mean` (m,) and `covariance` (m, m), after a measurement of the `past` state.

    S = H P_tau H' + R, x+ = x + C H' S^-1 (z - h(x_tau)), P+ = P - C H' S^-1 H C' with C = Cov(x, x_tau)
    (Bar-Shalom 2002, see `A1`). A robust loss divides R by its weight (see `robust_weight`). Raises
    `numpy.linalg.LinAlgError` if S is not positive definite or the result is not finite.
    """
    x_tau, P_tau, cross = past
    y, H = measurement.model.linearised(measurement.z, x_tau, measurement.pose)
    S = propagated(H, P_tau, measurement.R)
    np.linalg.cholesky(S)  # raises where S is not positive definite
    expected, nis = S, measurement.nis(y, S)
    w = robust_weight(measurement.loss, y, congruence(H, P_tau), measurement.R)
    if w < 1.0:
        S = propagated(H, P_tau, measurement.R / w)
    across = cross @ H.T
    gain = psd_solve(S, across.T).T
    result = Correction(
        mean + gain @ y, symmetrise(covariance - gain @ across.T), y, nis, w, expected
    )
    if not (np.isfinite(result.mean).all() and np.isfinite(result.covariance).all()):
        raise np.linalg.LinAlgError("the measurement gives a state that is not finite")
    return result


class CrossingEkf(RewindForget):
    """EKF that corrects the present through its cross-covariance with the past (see `fuse_across`).

    The corrected present enters the history with an equivalent measurement (see `_absorb`). A second late measurement
    starts from this step. Earlier steps are not changed.
    """

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        now = self._steps[-1]
        past = self._past(measurement.stamp_ns)
        result = fuse_across(now.mean, now.covariance, past, measurement)
        np.linalg.cholesky(
            result.covariance
        )  # with an approximate cross-covariance, P+ may be indefinite
        self._absorb(result.mean, result.covariance)
        return result

    @abstractmethod
    def _past(self, stamp_ns: int) -> Past:
        """Estimate of the state at `stamp_ns`, and its cross-covariance with the present."""

    def _since(
        self, stamp_ns: int
    ) -> tuple[FloatArray, FloatArray, list[tuple[FilterStep, FloatArray]]]:
        """Return the predicted mean and covariance at `stamp_ns`, and each later step.

        Each step comes with the Jacobian F (n, n) of the motion from the step before, or from the stamp.
        """
        left = self._left(stamp_ns)
        mean, covariance = self._predicted(left, stamp_ns)
        since, x, at_ns = [], mean, stamp_ns
        for step in self._steps[left + 1 :]:
            since.append(
                (step, self._motion.jacobian(x, seconds(step.stamp_ns - at_ns)))
            )
            x, at_ns = step.mean, step.stamp_ns
        return mean, covariance, since


class A1(CrossingEkf):
    """Algorithm A for one lag: retrodict the state with the process noise estimated from the last innovation.

    Bar-Shalom, Update with out-of-sequence measurements in tracking: exact solution, IEEE Transactions on Aerospace and
    Electronic Systems 38(3), 2002. With x and P = x_{k|k-1}, P_{k|k-1}, the process noise Q since tau and its value v,
    the last measurement enters as H' S^-1 y = P^-1 (x_k - x) and H' S^-1 H = P^-1 (P - P_k) P^-1:

        x_tau = F(tau, k) (x_k - Q H' S^-1 y)
        P_vv = Q - Q H' S^-1 H Q,   P_xv = Q - P H' S^-1 H Q
        P_tau = F(tau, k) (P_k + P_vv - P_xv - P_xv') F(tau, k)',   P_k,tau = (P_k - P_xv) F(tau, k)'

    then `fuse_across`. At l lags the same equations are used with the whole noise Q(k, tau) and the last innovation
    alone.

    Exact for: one lag, the first late measurement since the newest stamp. At several lags it subtracts too much
    covariance, and more for a larger Q. A measurement that would leave no covariance is `failed`.
    """

    exact = "one lag, first late measurement"
    noise_in_state, equivalent = True, False
    """`noise_in_state` False: v is not estimated. `equivalent` True: v is estimated from all steps since m, not
    from the newest measurement alone.
    """

    def _past(self, stamp_ns: int) -> Past:
        now, motion = self._steps[-1], self._motion
        back_s = seconds(now.stamp_ns - stamp_ns)
        if self.equivalent:
            mean, covariance = self._predicted(self._left(stamp_ns), now.stamp_ns)
        else:
            first = next(step for step in self._steps if step.stamp_ns == now.stamp_ns)
            mean, covariance = first.predicted_mean, first.predicted_covariance
        Q = motion.process_noise(motion.predict(now.mean, -back_s), back_s)
        weighted = psd_solve(covariance, Q)  # P^-1 Q
        gained = (covariance - now.covariance) @ weighted  # P H' S^-1 H Q
        P_vv, P_xv, end = Q, Q - gained, now.mean
        if self.noise_in_state:
            P_vv, end = (
                Q - weighted.T @ gained,
                now.mean - weighted.T @ (now.mean - mean),
            )
        start, back = motion.predict(end, -back_s), motion.jacobian(end, -back_s)
        spread = back @ (now.covariance + P_vv - P_xv - P_xv.T) @ back.T
        return start, symmetrise(spread), (now.covariance - P_xv) @ back.T


class B1(A1):
    """Algorithm B for one lag: A1 without the noise in the retrodicted state.

    Hilton, Martin and Blair, Tracking with time-delayed data in multisensor systems, NSWCDD technical report, 1993;
    Blackman and Popoli, Design and analysis of modern tracking systems, 1999; called B in Bar-Shalom 2002. x_tau =
    F(tau, k) x_k and P_vv = Q, the rest as in `A1`.

    Exact for: nothing, but close at one lag. Overconfident at many.
    """

    exact = ""
    noise_in_state = False


class C(CrossingEkf):
    """Algorithm C: retrodict as if there were no process noise.

    Bar-Shalom 2002 (see `A1`). x_tau = F(tau, k) x_k, P_tau = F(tau, k) P_k F(tau, k)', P_k,tau = P_k F(tau, k)', then
    `fuse_across`. It needs no history.

    Exact for: no process noise, any lag and number. Else overconfident, at many lags badly.
    """

    exact = "no process noise: any lag, any number"

    def _past(self, stamp_ns: int) -> Past:
        now = self._steps[-1]
        dt_s = seconds(stamp_ns - now.stamp_ns)
        mean, back = (
            self._motion.predict(now.mean, dt_s),
            self._motion.jacobian(now.mean, dt_s),
        )
        cross = now.covariance @ back.T
        return mean, symmetrise(back @ cross), cross


class Al1(A1):
    """Algorithm Al1: A1 with the equivalent measurement of the last l steps.

    Bar-Shalom, Chen and Mallick, One-step solution for the multistep out-of-sequence-measurement problem in tracking,
    IEEE Transactions on Aerospace and Electronic Systems 40(1), 2004. The equations of `A1` with the prediction of step
    m to the present as x and P: S*^-1 = P^-1 - P^-1 P_k P^-1, S*^-1 y* = P^-1 (x_k - x).

    Exact for: one lag, the first late measurement since step m. Numerically the same as `Fpfd` in a linear model.
    """

    equivalent = True


class Bl1(B1):
    """Algorithm Bl1: Al1 without the noise in the retrodicted state.

    Bar-Shalom, Chen and Mallick 2004 (see `Al1`): x_tau = F(tau, k) x_k and P_vv = Q. The Sensor Fusion and Tracking
    Toolbox of MathWorks names this paper for its `retrodict`.

    Exact for: nothing, but close to `Al1`.
    """

    equivalent = True


class RtsCrossCovariance(CrossingEkf):
    """Smooth back to the late stamp, with the product of the smoother gains as cross-covariance.

    Rauch, Tung and Striebel (see `rts_step`) for the gains; Challa, Evans and Wang, A Bayesian solution and its
    approximations to out-of-sequence measurement problems, Information Fusion 4(3), 2003, for their use. With C_j =
    P_{j|j} F_{j+1}' P_{j+1|j}^-1, from j = k - 1 to tau:

        x_j = x_{j|j} + C_j (x_{j+1} - x_{j+1|j}),   P_j = P_{j|j} + C_j (P_{j+1} - P_{j+1|j}) C_j'
        P_k,tau = (C_tau C_{m+1} ... C_{k-1} P_k)'

    where tau lies between the steps m and m + 1 with x_{tau|m}, P_{tau|m}. Then `fuse_across`.

    Exact for: any lag, the first late measurement since step m.
    """

    exact = "any lag, first late measurement"

    def _past(self, stamp_ns: int) -> Past:
        x, P_x, since = self._since(stamp_ns)
        before = [(x, P_x), *((step.mean, step.covariance) for step, _ in since)]
        smoothed, P, path = (
            self._steps[-1].mean,
            self._steps[-1].covariance,
            self._steps[-1].covariance,
        )
        for (x, P_x), (after, F) in zip(
            reversed(before[:-1]), reversed(since), strict=True
        ):
            predicted = Prediction(
                after.predicted_mean, after.predicted_covariance, F @ P_x
            )
            smoothed, P, gain = rts_step(
                x, P_x, predicted, smoothed - after.predicted_mean, P
            )
            path = gain @ path
        return smoothed, P, path.T


class FixedPoint(CrossingEkf):
    """Carry the state at the late stamp, and its cross-covariance with the filter's, through the steps since.

    Zhang, Li and Zhu, Optimal update with out-of-sequence measurements, IEEE Transactions on Signal Processing 53(6),
    2005. From x_{tau|m}, P_{tau|m} and U- = F(m + 1, tau) P_{tau|m}, at each step j = m + 1 ... k:

        x_tau += U-' H' S^-1 y,   P_tau -= U-' H' S^-1 H U-,   U = (I - K H) U-,   U- = F_{j+1} U

    and at last P_k,tau = U, then `fuse_across`.

    Exact for: any lag, the first late measurement since step m.
    """

    exact = "any lag, first late measurement"

    def _past(self, stamp_ns: int) -> Past:
        mean, covariance, since = self._since(stamp_ns)
        cross = covariance
        for step, F in since:
            cross = F @ cross
            weighted = step.weight @ cross
            mean = mean + cross.T @ step.score
            covariance = symmetrise(covariance - cross.T @ weighted)
            cross = cross - step.predicted_covariance @ weighted
        return mean, covariance, cross


class Larsen(CrossingEkf):
    """Correct the present with the innovation against the old prediction, carried through the gains since.

    Larsen, Andersen, Ravn and Poulsen, Incorporation of time delayed measurements in a discrete-time Kalman filter,
    IEEE Conference on Decision and Control, 1998; like Alexander, SPIE 1991. M is the product of (I - K_j H_j) F_j
    over the steps since tau, and K_tau is the gain at tau:

        x+ = x_k + M K_tau (z - h(x_{tau|m})),   P+ = P_k - M K_tau H P_{tau|m} M'

    This is `fuse_across` with x_{tau|m}, P_{tau|m} and P_k,tau = M P_{tau|m}, with the gains that were used.

    Exact for: nothing. Consistent and suboptimal: measurements since tau do not sharpen the innovation.
    """

    def _past(self, stamp_ns: int) -> Past:
        mean, covariance, since = self._since(stamp_ns)
        M = identity(len(mean))
        for step, F in since:
            M = F @ M
            M = M - step.predicted_covariance @ (step.weight @ M)
        return mean, covariance, M @ covariance
