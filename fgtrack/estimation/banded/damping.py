"""Levenberg-Marquardt for the window of one track, where a Gauss-Newton step went too far."""

import numpy as np

from fgtrack.core.linalg import identity, mahalanobis_squared
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray, IntArray
from fgtrack.estimation.banded.solver import Solver
from fgtrack.estimation.terms import cost
from fgtrack.models.motion import MotionModel

_START, _FACTOR, _LARGEST = 1e-5, 10.0, 1e5
_TOLERANCE = 1e-12
_MAX_STEPS = 100


class DampedWindow:
    """The window of one track with the process noise of where it is linearised now.

    Parameters
    ----------
    solver, motion, track
        Whose window, and how its object moves.
    """

    def __init__(self, solver: Solver, motion: MotionModel, track: int) -> None:
        self._solver, self._motion, self._track = solver, motion, track
        nodes, n = solver.nodes, motion.dim
        self._at = solver.window(track)
        self._Q = nodes.segment[self._at, :, n : 2 * n]
        self._dt_s = np.diff(solver.stamps_ns(track)) / NS_PER_S
        oldest = self._at[0]
        self._prior = nodes.origin[oldest] + nodes.predicted[oldest, :, n]
        self._P = nodes.predicted[oldest, :, :n].copy()

    def solved(self) -> FloatArray:
        """Means (m, n) with the least cost near the linearisation points, which are lost: solve anew.

        Raises `numpy.linalg.LinAlgError` where it fails.
        """
        means = self._solver.nodes.origin[self._at]
        least, damping = self._cost(means), _START
        for _ in range(_MAX_STEPS):
            before, used = least, self._linearise(means)
            while damping <= _LARGEST:
                trial = self._step(used, damping)
                found = self._cost(trial)
                if found <= before:
                    means, least, damping = trial, found, damping / _FACTOR
                    break
                damping *= _FACTOR
            if not before - least > _TOLERANCE * max(before, 1.0):
                break
        return means

    def _linearise(self, means: FloatArray) -> IntArray:
        """Linearise at `means`; gives the number of rows at each node."""
        nodes, n = self._solver.nodes, self._motion.dim
        self._solver.move_to(self._track, means)
        self._solver.linearise(self._track)
        nodes.segment[self._at, :, n : 2 * n] = self._Q
        return nodes.num_rows[self._at]

    def _step(self, used: IntArray, damping: float) -> FloatArray:
        """Means after a step that each entry's change of 1 costs `damping` / 2."""
        nodes, n, track = self._solver.nodes, self._motion.dim, self._track
        still = np.concatenate([np.sqrt(damping) * identity(n), np.zeros((n, 1))], axis=1)
        nodes.num_rows[self._at] = used
        nodes.measure(self._at, np.broadcast_to(still, (len(self._at), *still.shape)))
        self._solver.eliminate(np.array([track]), nodes.first[[track]])
        self._solver.solve_means(np.array([track]))
        return self._solver.estimates(track)

    def _cost(self, means: FloatArray) -> float:
        """Half of the sum of squares, and losses where measurements have one."""
        gaps = means[1:] - self._motion.predict(means[:-1], self._dt_s)
        total = 0.5 * float(mahalanobis_squared(means[0] - self._prior, self._P))
        total += 0.5 * float(mahalanobis_squared(gaps, self._Q[:-1]).sum())
        terms = self._solver.nodes.terms
        for number, x in zip(self._at.tolist(), means, strict=True):
            total += sum(cost(term, x) for term in terms[number])
        return total
