"""The state of a window at any stamp, from those of the nodes around it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.ekf import predict, propagated
from fgtrack.estimation.interpolation import between
from fgtrack.models.motion import MotionModel

State = tuple[FloatArray, FloatArray]
"""Mean (n,) and covariance (n, n)."""


class Around(NamedTuple):
    """What a window knows around a stamp: the node at or before it, and the one after it, if any."""

    mean: FloatArray
    """Of the node before, shape (n,)."""
    covariance: FloatArray
    """Of the node before, shape (n, n); where there is one after it of both, (2 n, 2 n)."""
    until_s: float = 0.0
    """From the node before to the stamp."""
    right: FloatArray | None = None
    """Mean of the node after it."""
    after_s: float = 0.0
    """From the stamp to the node after it."""


def state(motion: MotionModel, around: Around) -> State:
    """That of the node, predicted ahead, or interpolated between two nodes under the motion model."""
    mean, covariance, until_s, right, after_s = around
    if until_s == 0.0:
        return mean, symmetrise(covariance)
    if right is None:
        return predict(mean, covariance, motion, until_s)
    inner = between(motion, mean, right, until_s, after_s)
    return inner.mean, propagated(np.concatenate([inner.Lambda, inner.Psi], axis=1), covariance, inner.Sigma)


def states(motion: MotionModel, arounds: Sequence[Around]) -> list[State]:
    """`state` of many windows of one motion model."""
    found: list[State | None] = [state(motion, around) if around.until_s == 0.0 else None for around in arounds]
    ahead = [row for row, around in enumerate(arounds) if found[row] is None and around.right is None]
    inner = [row for row, around in enumerate(arounds) if around.right is not None]
    for rows, many in ((ahead, _ahead), (inner, _inner)):
        if len(rows) == 1:
            found[rows[0]] = state(motion, arounds[rows[0]])
        elif rows:
            for row, each in zip(rows, zip(*many(motion, [arounds[row] for row in rows]), strict=True), strict=True):
                found[row] = each
    return [each for each in found if each is not None]


def _ahead(motion: MotionModel, arounds: Sequence[Around]) -> State:
    """Of m windows, shapes (m, n) and (m, n, n)."""
    step = motion.transition(np.array([each.mean for each in arounds]), np.array([each.until_s for each in arounds]))
    return step.mean, propagated(step.F, np.array([each.covariance for each in arounds]), step.Q)


def _inner(motion: MotionModel, arounds: Sequence[Around]) -> State:
    """Of m windows, shapes (m, n) and (m, n, n)."""
    mean, right = np.array([each.mean for each in arounds]), np.array([each.right for each in arounds])
    until_s, after_s = np.array([each.until_s for each in arounds]), np.array([each.after_s for each in arounds])
    inner = between(motion, mean, right, until_s, after_s)
    weights = np.concatenate([inner.Lambda, inner.Psi], axis=-1)
    return inner.mean, propagated(weights, np.array([each.covariance for each in arounds]), inner.Sigma)
