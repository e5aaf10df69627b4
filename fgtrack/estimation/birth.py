"""The first state of a new object."""

import numpy as np

from fgtrack.core.linalg import symmetrise
from fgtrack.core.types import ACCEL, SPEED, YAW, YAW_RATE, FloatArray
from fgtrack.estimation.base import Start
from fgtrack.models.motion import MotionModel


def initial_state(motion: MotionModel, prior: Start) -> tuple[FloatArray, FloatArray]:
    """Mean (n,) and covariance (n, n), in the state of `motion`, of what `prior` knows.

    Where the direction of travel is unknown, a Cartesian model starts with an isotropic velocity of mean zero; a
    model with a yaw starts at yaw 0 with the prior's (wide) deviation.
    """
    mean = np.zeros(6)
    mean[:2] = prior.position_m
    mean[YAW] = 0.0 if prior.yaw_rad is None else prior.yaw_rad
    mean[SPEED], mean[YAW_RATE], mean[ACCEL] = prior.speed_mps, prior.yaw_rate_radps, prior.accel_mps2
    deviations = np.array(
        [0.0, 0.0, prior.yaw_std_rad, prior.speed_std_mps, prior.yaw_rate_std_radps, prior.accel_std_mps2]
    )
    covariance = np.diag(deviations**2)
    covariance[:2, :2] = symmetrise(prior.position_covariance)
    if prior.yaw_rad is None and motion.linear:
        spread = np.zeros((motion.dim, motion.dim))
        spread[:2, :2] = covariance[:2, :2]
        spread[2:, 2:] = np.eye(motion.dim - 2) * (prior.speed_std_mps**2 + prior.speed_mps**2)
        start = np.zeros(motion.dim)
        start[:2] = prior.position_m
        return start, spread
    return motion.from_kinematic(mean, covariance)
