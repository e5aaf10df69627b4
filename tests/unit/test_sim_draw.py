"""Draws from a motion model."""

import numpy as np

from fgtrack.core.geometry import wrap_angles
from fgtrack.core.types import YAW
from fgtrack.models.motion import CTRV
from fgtrack.sim.draw import drawn

MOTION = CTRV()


def test_draws_have_the_mean_and_the_covariance_of_the_model() -> None:
    x, dt_s, num = np.array([3.0, -2.0, 3.1, 20.0, 0.2]), 0.1, 20_000
    found = drawn(MOTION, np.tile(x, (num, 1)), dt_s, np.random.default_rng(1)) - MOTION.predict(x, dt_s)
    found[:, YAW] = wrap_angles(found[:, YAW])
    Q = MOTION.process_noise(x, dt_s)
    whitened = np.linalg.solve(np.linalg.cholesky(Q), found.T)
    np.testing.assert_allclose(whitened.mean(axis=1), 0.0, atol=5.0 / np.sqrt(num))
    np.testing.assert_allclose(np.cov(whitened), np.eye(5), atol=5.0 * np.sqrt(2.0 / num))
