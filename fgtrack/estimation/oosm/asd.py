"""The joint density of all states in the window."""

import bisect
from typing import ClassVar

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import congruence, psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, asked_stamp
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.ekf import OneCorrection, propagated
from fgtrack.estimation.filters.propagation import track_state
from fgtrack.estimation.filters.windowed import WindowedFilter
from fgtrack.estimation.oosm.crossing import fuse_across
from fgtrack.estimation.rts import between
from fgtrack.models.motion import MotionModel

_Stack = tuple[tuple[int, ...], FloatArray, FloatArray]
"""N stamps, oldest first, with mean (N n,) and covariance (N n, N n) of the states at these stamps. Yaws are not
wrapped.
"""


class AccumulatedStateDensity(WindowedFilter):
    """Joint Gaussian of all states in the window. A measurement at any stamp corrects all states.

    Koch and Govaers, On accumulated state densities with applications to out-of-sequence measurement processing, IEEE
    Transactions on Aerospace and Electronic Systems 47(4), 2011; Govaers and Koch, Generalized solution to smoothing
    and out-of-sequence processing, same journal 50(3), 2014. The next state is x_{k+1} = F x_k + v, with the
    cross-covariances F Cov(x_k, x_j). A stamp between two neighbours becomes a state x = Lambda x_l + Psi x_r + N(0,
    Sigma) (see `between`). Its cross-covariances are [Lambda Psi] Cov([x_l; x_r], x_j). Every measurement, late or not,
    corrects the whole stack by `fuse_across`.

    Exact for: any lag, any number of late measurements in any order. States in the past are smoothed.
    """

    STATE: ClassVar[tuple[str, ...]] = (
        *WindowedFilter.STATE,
        "_stack",
    )

    exact = "any lag, any number"
    nonlinear = "never"
    smooths = True
    tolerance = 1e-7
    """Inserting a state between two close neighbours loses digits of the joint covariance."""

    def __init__(self, motion: MotionModel, prior: Start, lag_s: float) -> None:
        super().__init__(motion, prior, lag_s)
        self._stack: _Stack = ((prior.stamp_ns,), *initial_state(motion, prior))

    def state_at(self, stamp_ns: int) -> TrackState:
        """See `Estimator.state_at`: the smoothed state, given all measurements."""
        stamp_ns = asked_stamp(stamp_ns, self._stack[0][0])
        (_, mean, covariance), block = self._with_state(stamp_ns)
        return track_state(
            self._motion, stamp_ns, mean[block].copy(), covariance[block, block].copy()
        )

    def _forget_before(self, stamp_ns: int) -> None:
        stamps_ns, mean, covariance = self._stack
        gone = bisect.bisect_right(stamps_ns, stamp_ns) - 1
        if gone > 0:
            kept = slice(gone * self._motion.dim, None)
            self._stack = stamps_ns[gone:], mean[kept], covariance[kept, kept]

    def _fuse(self, measurement: Measurement) -> OneCorrection:
        (stamps_ns, mean, covariance), block = self._with_state(measurement.stamp_ns)
        past = mean[block], covariance[block, block], covariance[:, block]
        result = fuse_across(mean, covariance, past, measurement)
        self._stack = stamps_ns, result.mean, result.covariance
        return result

    def withdraw(self, measurement: Measurement) -> None:
        """Undo the fusion of a measurement, which must have been fused.

        Its information is subtracted: P- = P + P H' (R - H P H')^-1 H P, x- = x - P H' (R - H P H')^-1 (z - H x).
        Raises `CallError` for a stamp without a state, and for a robust loss, whose weight is unknown.
        """
        measurement = measurement.seen_by(self._motion)
        if measurement.stamp_ns not in self._stack[0] or measurement.loss is not None:
            raise CallError(
                f"withdraw: the measurement at {measurement.stamp_ns} ns cannot be subtracted"
            )
        (stamps_ns, mean, covariance), block = self._with_state(measurement.stamp_ns)
        own = measurement.model
        y, H = own.linearised(measurement.z, mean[block], measurement.pose)
        across = covariance[:, block] @ H.T
        rest = measurement.R - congruence(H, covariance[block, block])
        gain = psd_solve(symmetrise(rest), across.T).T
        without = symmetrise(covariance + gain @ across.T)
        self._stack = stamps_ns, mean - gain @ y, without

    def _with_state(self, stamp_ns: int) -> tuple[_Stack, slice]:
        """Return the stack with a state at `stamp_ns`, and the slice of this state in the stack."""
        n, (stamps_ns, mean, covariance) = self._motion.dim, self._stack
        index = max(bisect.bisect_right(stamps_ns, stamp_ns) - 1, 0)
        if stamps_ns[index] == stamp_ns:
            return self._stack, slice(index * n, index * n + n)
        left, until_s = (
            mean[index * n : index * n + n],
            seconds(stamp_ns - stamps_ns[index]),
        )
        if index + 1 == len(stamps_ns):
            own, A, noise = self._motion.transition(left, until_s)
        else:
            right, after_s = (
                mean[index * n + n : index * n + 2 * n],
                seconds(stamps_ns[index + 1] - stamp_ns),
            )
            own, Lambda, Psi, noise = between(
                self._motion, left, right, until_s, after_s
            )
            A = np.hstack((Lambda, Psi))
        neighbours, at = slice(index * n, index * n + A.shape[1]), index * n + n
        cross = A @ covariance[neighbours]
        grown = np.empty((len(mean) + n, len(mean) + n))
        others = np.delete(np.arange(len(grown)), np.s_[at : at + n])
        grown[np.ix_(others, others)] = covariance
        grown[at : at + n, others] = cross
        grown[others, at : at + n] = cross.T
        grown[at : at + n, at : at + n] = propagated(
            A, covariance[neighbours, neighbours], noise
        )
        stamps_ns = (*stamps_ns[: index + 1], stamp_ns, *stamps_ns[index + 1 :])
        return (stamps_ns, np.insert(mean, at, own), grown), slice(at, at + n)
