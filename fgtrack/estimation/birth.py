"""The first state of a new object."""

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.geometry import cartesian_gradient
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import SPEED, STATE_NAMES, YAW, FloatArray
from fgtrack.estimation.base import KNOWN_YAW_STD_RAD, UNKNOWN_YAW_STD_RAD, Start
from fgtrack.models.motion import MotionModel


def initial_state(motion: MotionModel, start: Start) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) of a `start`, in the state of `motion`.

    Without a direction of travel, a Cartesian velocity is isotropic with mean 0, and a yaw is 0 with a wide
    standard deviation. Raises `CallError` if a cross-covariance names an entry that the state lacks.
    """
    position = np.eye(2) * start.position_std_m**2
    if start.position_covariance is not None:
        position = symmetrise(np.asarray(start.position_covariance, dtype=np.float64))
    unknown = start.yaw_rad is None
    yaw_std_rad = start.yaw_std_rad
    if yaw_std_rad is None:
        yaw_std_rad = UNKNOWN_YAW_STD_RAD if unknown else KNOWN_YAW_STD_RAD
    std = (
        0.0,
        0.0,
        yaw_std_rad,
        start.speed_std_mps,
        start.yaw_rate_std_radps,
        start.accel_std_mps2,
    )
    covariance = np.diag(np.square(std))
    covariance[:2, :2] = position
    kinematic, further = _crosses(start)
    covariance[:4, :4] += kinematic + kinematic.T
    values = (
        *start.position_m,
        start.yaw_rad or 0.0,
        start.speed_mps,
        start.yaw_rate_radps,
        start.accel_mps2,
    )
    mean = np.array(values, dtype=np.float64)
    x, P = motion.from_kinematic(mean, covariance)
    into_state = np.eye(4)
    if motion.cartesian:
        into_state[2:, 2:] = (
            0.0 if unknown else cartesian_gradient(mean[YAW : SPEED + 1])
        )
    if unknown and motion.cartesian:
        x[2:4] = P[2:4] = P[:, 2:4] = 0.0
        P[2:4, 2:4] = np.eye(2) * (start.speed_std_mps**2 + start.speed_mps**2)
    for name, column in further.items():
        if name not in motion.state_names[4:]:
            raise CallError(
                f"Start: a cross-covariance: the state has no {name}, but {', '.join(motion.state_names)}"
            )
        at = motion.state_names.index(name)
        P[:4, at] = P[at, :4] = into_state @ column
    return x, P


def _crosses(start: Start) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the covariances of a `start` between different entries of the state.

    The first result has the covariances among x, y, yaw and speed, an upper triangle of shape (4, 4). The second result
    has, by name of a further entry of the state, its covariances with x, y, yaw and speed, shape (4,).
    """
    kinematic, further = np.zeros((4, 4)), dict[str, FloatArray]()
    given = (
        (slice(0, 2), start.position_cross),
        (slice(2, 3), start.yaw_cross),
        (slice(3, 4), start.speed_cross),
    )
    for rows, by_name in given:
        for name, values in by_name.items():
            if name in STATE_NAMES[rows.stop : 4]:
                kinematic[rows, STATE_NAMES.index(name)] = values
            else:
                further.setdefault(name, np.zeros(4))[rows] = values
    return kinematic, further
