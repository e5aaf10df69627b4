"""The posterior Cramer-Rao lower bound of the present state, gated by what has arrived.

No estimate from the same data has a smaller mean squared error; see Tichavsky, Muravchik and Nehorai, "Posterior
Cramer-Rao bounds for discrete-time nonlinear filtering", IEEE Transactions on Signal Processing 46(5), 1998.
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
    """A measurement that will be made: its value does not matter for a bound."""

    stamp_ns: int
    receipt_ns: int
    """Times of sensing and of arrival."""
    model: MeasurementModel
    R: FloatArray
    """Covariance, shape (k, k)."""
    pose: SensorPose = field(default_factory=SensorPose)
    """Pose of the sensor."""


class Bounds(NamedTuple):
    """Lower bounds of the covariance of the present state at m times, shape (m, n, n) each."""

    in_time: FloatArray
    """If everything arrived when it was measured."""
    arrived: FloatArray
    """From what has arrived, each at its own stamp."""
    dropped: FloatArray
    """From what has arrived, without what came later than something measured after it."""


_NEVER_NS = np.iinfo(np.int64).max
_DIFFERENCE = 1e-4  # of a state, in any of its units, for numerical derivatives of Q


def bounds(
    motion: MotionModel,
    start_ns: int,
    prior_covariance: FloatArray,
    measurements: Sequence[ScheduledMeasurement],
    truth: Callable[[IntArray], FloatArray],
    now_ns: Sequence[int],
) -> Bounds:
    """Return the bounds at the ascending times `now_ns`.

    With F, Q and H at the true states, and E the mean over trajectories, the information of the newest state is
    J' = D22 - D12' (J + D11)^-1 D12 with D11 = E[F' Q^-1 F + N], D12 = -E[F' Q^-1], D22 = E[Q^-1], plus
    E[H' R^-1 H] of each measurement there. N_ij = 1/2 tr(Q^-1 dQ/dx_i Q^-1 dQ/dx_j) is what the noise informs of the
    state that it depends on. A measurement counts from its receipt on, at its own stamp. Where F varies much between
    trajectories the bound is far from what can be reached: see `bounds_along`.

    Parameters
    ----------
    motion
        Motion model; its process noise must be positive definite.
    start_ns, prior_covariance
        Stamp and covariance (n, n) of the first state; `ValueError` for a measurement or time before it.
    truth
        True states at stamps (s,), of one or more drawn trajectories, shape (trajectories, s, n).
    """
    stamps_ns = np.unique(
        [start_ns, *(item.stamp_ns for item in measurements), *now_ns]
    )
    if stamps_ns[0] < start_ns:
        raise ValueError(
            f"start_ns: {start_ns} is after a measurement or a time at {stamps_ns[0]}"
        )
    states = truth(stamps_ns)
    ordered = sorted(measurements, key=lambda item: item.stamp_ns)
    receipts_ns = np.array([item.receipt_ns for item in ordered], dtype=np.int64)
    own_ns = np.array([item.stamp_ns for item in ordered], dtype=np.int64)
    later_ns = np.minimum.accumulate(receipts_ns[::-1])[::-1]
    kept = np.append(receipts_ns[:-1] <= later_ns[1:], True)[
        : len(ordered)
    ]  # before everything measured after them
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
        """Bounds where measurement i counts from `from_ns[i]` on, shape (m, n, n); what is final is kept."""
        result, settled, J = [], 0, start
        for time_ns in now_ns:
            here, counts = int(np.searchsorted(stamps_ns, time_ns)), from_ns <= time_ns
            waiting = index[~counts & (from_ns != _NEVER_NS)]
            final = min([here, *waiting.tolist()])
            J, settled = advanced(J, settled, final, counts), final
            at_now = measured(advanced(J, settled, here, counts), here, counts)
            result.append(symmetrise(psd_solve(at_now, np.eye(motion.dim))))
        return np.array(result)

    def advanced(J: FloatArray, first: int, last: int, counts: BoolArray) -> FloatArray:
        """Information of stamp `last`, before its own measurements, from that of `first`, before its own."""
        for k in range(first, last):
            D11, D12, D22 = steps[k]
            J = symmetrise(D22 - D12.T @ psd_solve(measured(J, k, counts) + D11, D12))
        return J

    def measured(J: FloatArray, k: int, counts: BoolArray) -> FloatArray:
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
    """Mean over trajectories of the bounds along each of them; parameters and errors are those of `bounds`.
    Each is the covariance of a filter linearised at the true states: closer to what can be reached, but no bound.
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
    """Expected information of one step of the chain: D11, D12 and D22 of the recursion, see `bounds`."""
    F, Q = motion.jacobian(states, dt_s), motion.process_noise(states, dt_s)
    weight = np.linalg.solve(Q, np.broadcast_to(np.eye(motion.dim), Q.shape))
    weighted, told = F.mT @ weight, []
    for shift in _DIFFERENCE * np.eye(motion.dim):
        change = motion.process_noise(states + shift, dt_s) - motion.process_noise(
            states - shift, dt_s
        )
        told.append(weight @ change / (2.0 * _DIFFERENCE))
    noise = 0.5 * np.einsum("i...ab,j...ba->...ij", told, told)
    return (
        (weighted @ F + noise).mean(axis=0),
        -weighted.mean(axis=0),
        weight.mean(axis=0),
    )


def _information(item: ScheduledMeasurement, states: FloatArray) -> FloatArray:
    """E[H' R^-1 H] over states (trajectories, n)."""
    H = item.model.jacobian(states, item.pose)
    return np.asarray((H.mT @ psd_solve(item.R, np.eye(len(item.R))) @ H).mean(axis=0))
