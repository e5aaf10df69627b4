"""A motion model."""

from dataclasses import dataclass

import numpy as np

from fgtrack import MotionModel


@dataclass(frozen=True)
class Acceleration(MotionModel):
    """Constant acceleration along both axes, driven by white noise jerk."""

    jerk_density_m2ps5: float = 1.0

    state_names = ("x_m", "y_m", "vx_mps", "vy_mps", "ax_mps2", "ay_mps2")
    linear = True

    def predict(self, x, dt_s):
        return (self.jacobian(x, dt_s) @ x[..., None])[..., 0]

    def jacobian(self, x, dt_s):
        t = self.durations(x, dt_s)
        return np.eye(6) + t * np.eye(6, k=2) + t**2 / 2 * np.eye(6, k=4)

    def process_noise(self, x, dt_s):
        t = self.durations(x, self.forward(dt_s))
        rows = [[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]]
        Q = np.concatenate([np.concatenate([part * np.eye(2) for part in row], axis=-1) for row in rows], axis=-2)
        return self.jerk_density_m2ps5 * Q

    def durations(self, x, dt_s):
        return np.broadcast_to(dt_s, np.broadcast_shapes(x.shape[:-1], np.shape(dt_s)))[..., None, None]
