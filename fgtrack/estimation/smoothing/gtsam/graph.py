"""The nonlinear factor graph of a window in gtsam."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import gtsam
import numpy as np

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.smoothing.gtsam.factors import measurement_factor, motion_factor
from fgtrack.estimation.smoothing.terms import MeasurementFactor
from fgtrack.models.motion import MotionModel


def window_graph(
    motion: MotionModel,
    keys: Sequence[int],
    stamps_ns: Sequence[int],
    prior_mean: FloatArray,
    prior_covariance: FloatArray,
    noises: FloatArray,
    measurements: Iterable[tuple[int, MeasurementFactor]],
) -> gtsam.NonlinearFactorGraph:
    """Return the graph of a window: the prior, the motion between neighbours, and each measurement.

    `keys` and `stamps_ns` belong to the states. The prior, (n,) and (n, n), is that of the first state. `noises`,
    shape (m - 1, n, n), belong to the motion. Each measurement comes with the key of its state.

    Raises `numpy.linalg.LinAlgError` for a covariance that is not positive definite.
    """
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Gaussian.Covariance(prior_covariance)
    graph.add(gtsam.PriorFactorVector(keys[0], prior_mean, noise))
    durations_s = (np.diff(stamps_ns) / NS_PER_S).tolist()
    for (left, right), dt_s, Q in zip(pairwise(keys), durations_s, noises, strict=True):
        graph.add(motion_factor(motion, left, right, dt_s, Q))
    for key, (measurement, ahead_s) in measurements:
        graph.add(measurement_factor(measurement, key, motion=motion, ahead_s=ahead_s))
    return graph


def values_of(keys: Sequence[int], states: FloatArray) -> gtsam.Values:
    """Return the values of states (m, n), each under its key."""
    values = gtsam.Values()
    for key, state in zip(keys, states, strict=True):
        values.insert(key, state)
    return values
