"""The first state of a new object."""

import numpy as np

from fgtrack.core.errors import CallError
from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import KNOWN_YAW_STD_RAD, UNKNOWN_YAW_STD_RAD, Start
from fgtrack.models.motion import MotionModel


def initial_state(motion: MotionModel, start: Start) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n), in the state of `motion`, of `start`.

    Without a direction of travel, a Cartesian velocity is isotropic with mean zero, a yaw 0 with a wide standard
    deviation. Raises `CallError` for a `position_cross` with an entry that the state lacks.
    """
    position = np.eye(2) * start.position_std_m**2
    if start.position_covariance is not None:
        position = symmetrise(np.asarray(start.position_covariance, dtype=np.float64))
    unknown = start.yaw_rad is None
    yaw_std_rad = start.yaw_std_rad
    if yaw_std_rad is None:
        yaw_std_rad = UNKNOWN_YAW_STD_RAD if unknown else KNOWN_YAW_STD_RAD
    std = 0.0, 0.0, yaw_std_rad, start.speed_std_mps, start.yaw_rate_std_radps, start.accel_std_mps2
    covariance = np.diag(np.square(std))
    covariance[:2, :2] = position
    values = *start.position_m, start.yaw_rad or 0.0, start.speed_mps, start.yaw_rate_radps, start.accel_mps2
    x, P = motion.from_kinematic(np.array(values, dtype=np.float64), covariance)
    if unknown and motion.cartesian:
        x[2:4] = P[2:4] = P[:, 2:4] = 0.0
        P[2:4, 2:4] = np.eye(2) * (start.speed_std_mps**2 + start.speed_mps**2)
    for name, pair in start.position_cross.items():
        if name not in motion.state_names:
            raise CallError(f"Start: position_cross: the state has no {name}, but {', '.join(motion.state_names)}")
        P[:2, motion.state_names.index(name)] = P[motion.state_names.index(name), :2] = pair
    return x, P
