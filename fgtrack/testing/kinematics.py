"""What a motion model publishes of a state, and what it makes of that where an object begins."""

import math
from collections.abc import Callable

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import ACCEL, STATE_NAMES, YAW, FloatArray
from fgtrack.models.motion import MotionModel

ModelCheck = Callable[[MotionModel, FloatArray, float], str | None]
"""What is wrong of a model at a state (n,) and a duration, or None."""

#: Of the covariance from which a covariance of first order is told from one with higher terms.
_SMALL = 1e-6
_STEP = 1e-6


def apart(found: FloatArray, expected: FloatArray, tolerance: float, what: str) -> str | None:
    """What is wrong where `found` is not `expected`; None where it is. A NaN is wrong."""
    found = np.asarray(found)
    if found.shape != expected.shape:
        return f"{what} has shape {found.shape}, expected {expected.shape}"
    off = np.abs(found - expected).max() / (1.0 + np.abs(expected).max())
    return None if off < tolerance else f"{what} is\n{found}\nexpected\n{expected}"


def _shown(model: MotionModel, x: FloatArray) -> FloatArray:
    """The kinematic state of `x` (n,), by the names of its entries."""
    own = dict(zip(model.state_names, x.tolist(), strict=True))
    if model.cartesian:
        own["yaw_rad"], own["speed_mps"] = math.atan2(x[3], x[2]), math.hypot(x[2], x[3])
    names = STATE_NAMES if "accel_mps2" in model.state_names else STATE_NAMES[:ACCEL]
    return np.array([own.get(name, 0.0) for name in names])


def _covariance(n: int) -> FloatArray:
    """A covariance whose entries are all different, shape (n, n)."""
    root = np.eye(n) + 0.3 * np.sin(np.arange(n * n, dtype=np.float64)).reshape(n, n)
    return _SMALL * root @ root.T


def _publishes_the_entries_of_its_state(model: MotionModel, x: FloatArray, dt_s: float) -> str | None:
    """The mean by name, the covariance by difference quotients of that."""
    P = _covariance(model.dim)
    steps = _STEP * (1.0 + np.abs(x)) * np.eye(model.dim)
    columns = []
    for step in steps:
        off = _shown(model, x + step) - _shown(model, x - step)
        off[YAW] = wrap_angles(off[YAW : YAW + 1])[0]
        columns.append(off / (2.0 * step.sum()))
    J = np.column_stack(columns)
    mean, covariance = model.kinematic(x, P)
    many, covariances = model.kinematic(np.stack([x, 1.1 * x]), np.stack([P, 2.0 * P]))
    return (
        apart(mean, _shown(model, x), 1e-9, "the mean of kinematic")
        or apart(covariance / _SMALL, J @ P @ J.T / _SMALL, 1e-5, f"the covariance of kinematic over {_SMALL}")
        or apart(many, np.array([_shown(model, x), _shown(model, 1.1 * x)]), 1e-9, "kinematic of an array")
        or apart(covariances[0] / _SMALL, covariance / _SMALL, 1e-9, "the covariance of kinematic of an array")
    )


def _is_as_it_was_after_a_kinematic_state(model: MotionModel, x: FloatArray, dt_s: float) -> str | None:
    """The mean; and, because the errors are small, the covariance of what both know."""
    P = _covariance(model.dim)
    shown, published = model.kinematic(x, P)
    back, covariance = model.from_kinematic(shown, published)
    if back.shape != x.shape or covariance.shape != (model.dim, model.dim):
        return f"from_kinematic gives shapes {back.shape} and {covariance.shape}"
    known = [k for k, name in enumerate(model.state_names) if k < 4 or name in STATE_NAMES[: len(shown)]]
    both = np.ix_(known, known)
    return apart(back[known], x[known], 1e-9, "from_kinematic of kinematic") or apart(
        covariance[both] / _SMALL,
        P[both] / _SMALL,
        1e-4,
        f"the covariance of from_kinematic of kinematic over {_SMALL}",
    )


def _begins_with_a_sound_covariance(model: MotionModel, x: FloatArray, dt_s: float) -> str | None:
    """An entry of which nothing is known begins at 0 with its own variance."""
    for name in model.state_names:
        variance = model.start_variance(name)
        if not 0.0 < variance < math.inf:
            return f"start_variance({name!r}) is {variance}; it must be positive and finite"
    mean, P = _shown(model, x), np.eye(ACCEL)
    begun, covariance = model.from_kinematic(mean[:ACCEL], P)
    for k, name in enumerate(model.state_names[4:], start=4):
        if name not in STATE_NAMES[:ACCEL]:
            expected = np.zeros(model.dim)
            expected[k] = model.start_variance(name)
            wrong = apart(begun[k], np.array(0.0), 1e-12, f"{name} of a birth")
            wrong = wrong or apart(covariance[k], expected, 1e-9, f"the covariance of {name} of a birth")
            if wrong:
                return wrong
    scale = np.sqrt(np.abs(np.diag(covariance)))
    sound = np.isfinite(covariance).all() and (covariance == covariance.T).all() and (scale > 0.0).all()
    if not sound or not np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 0.0:
        return f"the covariance of from_kinematic is not symmetric and positive definite:\n{covariance}"
    return None


KINEMATIC_CHECKS: tuple[ModelCheck, ...] = (
    _publishes_the_entries_of_its_state,
    _is_as_it_was_after_a_kinematic_state,
    _begins_with_a_sound_covariance,
)
