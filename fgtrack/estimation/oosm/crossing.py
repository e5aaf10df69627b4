"""Methods by which the past corrects the present through their cross-covariance, and that update itself."""

from abc import abstractmethod
from typing import ClassVar, NamedTuple

import numpy as np

from fgtrack.core.linalg import congruence, psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.estimation.filters.ekf import OneCorrection, Prediction, linearised, propagated, robust_weight
from fgtrack.estimation.oosm.late import FilterStep, LateEkf
from fgtrack.estimation.rts import rts_step
from fgtrack.models.motion import MotionModel


class Past(NamedTuple):
    """A method's estimate of the state at the stamp tau of a late measurement."""

    mean: FloatArray
    """x_tau, shape (n,)."""
    covariance: FloatArray
    """P_tau, shape (n, n)."""
    cross: FloatArray
    """Cov(x, x_tau) of the state x to be corrected, shape (m, n)."""


def fuse_across(mean: FloatArray, covariance: FloatArray, past: Past, measurement: Measurement) -> OneCorrection:
    """The state x, `mean` (m,) and `covariance` (m, m), after a measurement of the state `past`.

    S = H P_tau H' + R, x+ = x + C H' S^-1 (z - h(x_tau)), P+ = P - C H' S^-1 H C' with C = Cov(x, x_tau) (Bar-Shalom
    2002, see `A1`), with the weight that a robust loss gives R (see `robust_weight`). Raises
    `numpy.linalg.LinAlgError` where S is not positive definite or the result is not finite.
    """
    y, H = linearised(measurement.z, past.mean, measurement.model, measurement.pose)
    S = propagated(H, past.covariance, measurement.R)
    np.linalg.cholesky(S)  # raises where S is not positive definite
    expected, nis = S, measurement.nis(y, S)
    w = robust_weight(measurement.loss, y, congruence(H, past.covariance), measurement.R)
    if w < 1.0:
        S = propagated(H, past.covariance, measurement.R / w)
    across = past.cross @ H.T
    gain = psd_solve(S, across.T).T
    result = OneCorrection(mean + gain @ y, symmetrise(covariance - gain @ across.T), y, nis, w, expected)
    if not (np.isfinite(result.mean).all() and np.isfinite(result.covariance).all()):
        raise np.linalg.LinAlgError("the measurement gives a state that is not finite")
    return result


class CrossingEkf(LateEkf):
    """A `LateEkf` that corrects the present through its cross-covariance with the past (see `fuse_across`).

    The corrected present enters the history with an equivalent measurement there (see `_absorb`), so a second
    late measurement finds the state that the first one made. What lies between the first one's stamp and the present
    keeps the state it had.
    """

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        now = self._steps[-1]
        past = self._past(measurement.stamp_ns)
        result = fuse_across(now.mean, now.covariance, past, measurement)
        np.linalg.cholesky(result.covariance)  # an approximate cross-covariance may take away more than there is
        self._absorb(result.mean, result.covariance)
        return result

    @abstractmethod
    def _past(self, stamp_ns: int) -> Past:
        """Estimate of the state at `stamp_ns`, and its cross-covariance with the present."""

    def _before(self, stamp_ns: int) -> tuple[int, FloatArray, FloatArray, FloatArray]:
        """Return the index m of the last step before `stamp_ns`; x_{tau|m}, P_{tau|m} and F(m + 1, tau)."""
        index = self._left(stamp_ns)
        mean, covariance = self._predicted(index, stamp_ns)
        F = self._motion.jacobian(mean, seconds(self._steps[index + 1].stamp_ns - stamp_ns))
        return index, mean, covariance, F


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
    """Retrodiction as one lag: through the measurements of the newest stamp, or all since the step m before tau."""

    noise_in_state: ClassVar[bool]
    equivalent: ClassVar[bool] = False

    def _past(self, stamp_ns: int) -> Past:
        now = self._steps[-1]
        if self.equivalent:
            before = self._predicted(self._left(stamp_ns), now.stamp_ns)
        else:
            first = next(step for step in self._steps if step.stamp_ns == now.stamp_ns)
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
        now = self._steps[-1]
        dt_s = seconds(stamp_ns - now.stamp_ns)
        mean, back = self._motion.predict(now.mean, dt_s), self._motion.jacobian(now.mean, dt_s)
        cross = now.covariance @ back.T
        return Past(mean, symmetrise(back @ cross), cross)


class Al1(_OneLag):
    """Algorithm Al1: A1 with the equivalent measurement of the last l steps.

    Bar-Shalom, Chen and Mallick, One-step solution for the multistep out-of-sequence-measurement problem in tracking,
    IEEE Transactions on Aerospace and Electronic Systems 40(1), 2004. The equations of `retrodicted` with the
    prediction of step m to the present as x and P: S*^-1 = P^-1 - P^-1 P_k P^-1, S*^-1 y* = P^-1 (x_k - x). It stores
    mean and covariance of the steps. They are not repaired after a late measurement; that one is part of the
    equivalent measurement, like all that came since m.

    Exact for: one lag, the first late measurement since step m. Numerically the same as `Fpfd` in a linear model.
    """

    exact = "one lag, first late measurement"

    noise_in_state, equivalent = True, True


class Bl1(_OneLag):
    """Algorithm Bl1: Al1 without the noise in the retrodicted state.

    Bar-Shalom, Chen and Mallick 2004 (see `Al1`): x_tau = F(tau, k) x_k and P_vv = Q, so that of the steps only the
    covariances are needed. The Sensor Fusion and Tracking Toolbox of MathWorks names this paper for its `retrodict`.

    Exact for: nothing, but close to `Al1`.
    """

    noise_in_state, equivalent = False, True


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
        steps = self._steps
        left, mean, covariance, F = self._before(stamp_ns)
        smoothed, P, path = steps[-1].mean, steps[-1].covariance, steps[-1].covariance
        for index in range(len(steps) - 1, left, -1):
            after, before = steps[index], steps[index - 1]
            at_tau = index == left + 1
            x, P_x = (mean, covariance) if at_tau else (before.mean, before.covariance)
            transition = F if at_tau else self._transition_to(index)
            predicted = Prediction(after.predicted_mean, after.predicted_covariance, transition @ P_x)
            smoothed, P, gain = rts_step(x, P_x, predicted, smoothed - after.predicted_mean, P)
            path = gain @ path
        return Past(smoothed, P, path.T)


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
        steps = self._steps
        left, mean, covariance, F = self._before(stamp_ns)
        cross = covariance
        for index in range(left + 1, len(steps)):
            step = steps[index]
            cross = (F if index == left + 1 else self._transition_to(index)) @ cross
            weighted = step.weight @ cross
            mean = mean + cross.T @ step.score
            covariance = symmetrise(covariance - cross.T @ weighted)
            cross = cross - step.predicted_covariance @ weighted
        return Past(mean, covariance, cross)


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
        steps = self._steps
        left, mean, covariance, M = self._before(stamp_ns)
        for index in range(left + 1, len(steps)):
            step = steps[index]
            if index > left + 1:
                M = self._transition_to(index) @ M
            M = M - step.predicted_covariance @ (step.weight @ M)
        return Past(mean, covariance, np.asarray(M @ covariance))
