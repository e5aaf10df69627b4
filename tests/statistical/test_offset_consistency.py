"""Estimated clock offsets miss the truth by what their covariance says."""

import numpy as np
import pytest
from scipy.stats import chi2
from support.shiftable import MOTION, Eye, World

from fgtrack.estimation.factor_graph.clock_calibration.offsets import OffsetSettings, solve_offsets

TRUE_S = 0.04


@pytest.mark.parametrize("num_runs", [8, pytest.param(60, marks=pytest.mark.slow)])
def test_the_covariance_covers_the_error_and_the_error_has_no_bias(num_runs: int) -> None:
    world = World({"a": Eye(), "b": Eye(TRUE_S, phase_s=0.03)}, duration_s=2.5)
    settings = OffsetSettings(prior_std_s=0.1)
    scaled = []
    for seed in range(num_runs):
        rng = np.random.default_rng([7, seed])
        found = solve_offsets(MOTION, [world.measurements(rng)], {"b": 0.0}, settings)
        assert found.converged.all()
        scaled.append((found.offsets_s[0] - TRUE_S) / np.sqrt(found.covariance[0, 0]))
    low, high = chi2.ppf([0.005, 0.995], num_runs)
    assert low < np.sum(np.square(scaled)) < high
    assert abs(np.mean(scaled)) < 3.0 / np.sqrt(num_runs)
