"""Positions of an object of unknown direction."""

import numpy as np

from fgtrack.core.geometry import rotation
from fgtrack.estimation.base import Measurement, Start

STD_M, PERIOD_NS = 0.3, 50_000_000
START = Start(position_std_m=STD_M, speed_std_mps=40.0)


def position(k: int, x_m: float, y_m: float) -> Measurement:
    return Measurement.of(k * PERIOD_NS, x_m=x_m, y_m=y_m, std=STD_M)


def positions(yaw_rad: float, num: int, speed_mps: float = 30.0) -> list[Measurement]:
    """Of an object that drives straight on; the same but for the direction."""
    rng, found = np.random.default_rng(0), []
    for k in range(1, num + 1):
        offset = np.array(
            [speed_mps * k * PERIOD_NS / 1e9, 0.0]
        ) + STD_M * rng.standard_normal(2)
        found.append(position(k, *(rotation(yaw_rad) @ offset).tolist()))
    return found
