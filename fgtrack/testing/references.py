"""References of the contract: plain calculations that share no recursion, graph or factor with any of them.

All take the measurements in the order of the stamps or all at once, so there is no order of arrival in them. They share
motion models (see `check_motion_model`), measurement models and losses.
"""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import weight

_WEIGHT_STEPS, _NEWTON_STEPS = 50, 50
_STEP_TOLERANCE, _QUOTIENT_STEP = 1e-6, 1e-6


def dense_joint(
    motion: MotionModel, prior: Start, measurements: Sequence[Measurement], stamps_ns: Iterable[int]
) -> dict[int, TrackState]:
    """States at `stamps_ns` (from the prior's stamp on) given all `measurements`, by stamp.

    Every distinct stamp is a node, measured or not, so interpolating and predicting need no equation of their own.
    About means m all states are x = m + d + M u with u ~ N(0, I): d_k = F d_(k-1) + f(m_(k-1)) - m_k, and M holds the
    roots L of L L' = P_0 or Q. The rows u = 0 and W H M u = W (y - H d), W the inverse root of R, are solved by one QR,
    whose triangle also gives the covariances, S S' with S = M R^-1. This is the least-squares problem of x itself, but
    its condition stays small where two stamps nearly coincide and Q almost vanishes.

    A linear model takes one step. Of another one the steps begin at the states of `kalman_filter` and go on until they
    are small; noise and robust weights are those at the last states. Raises `CallError` for a stamp before the prior's.
    """
    wanted = sorted(set(stamps_ns))
    stamps = sorted({prior.stamp_ns, *wanted, *(item.stamp_ns for item in measurements)})
    if stamps[0] < prior.stamp_ns:
        raise CallError(f"dense_joint: stamp {stamps[0]} ns lies before the prior's, {prior.stamp_ns} ns")
    linear = motion.linear and all(item.model.linear and item.loss is None for item in measurements)
    n, size, nodes = motion.dim, motion.dim * len(stamps), {stamp_ns: k for k, stamp_ns in enumerate(stamps)}
    start, P0 = initial_state(motion, prior)
    known = [] if linear else measurements
    means = np.array([kalman_filter(motion, prior, known, at_ns).mean for at_ns in stamps])
    for _ in range(1 if linear else _NEWTON_STEPS):
        d, M = np.zeros(means.shape), np.zeros((*means.shape, size))
        d[0], M[0, :, :n] = start - means[0], np.linalg.cholesky(P0)
        for k in range(1, len(stamps)):
            dt_s, x = seconds(stamps[k] - stamps[k - 1]), means[k - 1]
            F = motion.jacobian(x, dt_s)
            d[k], M[k] = F @ d[k - 1] + motion.predict(x, dt_s) - means[k], F @ M[k - 1]
            M[k, :, k * n : (k + 1) * n] = np.linalg.cholesky(motion.process_noise(x, dt_s))
        rows = [np.eye(size, size + 1)]
        for item in measurements:
            k = nodes[item.stamp_ns]
            y = _residual(item, means[k])
            H = item.model.selection(n) if item.model.linear else _slope(item, means[k])
            root = np.linalg.cholesky(item.R / _weight(item, y))
            rows.append(np.linalg.solve(root, np.column_stack([H @ M[k], y - H @ d[k]])))
        R = np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))[:size]
        step = d + M @ np.linalg.solve(R[:, :size], R[:, size])
        means = means + step
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    chosen = [nodes[stamp_ns] for stamp_ns in wanted]
    roots = np.linalg.solve(R[:, :size].T, M[chosen].reshape(-1, size).T).T.reshape(len(wanted), n, size)
    return {at: TrackState(at, means[k], S @ S.T) for at, k, S in zip(wanted, chosen, roots, strict=True)}


def kalman_filter(motion: MotionModel, prior: Start, measurements: Sequence[Measurement], stamp_ns: int) -> TrackState:
    """State at `stamp_ns` of the extended Kalman filter given `measurements` up to it, in the order of their stamps.
    Measurement Jacobians are difference quotients; a robust loss weighs a measurement by what is left of its innovation
    after the update.
    """
    (x, P), now_ns = initial_state(motion, prior), prior.stamp_ns
    for item in sorted(measurements, key=lambda m: m.stamp_ns):
        if item.stamp_ns > stamp_ns:
            break
        x, P = _moved(motion, x, P, item.stamp_ns - now_ns)
        y, H = _residual(item, x), _slope(item, x)
        step, weight = np.zeros(len(x)), 1.0
        for _ in range(_WEIGHT_STEPS if item.loss else 1):
            S = H @ P @ H.T + item.R / weight
            step = P @ H.T @ np.linalg.solve(S, y)
            weight = _weight(item, y - H @ step)
        x, P, now_ns = x + step, P - P @ H.T @ np.linalg.solve(S, H @ P), item.stamp_ns
    x, P = _moved(motion, x, P, stamp_ns - now_ns)
    return TrackState(stamp_ns, x, P)


def _moved(motion: MotionModel, x: FloatArray, P: FloatArray, ahead_ns: int) -> tuple[FloatArray, FloatArray]:
    if not ahead_ns:
        return x, P
    F, Q = motion.jacobian(x, seconds(ahead_ns)), motion.process_noise(x, seconds(ahead_ns))
    return motion.predict(x, seconds(ahead_ns)), F @ P @ F.T + Q


def _residual(one: Measurement, x: FloatArray) -> FloatArray:
    return one.model.residual(one.z, one.model.predict(x, one.pose))


def _slope(one: Measurement, x: FloatArray) -> FloatArray:
    return slope(lambda state: -_residual(one, state), x)


def slope(function: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Jacobian of `function` at `x` (n,) by difference quotients, shape (k, n)."""
    steps = _QUOTIENT_STEP * (1.0 + np.abs(x)) * np.eye(len(x))
    return np.column_stack([(function(x + step) - function(x - step)) / (2.0 * step.sum()) for step in steps])


def _weight(one: Measurement, y: FloatArray) -> float:
    """Weight of a measurement under its robust loss at the residual `y` (k,)."""
    return 1.0 if one.loss is None else weight(one.loss, math.sqrt(y @ np.linalg.solve(one.R, y)), len(y))


def difference(found: TrackState, expected: TrackState, motion: MotionModel | None = None) -> tuple[float, float]:
    """Distance of `found` from `expected`: the largest difference of means and covariances, in standard deviations.
    A covariance is relative to the two standard deviations of its entry; a NaN stays one. The yaw of a state of
    `motion` goes the short way round.
    """
    sigma, off = np.sqrt(np.diag(expected.covariance)), found.mean - expected.mean
    off = off if motion is None else wrapped(motion, off)
    covariance = np.abs(found.covariance - expected.covariance) / np.outer(sigma, sigma)
    return float((np.abs(off) / sigma).max()), float(covariance.max())


def rounding_bound(motion: MotionModel, stamps_ns: Iterable[int], sigma_m: float = 0.5) -> float:
    """Bound of the rounding errors, in standard deviations, of a solver that divides by a linear model's process noise.

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
