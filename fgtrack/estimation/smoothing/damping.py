"""Levenberg-Marquardt for the window of one track, where a Gauss-Newton step went too far."""

import numpy as np

from fgtrack.core.linalg import identity, mahalanobis_squared
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import cost

_START, _FACTOR, _LARGEST = 1e-5, 10.0, 1e5
_TOLERANCE = 1e-12
_MAX_STEPS = 100


def damped(solver: Solver, track: int) -> FloatArray:
    """Return the means (m, n) of a window with the least cost near its linearisation points, which are lost.

    The process noise remains that of these points: solve again. Raises `numpy.linalg.LinAlgError` if it fails.
    """
    nodes, motion, n = solver.nodes, solver.motion, solver.motion.dim
    tracks, numbers = np.array([track]), nodes.window(track)
    dt_s = np.diff(nodes.window_stamps_ns(track)) / NS_PER_S
    Q, prior = nodes.segment[numbers, :, n : 2 * n], nodes.predicted[numbers[0]].copy()
    mean = nodes.origin[numbers[0]] + prior[:, n]

    def cost_at(means: FloatArray) -> float:
        """Half of the sum of squares, and the robust losses of measurements that have one."""
        gaps = means[1:] - motion.predict(means[:-1], dt_s)
        total = 0.5 * float(mahalanobis_squared(means[0] - mean, prior[:, :n]))
        total += 0.5 * float(mahalanobis_squared(gaps, Q[:-1]).sum())
        for number, x in zip(numbers.tolist(), means, strict=True):
            total += sum(cost(term, x) for term in nodes.terms[number])
        return total

    means = nodes.origin[numbers]
    least, damping = cost_at(means), _START
    for _ in range(_MAX_STEPS):
        before = least
        solver.move_to(track, means)
        solver.linearise(track)
        nodes.segment[numbers, :, n : 2 * n] = Q
        used = nodes.num_rows[numbers]
        while damping <= _LARGEST:  # a change of an entry by 1 costs damping / 2
            rows = np.hstack([np.sqrt(damping) * identity(n), np.zeros((n, 1))])
            nodes.num_rows[numbers] = used
            nodes.append_rows(numbers, np.broadcast_to(rows, (len(numbers), *rows.shape)))
            solver.eliminate(tracks, nodes.first[tracks])
            solver.back_substitute(tracks)
            trial = solver.estimates(track)
            trial_cost = cost_at(trial)
            if trial_cost <= before:
                means, least, damping = trial, trial_cost, damping / _FACTOR
                break
            damping *= _FACTOR
        if not before - least > _TOLERANCE * max(before, 1.0):
            break
    return means
