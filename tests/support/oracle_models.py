"""Motion models against the oracle's differential equations, and the states that they publish."""

from collections.abc import Iterable, Iterator

import numpy as np
from support.oracle.dynamics import Flow
from support.oracle.kinematics import from_published, published
from support.oracle_measurements import measurement_differences
from support.oracle_streams import dynamics_of

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import ACCEL, SPEED, YAW, FloatArray
from fgtrack.models.motion import CTRA, CTRV, CV, MotionModel
from fgtrack.testing.references import Difference

MODEL_TOLERANCE = 1e-8
_KINDS: tuple[type[CTRV] | type[CV], ...] = (CTRV, CTRA, CV)
_DURATIONS_S = (1e-6, 0.004, 0.05, 0.7, 2.5)

#: Straight on, turning hard to either side, standing, backwards; and more than half a turn within the longest duration,
#: to either side.
STATES = np.array(
    [
        (3.0, -2.0, 0.3, 65.0, 0.0, 0.0),
        (-40.0, 7.0, -2.9, 12.0, 0.9, -4.0),
        (5.0, 90.0, 1.7, 30.0, -0.6, 3.0),
        (0.0, 0.5, 0.0, 0.2, -0.1, 0.5),
        (1.0, 1.0, 3.0, -4.0, 0.3, 0.0),
        (-7.0, 4.0, 1.1, 9.0, 2.2, -1.0),
        (8.0, -6.0, -0.4, 5.0, -1.7, 0.7),
    ]
)


def model_differences() -> Iterator[tuple[str, Difference]]:
    """By name: differences of means and Jacobians, in units of the state or measurement, and of covariances.

    A NaN stays one.
    """
    for kind in _KINDS:
        apart = [_motion(motion) for motion in _with_several_densities(kind)]
        yield kind.__name__, largest(apart)
        yield f"{kind.__name__}, published states", _published(kind())
    for motion in (CTRV(), CV()):
        form = "vx, vy" if motion.cartesian else "yaw, speed"
        apart_each = measurement_differences(motion, states_of(motion))
        yield f"measurements with {form}", Difference(apart_each, 0.0)


def largest(differences: Iterable[Difference]) -> Difference:
    """The largest of each; a NaN wins."""
    means, covariances = np.array(list(differences)).T
    return Difference(float(means.max()), float(covariances.max()))


def _with_several_densities(kind: type[CTRV] | type[CV]) -> Iterator[MotionModel]:
    """The defaults, and parameters of which no two are equal and none is a default: one that is not used shows."""
    yield kind()
    names = kind.density_names()
    for first, step in ((0.013, 1.7), (0.9, 0.45)):
        yield kind(**{name: first * step**k for k, name in enumerate(names)})


def _motion(motion: MotionModel) -> Difference:
    """Forwards and back in time."""
    dynamics, states, apart = dynamics_of(motion), states_of(motion), list[Difference]()
    for dt_s in _DURATIONS_S:
        durations_s = np.full(len(states), dt_s)
        expected, back = dynamics.flow(states, durations_s), dynamics.flow(states, -durations_s)
        F, Q = motion.jacobian(states, dt_s), motion.process_noise(states, dt_s)
        apart += [
            _apart(found, expected)
            for found in (
                Flow(motion.predict(states, dt_s), F, Q),
                Flow(*motion.transition(states, durations_s)),
            )
        ]
        behind = Flow(motion.predict(states, -dt_s), motion.jacobian(states, -dt_s), expected.Q)
        apart.append(_apart(behind, back._replace(Q=expected.Q)))  # noise does not run backwards
    return largest(apart)


def _apart(found: Flow, expected: Flow) -> Difference:
    mean, slope = np.abs(found.mean - expected.mean), np.abs(found.F - expected.F)
    return Difference(float(np.max([mean.max(), slope.max()])), _covariances_apart(found.Q, expected.Q))


def _covariances_apart(found: FloatArray, expected: FloatArray) -> float:
    """The largest difference of covariances (m, n, n), relative to the standard deviations; of 0, itself."""
    sigma = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    return float((np.abs(found - expected) / np.where(scale > 0.0, scale, 1.0)).max())


def _published(motion: MotionModel) -> Difference:
    """Kinematic states of a model, which go into tables, and the way back, which a birth takes."""
    states, names = states_of(motion), motion.state_names
    roots = np.random.default_rng(0).standard_normal((len(states), motion.dim, motion.dim)) + 2.0 * np.eye(motion.dim)
    P = roots @ roots.mT
    shown = motion.kinematic(states, P)
    expected = [published(names, *one) for one in zip(states, P, strict=True)]
    returned = [from_published(names, *one, motion.start_variance) for one in zip(*shown, strict=True)]
    apart = []
    for (mean, covariance), known in ((shown, expected), (motion.from_kinematic(*shown), returned)):
        means, covariances = (np.array(part) for part in zip(*known, strict=True))
        off = mean - means
        if known is expected:
            off[:, YAW] = wrap_angles(off[:, YAW])
        apart.append(Difference(float(np.abs(off).max()), _covariances_apart(covariance, covariances)))
    return largest(apart)


def states_of(motion: MotionModel) -> FloatArray:
    """`STATES` in the form of `motion`, shape (m, n)."""
    if not motion.cartesian:
        return STATES[:, : motion.dim].copy()
    x = STATES[:, :ACCEL][:, : motion.dim].copy()
    x[:, 2] = STATES[:, SPEED] * np.cos(STATES[:, YAW])
    x[:, 3] = STATES[:, SPEED] * np.sin(STATES[:, YAW])
    return x
