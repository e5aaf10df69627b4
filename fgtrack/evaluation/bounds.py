"""Posterior Cramer-Rao lower bound of the present state, from the measurements that have arrived.

No estimate from the same data has a smaller mean squared error. Source: Tichavsky,
Muravchik and Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear
filtering", IEEE Transactions on Signal Processing 46(5), 1998.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import psd_solve, symmetrise
from fgtrack.core.time import seconds
from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.models.measurement import MeasurementModel, SensorPose
from fgtrack.models.motion import MotionModel


@dataclass(frozen=True)
class ScheduledMeasurement:
    """A future measurement: a bound does not depend on its value."""

    stamp_ns: int
    """Time of measurement."""
    receipt_ns: int
    """Time of arrival."""
    model: MeasurementModel
    R: FloatArray
    """Covariance, shape (k, k)."""
    pose: SensorPose = field(default_factory=SensorPose)
    """Pose of the sensor."""


class Bounds(NamedTuple):
    """Lower bounds of the covariance of the present state at m times, shape (m, n, n) each."""

    in_time: FloatArray
    """Bound if every measurement arrived at its stamp."""
    arrived: FloatArray
    """Bound from the measurements that have arrived, each used at its stamp."""
    dropped: FloatArray
    """Bound from the arrived measurements, except measurements that arrived after a newer measurement."""


_NEVER_NS = np.iinfo(np.int64).max
# Difference of a state entry, in its own unit, for numerical derivatives of Q.
_DIFFERENCE = 1e-4


def bounds(
    motion: MotionModel,
    start_ns: int,
    prior_covariance: FloatArray,
    measurements: Sequence[ScheduledMeasurement],
    truth: Callable[[IntArray], FloatArray],
    now_ns: Sequence[int],
) -> Bounds:
    """Return the bounds at the ascending times `now_ns`.

    F, Q and H are taken at the true states, and E is the mean over trajectories. The
    information of the newest state is J' = D22 - D12' (J + D11)^-1 D12, with D11 = E[F'
    Q^-1 F + N], D12 = -E[F' Q^-1] and D22 = E[Q^-1]. Each measurement at this state
    adds E[H' R^-1 H]. N_ij = 1/2 tr(Q^-1 dQ/dx_i Q^-1 dQ/dx_j) is the information that
    the noise gives on the state it depends on.

    A measurement counts from its receipt, at its own stamp. If F varies much between
    trajectories, no estimator reaches the bound: see `bounds_along`.

    Parameters
    ----------
    motion
        Motion model; its process noise must be positive definite.
    start_ns, prior_covariance
        Stamp and covariance (n, n) of the first state. `ValueError` if a measurement or a time precedes it.
    truth
        Function that returns true states at stamps (s,) for one or more drawn trajectories, shape
        (trajectories, s, n).
    """
    stamps_ns = np.unique(
        [start_ns, *(item.stamp_ns for item in measurements), *now_ns]
    )
    if stamps_ns[0] < start_ns:
        raise ValueError(
            f"start_ns: {start_ns} is later than the first measurement or time at {stamps_ns[0]}"
        )
    states = truth(stamps_ns)
    ordered = sorted(measurements, key=lambda item: item.stamp_ns)
    receipts_ns = np.array([item.receipt_ns for item in ordered], dtype=np.int64)
    own_ns = np.array([item.stamp_ns for item in ordered], dtype=np.int64)
    later_ns = np.minimum.accumulate(receipts_ns[::-1])[::-1]
    # True for measurements that arrive before all newer ones.
    kept = np.append(receipts_ns[:-1] <= later_ns[1:], True)[: len(ordered)]
    index = np.searchsorted(stamps_ns, own_ns)
    gained = [
        _information(item, states[:, k]) for item, k in zip(ordered, index, strict=True)
    ]
    steps = [
        _step(motion, states[:, k], seconds(int(ns)))
        for k, ns in enumerate(np.diff(stamps_ns))
    ]
    start = psd_solve(prior_covariance, np.eye(motion.dim))

    def covariances(from_ns: IntArray) -> FloatArray:
        """Bounds if measurement i counts from the time `from_ns[i]`, shape (m, n, n).

        The information up to the first outstanding measurement is final and reused.
        """
        result = []
        settled = 0
        J = start
        for time_ns in now_ns:
            here = int(np.searchsorted(stamps_ns, time_ns))
            counts = from_ns <= time_ns
            waiting = index[~counts & (from_ns != _NEVER_NS)]
            final = min([here, *waiting.tolist()])
            J = advanced(J, settled, final, counts)
            settled = final
            at_now = measured(advanced(J, settled, here, counts), here, counts)
            result.append(symmetrise(psd_solve(at_now, np.eye(motion.dim))))
        return np.array(result)

    def advanced(J: FloatArray, first: int, last: int, counts: BoolArray) -> FloatArray:
        """Information at stamp `last` from that at stamp `first`, both before their own measurements."""
        for k in range(first, last):
            D11, D12, D22 = steps[k]
            J = symmetrise(D22 - D12.T @ psd_solve(measured(J, k, counts) + D11, D12))
        return J

    def measured(J: FloatArray, k: int, counts: BoolArray) -> FloatArray:
        """Information at stamp k after its measurements."""
        first, last = np.searchsorted(index, [k, k + 1])
        return sum((gained[i] for i in range(first, last) if counts[i]), start=J)

    return Bounds(
        covariances(own_ns),
        covariances(receipts_ns),
        covariances(np.where(kept, receipts_ns, _NEVER_NS)),
    )


def bounds_along(
    motion: MotionModel,
    start_ns: int,
    prior_covariance: FloatArray,
    measurements: Sequence[ScheduledMeasurement],
    truth: Callable[[IntArray], FloatArray],
    now_ns: Sequence[int],
) -> Bounds:
    """Return the mean over trajectories of the bounds along each single trajectory.

    The parameters and errors are as in `bounds`. Along a trajectory the bound is the
    covariance of a filter that is linearised at the true states. The mean is closer to
    an achievable error, but no lower bound.
    """
    states = truth(
        np.unique([start_ns, *(item.stamp_ns for item in measurements), *now_ns])
    )

    def along(one: FloatArray) -> Bounds:
        return bounds(
            motion,
            start_ns,
            prior_covariance,
            measurements,
            lambda _: one[None],
            now_ns,
        )

    each = map(along, states)
    return Bounds(
        *(np.mean(covariances, axis=0) for covariances in zip(*each, strict=True))
    )


def _step(
    motion: MotionModel, states: FloatArray, dt_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Expected information D11, D12 and D22 of one step of the recursion, see `bounds`."""
    F = motion.jacobian(states, dt_s)
    Q = motion.process_noise(states, dt_s)
    weight = np.linalg.solve(Q, np.broadcast_to(np.eye(motion.dim), Q.shape))
    weighted = F.mT @ weight
    derivatives = []  # Q^-1 dQ/dx_i
    for shift in _DIFFERENCE * np.eye(motion.dim):
        after = motion.process_noise(states + shift, dt_s)
        before = motion.process_noise(states - shift, dt_s)
        derivatives.append(weight @ (after - before) / (2.0 * _DIFFERENCE))
    noise = 0.5 * np.einsum("i...ab,j...ba->...ij", derivatives, derivatives)
    return (
        (weighted @ F + noise).mean(axis=0),
        -weighted.mean(axis=0),
        weight.mean(axis=0),
    )


def _information(item: ScheduledMeasurement, states: FloatArray) -> FloatArray:
    """Expected information E[H' R^-1 H] over the states (trajectories, n)."""
    H = item.model.jacobian(states, item.pose)
    return np.asarray((H.mT @ psd_solve(item.R, np.eye(len(item.R))) @ H).mean(axis=0))
