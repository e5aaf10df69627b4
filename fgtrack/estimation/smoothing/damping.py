"""Levenberg-Marquardt for the window of one track, where a Gauss-Newton step went too far."""

import numpy as np

from fgtrack.core.linalg import identity, mahalanobis_squared
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.smoothing.solver import Solver
from fgtrack.estimation.smoothing.terms import cost

_START, _FACTOR, _LARGEST = 1e-5, 10.0, 1e5
_TOLERANCE = 1e-12
_MAX_STEPS = 100


class DampedWindow:
    """The window of one track, with the process noise of its linearisation points.

    Parameters
    ----------
    solver, track
        The window.
    """

    def __init__(self, solver: Solver, track: int) -> None:
        self._solver, self._track = solver, track
        nodes, n = solver.nodes, solver.motion.dim
        self._numbers = nodes.window(track)
        self._Q = nodes.segment[self._numbers, :, n : 2 * n]
        self._dt_s = np.diff(nodes.window_stamps_ns(track)) / NS_PER_S
        oldest = self._numbers[0]
        self._prior = nodes.origin[oldest] + nodes.predicted[oldest, :, n]
        self._P = nodes.predicted[oldest, :, :n].copy()

    def solved(self) -> FloatArray:
        """Means (m, n) with the least cost near the linearisation points, which are lost: solve again.

        Raises `numpy.linalg.LinAlgError` if it fails.
        """
        means = self._solver.nodes.origin[self._numbers]
        least, damping = self._cost(means), _START
        for _ in range(_MAX_STEPS):
            before, used = least, self._linearise(means)
            while damping <= _LARGEST:
                trial = self._step(used, damping)
                trial_cost = self._cost(trial)
                if trial_cost <= before:
                    means, least, damping = trial, trial_cost, damping / _FACTOR
                    break
                damping *= _FACTOR
            if not before - least > _TOLERANCE * max(before, 1.0):
                break
        return means

    def _linearise(self, means: FloatArray) -> IntArray:
        """Linearise at `means`; return the number of rows of each node."""
        nodes, n = self._solver.nodes, self._solver.motion.dim
        self._solver.move_to(self._track, means)
        self._solver.linearise(self._track)
        nodes.segment[self._numbers, :, n : 2 * n] = self._Q
        return nodes.num_rows[self._numbers]

    def _step(self, used: IntArray, damping: float) -> FloatArray:
        """Means after a step of which a change of an entry by 1 costs `damping` / 2."""
        nodes, n, tracks = self._solver.nodes, self._solver.motion.dim, np.array([self._track])
        prior = np.concatenate([np.sqrt(damping) * identity(n), np.zeros((n, 1))], axis=1)
        nodes.num_rows[self._numbers] = used
        nodes.append_rows(self._numbers, np.broadcast_to(prior, (len(self._numbers), *prior.shape)))
        self._solver.eliminate(tracks, nodes.first[tracks])
        self._solver.back_substitute(tracks)
        return self._solver.estimates(self._track)

    def _cost(self, means: FloatArray) -> float:
        """Half of the sum of squares, and the robust losses of measurements that have one."""
        gaps = means[1:] - self._solver.motion.predict(means[:-1], self._dt_s)
        total = 0.5 * float(mahalanobis_squared(means[0] - self._prior, self._P))
        total += 0.5 * float(mahalanobis_squared(gaps, self._Q[:-1]).sum())
        terms = self._solver.nodes.terms
        for number, x in zip(self._numbers.tolist(), means, strict=True):
            total += sum(cost(term, x) for term in terms[number])
        return total
