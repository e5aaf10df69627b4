"""Draws from a motion model."""

import numpy as np

from fgtrack.core.types import FloatArray
from fgtrack.models.motion import MotionModel


def drawn(motion: MotionModel, x: FloatArray, dt_s: float, rng: np.random.Generator) -> FloatArray:
    """A draw of the states `dt_s` after `x`, both shape (..., n): the prediction plus N(0, Q(x, dt_s)).

    Raises `numpy.linalg.LinAlgError` where Q is singular, as with a density of zero.
    """
    roots = np.linalg.cholesky(motion.process_noise(x, dt_s))
    noise = rng.standard_normal((*x.shape[:-1], 1, x.shape[-1]))
    return np.asarray(motion.predict(x, dt_s) + np.vecdot(roots, noise))
