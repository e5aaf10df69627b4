"""References of the contract: plain calculations that share no recursion, graph, factor or model with any estimator.

All references take the measurements in the order of their stamps, or all at once. So their results do not depend on the
order of arrival. Motion and measurements come from `fgtrack.testing.equations`, not from the shipped models. The prior
of a new object is shared with the estimators.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import pairwise

import numpy as np
from scipy import stats
from scipy.linalg import expm

from fgtrack.core.errors import CallError
from fgtrack.core.time import seconds
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.models.motion import MotionModel
from fgtrack.models.sensors import RobustLoss
from fgtrack.testing.equations import (
    Linearisation,
    Moments,
    MotionEquation,
    drift_jacobian,
    equation_of,
    linearised,
    moments,
    residual,
)

_WEIGHT_STEPS, _NEWTON_STEPS = 200, 200
_STEP_TOLERANCE, _UPDATE_TOLERANCE, _QUOTIENT_STEP = 1e-9, 1e-10, 1e-6


def dense_joint(
    motion: MotionModel,
    prior: Start,
    measurements: Sequence[Measurement],
    stamps_ns: Iterable[int],
) -> dict[int, TrackState]:
    """States at `stamps_ns` (from the prior's stamp on) given all `measurements`, by stamp.

    Every distinct stamp is a node, measured or not, so interpolating and predicting need no equation of their own.
    About means m all states are x = m + d + M u with u ~ N(0, I): d_k = F d_(k-1) + f(m_(k-1)) - m_k, and M holds the
    roots L of L L' = P_0 or Q. The rows u = 0 and W H M u = W (y - H d), W the inverse root of R, are solved by one QR,
    whose triangle also gives the covariances, S S' with S = M R^-1. This is the least-squares problem of x itself, but
    its condition stays small where two stamps nearly coincide and Q almost vanishes.

    A linear model takes one step. Of another one the steps begin at the states of `kalman_filter` and go on until they
    are small; noise and robust weights are those at the last states. Raises `CallError` for a stamp before the prior's
    and for a motion model without an equation.
    """
    wanted = sorted(set(stamps_ns))
    stamps = sorted(
        {prior.stamp_ns, *wanted, *(item.stamp_ns for item in measurements)}
    )
    if stamps[0] < prior.stamp_ns:
        raise CallError(
            f"dense_joint: stamp {stamps[0]} ns lies before the prior's, {prior.stamp_ns} ns"
        )
    linear = motion.linear and all(
        item.model.linear and item.loss is None for item in measurements
    )
    n, size, nodes = (
        motion.dim,
        motion.dim * len(stamps),
        {stamp_ns: k for k, stamp_ns in enumerate(stamps)},
    )
    start, P0 = initial_state(motion, prior)
    filtered = kalman_filter(motion, prior, [] if linear else measurements, stamps)
    means = np.array([filtered[at_ns].mean for at_ns in stamps])
    durations_s = np.array(
        [seconds(after - before) for before, after in pairwise(stamps)]
    )
    for _ in range(1 if linear else _NEWTON_STEPS):
        d, M = np.zeros(means.shape), np.zeros((*means.shape, size))
        d[0], M[0, :, :n] = start - means[0], np.linalg.cholesky(P0)
        ahead = _moments(motion, means[:-1], durations_s)
        for k in range(1, len(stamps)):
            F = ahead.F[k - 1]
            d[k], M[k] = F @ d[k - 1] + ahead.mean[k - 1] - means[k], F @ M[k - 1]
            M[k, :, k * n : (k + 1) * n] = np.linalg.cholesky(ahead.Q[k - 1])
        rows = [np.eye(size, size + 1)]
        for item in measurements:
            k = nodes[item.stamp_ns]
            y, H = innovation(motion, item, means[k])
            root = np.linalg.cholesky(item.R / _weight(item, y))
            rows.append(
                np.linalg.solve(root, np.column_stack([H @ M[k], y - H @ d[k]]))
            )
        R = np.asarray(np.linalg.qr(np.vstack(rows), mode="r"))[:size]
        step = d + M @ np.linalg.solve(R[:, :size], R[:, size])
        means = means + step
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    chosen = [nodes[stamp_ns] for stamp_ns in wanted]
    roots = np.linalg.solve(R[:, :size].T, M[chosen].reshape(-1, size).T).T.reshape(
        len(wanted), n, size
    )
    return {
        at: TrackState(at, means[k], S @ S.T)
        for at, k, S in zip(wanted, chosen, roots, strict=True)
    }


def kalman_filter(
    motion: MotionModel,
    prior: Start,
    measurements: Sequence[Measurement],
    stamps_ns: Iterable[int],
    iterated: bool = False,
) -> dict[int, TrackState]:
    """States at `stamps_ns` of the extended Kalman filter, which fuses `measurements` in the order of their stamps.

    A robust loss weighs a measurement by the part of its innovation that is left after the update. The `iterated`
    filter linearises each measurement at the result of its update. Raises `CallError` for a motion model without an
    equation.
    """
    (x, P), now_ns, wanted = (
        initial_state(motion, prior),
        prior.stamp_ns,
        set(stamps_ns),
    )
    newest_ns, states = max(wanted), dict[int, TrackState]()
    for at_ns in sorted(
        wanted | {item.stamp_ns for item in measurements if item.stamp_ns <= newest_ns}
    ):
        if at_ns > now_ns:
            state = predicted(motion, TrackState(now_ns, x, P), at_ns)
            x, P, now_ns = state.mean, state.covariance, at_ns
        for item in measurements:
            if item.stamp_ns == at_ns:
                x, P = _updated(motion, x, P, item, iterated)
        states[at_ns] = TrackState(at_ns, x, P)
    return {at_ns: states[at_ns] for at_ns in sorted(wanted)}


def predicted(motion: MotionModel, state: TrackState, stamp_ns: int) -> TrackState:
    """Return the state at `stamp_ns`, predicted. Raises `CallError` for a motion model without an equation."""
    ahead = _moments(
        motion, state.mean[None], np.array([seconds(stamp_ns - state.stamp_ns)])
    )
    F = ahead.F[0]
    return TrackState(stamp_ns, ahead.mean[0], F @ state.covariance @ F.T + ahead.Q[0])


def _updated(
    motion: MotionModel, x: FloatArray, P: FloatArray, item: Measurement, iterated: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the state x (n,) and its covariance P (n, n) after the measurement."""
    step = np.zeros(len(x))
    for _ in range(_NEWTON_STEPS if iterated else 1):
        y, H = innovation(motion, item, x + step)
        y, last, weight = y + H @ step, step, 1.0
        for _ in range(_WEIGHT_STEPS if item.loss else 1):
            S = H @ P @ H.T + item.R / weight
            step = P @ H.T @ np.linalg.solve(S, y)
            weight = _weight(item, y - H @ step)
        if np.abs(step - last).max() < _UPDATE_TOLERANCE:
            break
    return x + step, P - P @ H.T @ np.linalg.solve(S, H @ P)


def _moments(motion: MotionModel, x: FloatArray, dt_s: FloatArray) -> Moments:
    """Moments of the states x (m, n) after `dt_s` (m,). Raises `CallError` for a model without an equation."""
    equation = equation_of(motion)
    if equation is None:
        raise CallError(
            f"no reference for {motion!r}: fgtrack.testing.equations has no equation for it"
        )
    if not motion.linear:
        return moments(equation, x, dt_s)
    parts = [_linear_moments(equation, motion.dim, float(t)) for t in dt_s]
    F, Q = (
        np.array([part[k] for part in parts]).reshape(-1, motion.dim, motion.dim)
        for k in range(2)
    )
    return Moments(np.vecdot(F, x[:, None, :]), F, Q)


@cache
def _linear_moments(
    equation: MotionEquation, n: int, dt_s: float
) -> tuple[FloatArray, FloatArray]:
    """F and Q (n, n) of a linear equation by one matrix exponential (Van Loan, IEEE TAC 23(3), 1978)."""
    x = np.zeros((1, n))
    A, D = (
        drift_jacobian(equation, x)[0],
        np.asarray(equation.diffusion(x[0]), dtype=np.float64),
    )
    exponential = expm(dt_s * np.block([[-A, D], [np.zeros((n, n)), A.T]]))
    F = exponential[n:, n:].T
    Q = F @ exponential[:n, n:]
    return F, (Q + Q.T) / 2.0


def innovation(
    motion: MotionModel, item: Measurement, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Innovation y (k,) of a measurement at the state x (n,), and its Jacobian H (k, n)."""
    known: Linearisation = linearised(
        item.model.components, motion.state_names, x, item.pose
    )
    return residual(item.model.components, item.z, known.z), known.H


def slope(function: Callable[[FloatArray], FloatArray], x: FloatArray) -> FloatArray:
    """Jacobian of `function` at `x` (n,) by difference quotients, shape (k, n)."""
    steps = _QUOTIENT_STEP * (1.0 + np.abs(x)) * np.eye(len(x))
    return np.column_stack(
        [
            (function(x + step) - function(x - step)) / (2.0 * step.sum())
            for step in steps
        ]
    )


def _weight(item: Measurement, y: FloatArray) -> float:
    """Weight of a measurement under its robust loss at the residual `y` (k,). Raises `CallError` except for Huber's."""
    if item.loss is None:
        return 1.0
    if item.loss.kind != "huber":
        raise CallError(f"no reference for the loss {item.loss.kind}: huber only")
    length = math.sqrt(y @ np.linalg.solve(item.R, y))
    return 1.0 / max(length / _huber_width(item.loss, len(y)), 1.0)


@cache
def _huber_width(loss: RobustLoss, size: int) -> float:
    """Length of a whitened residual of `size` components that is exceeded as rarely as the width by one component."""
    return float(stats.chi.isf(2.0 * stats.norm.sf(loss.width), size))


def difference(
    found: TrackState, expected: TrackState, motion: MotionModel | None = None
) -> tuple[float, float]:
    """Distance of `found` from `expected`: the largest difference of means and covariances, in standard deviations.

    A covariance is relative to the two standard deviations of its entry; a NaN stays one. The yaw of a state of
    `motion` goes the short way round.
    """
    sigma, off = np.sqrt(np.diag(expected.covariance)), found.mean - expected.mean
    off = off if motion is None else wrapped(motion, off)
    covariance = np.abs(found.covariance - expected.covariance) / np.outer(sigma, sigma)
    return float((np.abs(off) / sigma).max()), float(covariance.max())


def rounding_bound(
    motion: MotionModel, stamps_ns: Iterable[int], sigma_m: float = 0.5
) -> float:
    """Bound of the rounding errors, in standard deviations, of a solver that divides by a linear model's process noise.

    The process noise of a short segment ties its start to its end with the weight W = 2 / sqrt(Q_xx), for example
    1 / 3e-11 m for CV and 1 us. Rows of this weight round the row of a measurement with the standard deviation
    `sigma_m` by eps W sigma_m in an orthogonal factorisation. The bound is ten times this error, for the shortest
    segment between `stamps_ns`. A filter in covariance form does not divide by process noise, and needs no bound.
    """
    gaps_ns = np.diff(sorted(set(stamps_ns)))
    if not gaps_ns.size:
        return 0.0
    Q = motion.process_noise(np.zeros(motion.dim), seconds(int(gaps_ns.min())))
    return float(10.0 * np.finfo(np.float64).eps * sigma_m * 2.0 / np.sqrt(Q[0, 0]))
