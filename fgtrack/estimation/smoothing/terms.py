"""Measurements of a node of the window, linearised."""

import math
from collections.abc import Iterable

import numpy as np

from fgtrack.core.linalg import inverse_root, mahalanobis_squared
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Measurement
from fgtrack.models.motion import MotionModel
from fgtrack.models.robust import penalty, weight

#: Stamps at most this far apart share a node. The process noise between two nodes would be nearly singular.
NEAR_NS = 1_000
MeasurementFactor = tuple[Measurement, float]
"""A measurement of a node, and the time from the stamp of the node to its own stamp. Its process noise is neglected."""


def linearised(
    factor: MeasurementFactor, x: FloatArray, motion: MotionModel
) -> tuple[FloatArray, FloatArray]:
    """Return y and H of y = H (x' - x) + N(0, R) near the state `x` of the node, shape (n,)."""
    measurement, ahead_s = factor
    if not ahead_s:
        return measurement.model.linearised(measurement.z, x, measurement.pose)
    y, H = measurement.model.linearised(
        measurement.z, motion.predict(x, ahead_s), measurement.pose
    )
    return y, H @ motion.jacobian(x, ahead_s)


def whitened(
    factor: MeasurementFactor, x: FloatArray, motion: MotionModel
) -> FloatArray:
    """Linearise `factor` at `x` (n,), weighted by its loss: rows [G | y] of y = G (x' - x) + N(0, I), shape (k, n +
    1).

    Raises `numpy.linalg.LinAlgError` for an R that is not positive definite.
    """
    y, H = linearised(factor, x, motion)
    rows = inverse_root(factor[0].R) @ np.column_stack([H, y])
    if factor[0].loss is not None:
        rows *= math.sqrt(
            weight(factor[0].loss, float(np.linalg.norm(rows[:, -1])), len(rows))
        )
    return np.asarray(rows)


def cost(factor: MeasurementFactor, x: FloatArray, motion: MotionModel) -> float:
    """Return half of the squared Mahalanobis distance of `factor` from the state `x` (n,), or its robust loss."""
    y, _ = linearised(factor, x, motion)
    return penalty(
        factor[0].loss, math.sqrt(mahalanobis_squared(y, factor[0].R)), len(y)
    )


def overshot(
    factors: Iterable[MeasurementFactor],
    origin: FloatArray,
    mean: FloatArray,
    motion: MotionModel,
) -> bool:
    """True if the step from the linearisation point `origin` to `mean`, both (n,), left the linear range of a
    factor.

    Outside this range the linearisation predicts a measurement wrong by more than a standard deviation.
    """
    for factor in factors:
        model = factor[0].model
        if not model.linear:
            y, H = linearised(factor, origin, motion)
            error = model.residual(
                linearised(factor, mean, motion)[0], y - H @ (mean - origin)
            )
            if mahalanobis_squared(error, factor[0].R) > 1.0:
                return True
    return False
