"""EKFs that treat a late measurement in one step: ignore it, take it as current, roll back, or predict it forward."""

import bisect
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.optimize import minimize_scalar

from fgtrack.core.linalg import identity, psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, asked_stamp
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import (
    Correction,
    OneCorrection,
    correct_one,
    predict,
    propagated,
)
from fgtrack.estimation.filters.propagation import track_state, wrapped
from fgtrack.estimation.filters.windowed import WindowedFilter
from fgtrack.models.motion import MotionModel

_Estimate = tuple[FloatArray, FloatArray]
"""Mean (n,) and covariance (n, n) at the present stamp."""


@dataclass(frozen=True, slots=True)
class FilterStep:
    """A state before and after a measurement, and the information of the measurement. Yaws are not wrapped."""

    stamp_ns: int
    mean: FloatArray
    """x_{j|j}, shape (n,)."""
    covariance: FloatArray
    """P_{j|j}, shape (n, n)."""
    predicted_mean: FloatArray
    """x_{j|j-1}, shape (n,)."""
    predicted_covariance: FloatArray
    """P_{j|j-1}, shape (n, n)."""
    score: FloatArray
    """H' S^-1 y, shape (n,)."""
    weight: FloatArray
    """H' S^-1 H, shape (n, n). I - K H is I - P_{j|j-1} weight."""


class RewindForget(WindowedFilter):
    """EKF that updates at the late stamp, and forgets the measurements that were fused after this stamp.

    Karle, Fent, Huch, Sauerbeck and Lienkamp, Multi-modal sensor fusion and object tracking for autonomous racing, IEEE
    Transactions on Intelligent Vehicles, 2023, section III-G: x_1 = f(x_{tau|tau}), P_1 = F P_{tau|tau} F' + Q from tau
    to now. This class updates at the stamp itself; `fgtrack.karle2023.backward_forward` has the paper's time grid.
    Subclasses override `_fuse_late`. All are linearised at the stored means.

    Exact for: nothing; consistent, but all measurements between the late stamp and the present are lost.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *WindowedFilter.STATE,
        "_steps",
    )

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float) -> None:
        super().__init__(motion, prior, lag_s)
        x, P = initial_state(motion, prior)
        self._steps = [
            FilterStep(prior.stamp_ns, x, P, x, P, np.zeros_like(x), np.zeros_like(P))
        ]
        """Steps in the order of their stamps. The first step is the prior."""

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: predicted from the last stored step before that stamp."""
        stamp_ns = asked_stamp(stamp_ns, self._steps[0].stamp_ns)
        step = self._steps[self._left(stamp_ns)]
        moved = self._moved(
            wrapped(self._motion, step.mean), step.covariance, step.stamp_ns, stamp_ns
        )
        return track_state(self._motion, stamp_ns, *moved)

    def _forget_before(self, stamp_ns: int) -> None:
        del self._steps[: self._left(stamp_ns)]

    def _fuse(self, measurement: Measurement) -> OneCorrection | None:
        late = measurement.stamp_ns < self._newest_ns
        return self._fuse_late(measurement) if late else self._fuse_next(measurement)

    def _fuse_next(self, measurement: Measurement) -> OneCorrection:
        """Fuse `measurement` after the last step before its stamp; forget all steps after its stamp."""
        index = self._left(measurement.stamp_ns)
        mean, covariance = self._predicted(index, measurement.stamp_ns)
        result = correct_one(mean, covariance, measurement)
        y, H = measurement.model.linearised(measurement.z, mean, measurement.pose)
        weighted = psd_solve(
            propagated(H, covariance, measurement.R / result.weight),
            np.column_stack((y, H)),
        )
        information = H.T @ weighted[:, 0], symmetrise(H.T @ weighted[:, 1:])
        step = FilterStep(
            measurement.stamp_ns,
            result.mean,
            result.covariance,
            mean,
            covariance,
            *information,
        )
        self._steps[index + 1 :] = [step]
        return result

    def _fuse_late(self, measurement: Measurement) -> OneCorrection | None:
        """Fuse a measurement that is older than the newest stamp; see `_fuse`."""
        return self._fuse_next(measurement)

    def _left(self, stamp_ns: int) -> int:
        """Return the index of the last step at or before `stamp_ns`; 0 if all steps are later."""
        return max(
            bisect.bisect_right(self._steps, stamp_ns, key=lambda step: step.stamp_ns)
            - 1,
            0,
        )

    def _predicted(self, index: int, stamp_ns: int) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) and covariance (n, n) at `stamp_ns` from the step at `index`."""
        step = self._steps[index]
        return self._moved(step.mean, step.covariance, step.stamp_ns, stamp_ns)

    def _moved(
        self, mean: FloatArray, covariance: FloatArray, from_ns: int, to_ns: int
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean (n,) and covariance (n, n) at `to_ns` from those at `from_ns`."""
        if from_ns == to_ns:
            return mean, covariance
        return predict(mean, covariance, self._motion, seconds(to_ns - from_ns))

    def _absorb(self, mean: FloatArray, covariance: FloatArray) -> None:
        """Add a step at the present stamp with the state after a late measurement: `mean` (n,), `covariance`
        (n, n).

        The step has the equivalent measurement of Bar-Shalom, Chen and Mallick 2004: H' S^-1 y = P^-1 (x+ - x),
        H' S^-1 H = P^-1 (P - P+) P^-1.
        """
        now = self._steps[-1]
        gained = psd_solve(now.covariance, now.covariance - covariance)
        score = psd_solve(now.covariance, mean - now.mean)
        weight = symmetrise(psd_solve(now.covariance, gained.T))
        self._steps.append(
            FilterStep(
                now.stamp_ns, mean, covariance, now.mean, now.covariance, score, weight
            )
        )


class Drop(RewindForget):
    """EKF that ignores every late measurement: the status is `too_old`.

    This is the floor of every comparison ("neglect" in the Sensor Fusion and Tracking Toolbox of MathWorks).

    Exact for: nothing; but consistent, because all fused measurements are in sequence.
    """

    def _fuse_late(self, measurement: Measurement) -> None:
        """Return None: the measurement is ignored."""


class AsCurrent(RewindForget):
    """EKF that takes a late measurement as if it had been made at the newest fused stamp.

    A filter that ignores stamps does the same.

    Exact for: nothing; overconfident, because the object has moved by speed times lag since the measurement.
    """

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        return self._fuse_next(replace(measurement, stamp_ns=self._newest_ns))


class Fpfd(RewindForget):
    """Forward prediction, fusion, and decorrelation: fuse both estimates and subtract their common information once.

    Rheaume and Benaskeur, Forward prediction-based approach to target-tracking with out-of-sequence measurements, IEEE
    Conference on Decision and Control, 2008:

        P^-1 = P_k^-1 + P_1^-1 - P_0^-1,   P^-1 x = P_k^-1 x_k + P_1^-1 x_1 - P_0^-1 x_0

    The present is x_k, P_k. Step m, predicted to tau, corrected there and predicted to now, is x_1, P_1. Step m
    predicted to now is x_0, P_0. The method assumes that both estimates share x_0 and nothing else. In truth they also
    share the process noise since tau. Steps before the present are not corrected by a late measurement.

    Exact for: one lag, the first late measurement since step m. Numerically the same as `Al1` in a linear model.
    """

    exact = "one lag, first late measurement"

    def _fuse_late(self, measurement: Measurement) -> OneCorrection:
        stamp_ns, now = measurement.stamp_ns, self._steps[-1]
        mean, covariance = self._predicted(self._left(stamp_ns), stamp_ns)
        at_tau = correct_one(mean, covariance, measurement)
        late = self._moved(at_tau.mean, at_tau.covariance, stamp_ns, now.stamp_ns)
        common = self._moved(mean, covariance, stamp_ns, now.stamp_ns)
        x, P = self._fused((now.mean, now.covariance), late, common)
        np.linalg.cholesky(P)
        self._absorb(x, P)
        return Correction(x, P, at_tau.innovation, at_tau.nis, at_tau.weight, at_tau.S)

    def _fused(self, now: _Estimate, late: _Estimate, common: _Estimate) -> _Estimate:
        """Return the fusion of the estimates `now` and `late`, which share the information of `common`."""
        P_k, P_1, P_0 = (information(P) for _, P in (now, late, common))
        covariance = symmetrise(information(P_k + P_1 - P_0))
        pull = P_1 @ (late[0] - now[0]) - P_0 @ (common[0] - now[0])
        return now[0] + covariance @ pull, covariance


class CovarianceIntersection(Fpfd):
    """Covariance intersection: a fusion of both estimates that holds for any correlation between the two.

    Julier and Uhlmann, Fusion of time delayed measurements with uncertain time delays, American Control Conference,
    2005:

        P^-1 = w P_k^-1 + (1 - w) P_1^-1,   P^-1 x = w P_k^-1 x_k + (1 - w) P_1^-1 x_1

    The weight w in [0, 1] minimises the trace of P, although the entries of P differ in their units.

    Exact for: nothing; never overconfident.
    """

    exact = ""

    def _fused(self, now: _Estimate, late: _Estimate, common: _Estimate) -> _Estimate:
        P_k, P_1 = information(now[1]), information(late[1])

        def covariance(w: float) -> FloatArray:
            return symmetrise(information(w * P_k + (1.0 - w) * P_1))

        def spread(w: float) -> float:
            return float(np.trace(covariance(w)))

        inner = float(minimize_scalar(spread, bounds=(0.0, 1.0), method="bounded").x)
        w = min((0.0, inner, 1.0), key=spread)
        P = covariance(w)
        return now[0] + (1.0 - w) * P @ (P_1 @ (late[0] - now[0])), P


def information(covariance: FloatArray) -> FloatArray:
    """Inverse of `covariance`, shape (n, n): the information matrix."""
    return symmetrise(psd_solve(covariance, identity(len(covariance))))
