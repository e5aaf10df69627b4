"""Measurement models against the oracle's formulas and difference quotients."""

from itertools import product

import numpy as np
from support.oracle.sightings import Eye, Sighting, located, seen, slopes

from fgtrack.core.types import MEASURABLE, FloatArray
from fgtrack.models.measurement import (
    COMPONENTS,
    SensorPose,
    measured_position,
    measurement_model,
    position_gradient,
)
from fgtrack.models.motion import MotionModel

_EYE = Eye(-3.0, 8.0, 2.5, 11.0, -7.0)


def measurement_differences(motion: MotionModel, states: FloatArray) -> float:
    """Largest difference of a value, residual or derivative of any component, alone and all together.

    At `states` (m, n) of `motion`; by the state and by the sensor's pose, and of positions in the map. A NaN stays one.
    """
    known = MEASURABLE if motion.cartesian else COMPONENTS
    kinds = (*((name,) for name in known), ("range_m", "bearing_rad"), known)
    apart = [each for names, x in product(kinds, states) for each in _apart(names, x, motion)]
    return float(np.max([np.abs(each).max() for each in apart]))


def _apart(names: tuple[str, ...], x: FloatArray, motion: MotionModel) -> list[FloatArray]:
    pose, model, k = SensorPose(*_EYE), measurement_model(names, motion), len(names)
    value = seen(names, x, motion.state_names, _EYE)
    z = value + np.linspace(2.0, 5.0, k)  # angles are off by more than half a turn
    sighting = Sighting(0, names, z, np.eye(k), _EYE)

    def from_pose(eye: FloatArray) -> FloatArray:
        return -Sighting(0, names, value, np.eye(k), Eye(*eye.tolist())).residual(x, motion.state_names)

    by_pose = model.pose_jacobian(x, pose) - slopes(from_pose, np.array(_EYE))
    apart = [
        model.predict(x, pose) - value,
        model.predict(np.stack([x, x]), pose) - value,
        model.residual(z, model.predict(x, pose)) - sighting.residual(x, motion.state_names),
        model.jacobian(x, pose) - sighting.slope(x, motion.state_names),
        by_pose,
    ]
    place, gradient = measured_position(names, z, np.eye(k), pose), position_gradient(names, z, pose)
    expected = located(names, z, _EYE)
    if place is None or gradient is None or expected is None:
        agreed = [place is None, gradient is None, expected is None]
        return [*apart, np.array(0.0 if all(agreed) else np.nan)]
    J = slopes(lambda z: np.array(located(names, z, _EYE)), z)
    V = J @ J.T
    return [*apart, place[0] - expected, gradient - J, (place[1] - V) / np.trace(V)]
