"""Motion and measurement models against the oracle's differential equations, formulas and difference quotients."""

from collections.abc import Iterator
from itertools import product

import numpy as np

from fgtrack.core.types import MEASURABLE, FloatArray
from fgtrack.estimation.dense_joint import Difference
from fgtrack.models.measurement import COMPONENTS, SensorPose, measurement_model
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.pipeline.oracle.dynamics import Flow
from fgtrack.pipeline.oracle.sightings import Eye, Sighting, seen
from fgtrack.pipeline.verify_streams import dynamics_of

MODEL_TOLERANCE = 1e-8
_MODELS: tuple[MotionModel, ...] = (CTRV(), CTRA(), CV())
_DURATIONS_S = (1e-6, 0.004, 0.05, 0.7, 2.5)
_EYE = Eye(-3.0, 8.0, 2.5, 11.0, -7.0)

#: Straight on, turning hard to either side, standing, backwards.
_STATES = np.array(
    [
        (3.0, -2.0, 0.3, 65.0, 0.0, 0.0),
        (-40.0, 7.0, -2.9, 12.0, 0.9, -4.0),
        (5.0, 90.0, 1.7, 30.0, -0.6, 3.0),
        (0.0, 0.5, 0.0, 0.2, -0.1, 0.5),
        (1.0, 1.0, 3.0, -4.0, 0.3, 0.0),
    ]
)


def model_differences() -> Iterator[tuple[str, Difference]]:
    """By name of the model: difference of means and Jacobians, in units of the state or measurement, and of Q."""
    for motion in _MODELS:
        yield type(motion).__name__, _motion(motion)
    for motion in (CTRV(), CV()):
        kind = "vx, vy" if motion.cartesian else "yaw, speed"
        yield f"measurements with {kind}", Difference(_measurements(motion), 0.0)


def _motion(motion: MotionModel) -> Difference:
    """Of stacks of states and of single ones, which the models evaluate in different ways."""
    dynamics, largest = dynamics_of(motion), Difference(0.0, 0.0)
    states = _of(motion)
    for dt_s in _DURATIONS_S:
        expected = dynamics.flow(states, np.full(len(states), dt_s))
        F, Q = motion.jacobian(states, dt_s), motion.process_noise(states, dt_s)
        steps = [motion.step(x, dt_s) for x in states.tolist()]
        means, slopes = zip(*(motion.flow(x, dt_s) for x in states.tolist()), strict=True)
        for each in (
            Flow(motion.predict(states, dt_s), F, Q),
            Flow(*(np.array([step[part] for step in steps]) for part in range(3))),
            Flow(np.array(means), np.array(slopes), expected.Q),
        ):
            largest = Difference(*np.maximum(largest, _apart(each, expected)))
    return largest


def _apart(found: Flow, expected: Flow) -> Difference:
    sigma = np.sqrt(np.diagonal(expected.Q, axis1=1, axis2=2))
    noise = np.abs(found.Q - expected.Q) / (sigma[:, :, None] * sigma[:, None, :])
    mean, slope = np.abs(found.mean - expected.mean), np.abs(found.F - expected.F)
    return Difference(float(max(mean.max(), slope.max())), float(noise.max()))


def _measurements(motion: MotionModel) -> float:
    """Values, residuals and Jacobians of every component, alone and all together."""
    pose, largest = SensorPose(*_EYE), 0.0
    known = MEASURABLE if motion.cartesian else COMPONENTS
    for names in ((name,) for name in known), (known,):
        for components, x in product(names, _of(motion)):
            model, k = measurement_model(components, motion), len(components)
            value = seen(components, x, motion.state_names, _EYE)
            z = value + np.linspace(2.0, 5.0, k)  # angles are off by more than half a turn
            sighting = Sighting(0, components, z, np.eye(k), _EYE)
            residual = model.residual(z, model.predict(x, pose)) - sighting.residual(x, motion.state_names)
            slope = model.jacobian(x, pose) - sighting.slope(x, motion.state_names)
            largest = max(largest, *np.abs(model.predict(x, pose) - value), *np.abs(residual), np.abs(slope).max())
    return float(largest)


def _of(motion: MotionModel) -> FloatArray:
    """`_STATES` in the form of `motion`, shape (m, n)."""
    x, _ = motion.from_kinematic(_STATES, np.zeros((len(_STATES), 6, 6)))
    if motion.cartesian:
        x[:, 2] = _STATES[:, 3] * np.cos(_STATES[:, 2])
        x[:, 3] = _STATES[:, 3] * np.sin(_STATES[:, 2])
    return x
