"""The factors of a window, each as rows of least squares where it is linearised, or as a function for an optimiser."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import gtsam
import numpy as np

from fgtrack.core.linalg import inverse_roots, noise_roots
from fgtrack.core.types import FloatArray
from fgtrack.estimation.factor_graph.factors import measurement_factor, motion_factor, prior_factor
from fgtrack.estimation.marginalised_past import Prior
from fgtrack.estimation.terms import MeasurementTerm
from fgtrack.estimation.whitening import whitened_term
from fgtrack.models.motion import MotionModel

_FEW = 6  # so many segments are linearised faster one by one


class Rows(NamedTuple):
    """Sum over the variables of A (x - at) = b + N(0, I)."""

    keys: tuple[int, ...]
    """One variable or two neighbours."""
    A: tuple[FloatArray, ...]
    """Shape (k, n) each."""
    b: FloatArray
    """Shape (k,)."""
    at: tuple[FloatArray, ...]
    """Linearisation points, shape (n,) each."""


class Factor(Protocol):
    """A factor of the graph."""

    def rows(self) -> Rows:
        """Linearised where it is told to be. Raises `numpy.linalg.LinAlgError` for noise not positive definite."""

    def nonlinear(self) -> gtsam.NonlinearFactor:
        """As a function of its variables. Raises as `rows`."""


class Segment:
    """The motion from the variable `keys[0]` to `keys[1]` in `dt_s`, linearised at the states `at`.

    Its noise is that of the first of these states.
    """

    def __init__(
        self, motion: MotionModel, keys: tuple[int, int], dt_s: float, at: tuple[FloatArray, FloatArray]
    ) -> None:
        self._motion, self._keys, self._dt_s, self._at = motion, keys, dt_s, at
        self._rows: Rows | None = None

    def rows(self) -> Rows:
        """See `Factor.rows`."""
        if self._rows is None:
            left, right = self._at
            step = self._motion.transition(left, self._dt_s)
            W = noise_roots(step.Q)
            self._rows = Rows(self._keys, (-W.dot(step.F), W), W.dot(np.subtract(step.mean, right)), self._at)
        return self._rows

    def nonlinear(self) -> gtsam.NonlinearFactor:
        """See `Factor.nonlinear`; the noise stays as it is."""
        return motion_factor(self._motion, *self._keys, self._dt_s, self._at[0])

    @staticmethod
    def linearise(segments: Sequence["Segment"]) -> None:
        """Find the rows of many segments of one motion model at once. Raises as `rows`, and then has found none."""
        if len(segments) <= _FEW:
            return
        left, right = (np.array([segment._at[side] for segment in segments]) for side in (0, 1))
        step = segments[0]._motion.transition(left, np.array([segment._dt_s for segment in segments]))
        W = noise_roots(step.Q)
        b = np.vecdot(W, (step.mean - right)[:, None])
        for segment, by_left, by_right, ahead in zip(segments, -(W @ step.F), W, b, strict=True):
            segment._rows = Rows(segment._keys, (by_left, by_right), ahead, segment._at)


class Term:
    """What is measured of the variable `key`, linearised and weighted by its loss at the state `at` (n,).

    `whitened` is `whitened_term` there, where it is known.
    """

    def __init__(self, key: int, term: MeasurementTerm, at: FloatArray, whitened: FloatArray | None = None) -> None:
        self._key, self._term, self._at, self._whitened = key, term, at, whitened

    def rows(self) -> Rows:
        """See `Factor.rows`."""
        if self._whitened is None:
            self._whitened = whitened_term(self._term, self._at)
        return Rows((self._key,), (self._whitened[:, :-1],), self._whitened[:, -1], (self._at,))

    def nonlinear(self) -> gtsam.NonlinearFactor:
        """See `Factor.nonlinear`."""
        return measurement_factor(self._key, self._term, self._at)


class PriorOf:
    """What is known of the variable `key` from before its stamp."""

    def __init__(self, key: int, prior: Prior) -> None:
        self._key, self._prior = key, prior

    def rows(self) -> Rows:
        """See `Factor.rows`."""
        mean, covariance = self._prior.mean, self._prior.covariance
        return Rows((self._key,), (inverse_roots(covariance),), np.zeros(len(mean)), (mean,))

    def nonlinear(self) -> gtsam.NonlinearFactor:
        """See `Factor.nonlinear`."""
        return prior_factor(self._key, self._prior.mean, self._prior.covariance)
