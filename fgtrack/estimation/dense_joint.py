"""The dense joint posterior of a linear chain: the oracle that exact estimators are held to.

It conditions on all measurements at once, so there is no order of arrival in it; it shares neither recursion nor
graph with any estimator.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start, UpdateResult
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.propagation import wrapped
from fgtrack.models.motion import MotionModel


def dense_joint(
    motion: MotionModel, prior: Start, measurements: Sequence[Measurement], stamps_ns: Iterable[int]
) -> dict[int, TrackState]:
    """States at `stamps_ns` (from the prior's stamp on) given all `measurements`, by stamp.

    Every distinct stamp is a node, measured or not, so interpolating and predicting need no equation of their own.
    With x_0 = m_0 + L_0 u_0 and x_k = F x_(k-1) + L_k u_k (L L' = P_0 or Q) all states are x = m + M u, u ~ N(0, I).
    The rows u = 0 and W H M u = W (z - H m), W the inverse root of R, are solved by one QR, whose triangle also gives
    the covariances, S S' with S = M R^-1. This is the least-squares problem of x itself, but its condition stays small
    where two stamps nearly coincide and Q almost vanishes.

    Raises `CallError` for a model that is not linear, or a stamp before the prior's.
    """
    wanted = sorted(set(stamps_ns))
    stamps = sorted({prior.stamp_ns, *wanted, *(m.stamp_ns for m in measurements)})
    if not motion.linear or not all(m.model.linear for m in measurements):
        raise CallError("dense_joint: motion and measurements must be linear")
    if stamps[0] < prior.stamp_ns:
        raise CallError(f"dense_joint: stamp {stamps[0]} ns lies before the prior's, {prior.stamp_ns} ns")
    m, M = _moments(motion, prior, stamps)
    place = {stamp_ns: k for k, stamp_ns in enumerate(stamps)}
    size = M.shape[-1]
    rows = [np.eye(size, size + 1)]
    for item in measurements:
        k = place[item.stamp_ns]
        H = item.model.selection(motion.dim)
        y = item.model.residual(item.z, item.model.predict(m[k], item.pose))
        rows.append(np.linalg.solve(np.linalg.cholesky(item.R), np.column_stack([H @ M[k], y])))
    R = np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))
    root, u = R[:size, :size], np.linalg.solve(R[:size, :size], R[:size, size])
    places = [place[stamp_ns] for stamp_ns in wanted]
    roots = np.linalg.solve(root.T, M[places].reshape(len(wanted) * motion.dim, size).T).T
    roots = roots.reshape(len(wanted), motion.dim, size)
    return {
        stamp_ns: TrackState(stamp_ns, m[k] + M[k] @ u, S @ S.T)
        for stamp_ns, k, S in zip(wanted, places, roots, strict=True)
    }


def _moments(motion: MotionModel, prior: Start, stamps_ns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Prior mean m (N, n) of the states at `stamps_ns`, and how they depend on u: M (N, n, N n)."""
    mean, covariance = initial_state(motion, prior)
    n, count = motion.dim, len(stamps_ns)
    m, M = np.zeros((count, n)), np.zeros((count, n, count * n))
    m[0], M[0, :, :n] = mean, np.linalg.cholesky(covariance)
    for k in range(1, count):
        dt_s = seconds(stamps_ns[k] - stamps_ns[k - 1])
        m[k] = motion.predict(m[k - 1], dt_s)
        M[k] = motion.jacobian(m[k - 1], dt_s) @ M[k - 1]
        M[k, :, k * n : (k + 1) * n] = np.linalg.cholesky(motion.process_noise(m[k - 1], dt_s))
    return m, M


class Difference(NamedTuple):
    """How far one Gaussian is from another."""

    mean_sigma: float
    """Largest difference of the means, in standard deviations."""
    covariance: float
    """Largest difference of the covariances, relative to the two standard deviations that belong to the entry."""


def difference(found: TrackState, expected: TrackState, motion: MotionModel | None = None) -> Difference:
    """How far `found` is from `expected`; a NaN stays one. The yaw of a state of `motion` goes the short way round."""
    sigma, off = np.sqrt(np.diag(expected.covariance)), found.mean - expected.mean
    off = off if motion is None else wrapped(motion, off)
    mean = np.abs(off) / sigma
    covariance = np.abs(found.covariance - expected.covariance) / np.outer(sigma, sigma)
    return Difference(float(mean.max()), float(covariance.max()))


def innovation_difference(result: UpdateResult, measurement: Measurement, before: TrackState) -> Difference:
    """How far the innovation of `result` is from that of the state `before` the measurement, and its NIS, over 1 + NIS.

    Infinite where there is none.
    """
    if result.innovation is None or result.nis is None:
        return Difference(math.inf, math.inf)
    model, mean = measurement.model, before.mean
    H = model.jacobian(mean, measurement.pose)
    S = H @ before.covariance @ H.T + measurement.R
    y = model.residual(measurement.z, model.predict(mean, measurement.pose))
    nis = float(y @ np.linalg.solve(S, y))
    apart = np.abs(result.innovation - y) / np.sqrt(np.diag(S))
    return Difference(float(apart.max()), abs(result.nis - nis) / (1.0 + nis))


def rounding_bound(motion: MotionModel, stamps_ns: Iterable[int], sigma_m: float = 0.5) -> float:
    """What rounding may cost a solver that divides by the process noise of a linear model, in standard deviations.

    Given its end, the start of a segment is known to 1 / W = sqrt(Q_xx) / 2, 3e-11 m for 1 us of CV; beside a row that
    weighs W an orthogonal factorisation keeps one of a measurement of `sigma_m` to eps W sigma only. Ten times that,
    for the shortest segment between `stamps_ns`. A filter in covariance form divides by no process noise and needs no
    such bound.
    """
    gaps_ns = np.diff(sorted(set(stamps_ns)))
    if not gaps_ns.size:
        return 0.0
    Q = motion.process_noise(np.zeros(motion.dim), seconds(int(gaps_ns.min())))
    return float(10.0 * np.finfo(np.float64).eps * sigma_m * 2.0 / np.sqrt(Q[0, 0]))
