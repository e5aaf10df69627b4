"""The ladder of out-of-sequence methods against what an earlier implementation gave.

The scenario, and what of it had to be found out, is told in `experiments/ladder/ladder.py`.
"""

from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2
from support.scripts import load

SEED = 1
ROUNDING_M, ROUNDING_ANEES = (
    0.001,
    0.01,
)  # of a difference of two entries of the reference
CONSISTENT = (
    "ekf-replay",
    "rts",
    "zlz",
    "asd",
    "drop",
    "delayed-horizon",
    "reorder-buffer",
    "rewind-forget",
)

script = load("ladder")


@pytest.fixture(
    scope="module",
    params=[24, pytest.param(400, marks=pytest.mark.slow)],
    ids=lambda runs: f"{runs} runs",
)
def ladder(request: pytest.FixtureRequest) -> dict[int, dict[str, Any]]:
    """Samples by lag and method."""
    return {
        lag: script.measured(lag, request.param, SEED) for lag in script.REFERENCE_LAGS
    }


@pytest.mark.parametrize("lag", script.REFERENCE_LAGS)
@pytest.mark.parametrize(
    "name", [name for name in script.REFERENCE if name != "ekf-replay"]
)
def test_so_is_the_distance_to_the_replay_in_which_the_common_noise_cancels(
    ladder, name: str, lag: int
) -> None:
    found, replay = ladder[lag][name], ladder[lag]["ekf-replay"]
    place = script.REFERENCE_LAGS.index(lag)
    (rmse_m, anees), (replay_m, replay_anees) = (
        script.REFERENCE[name][place],
        script.REFERENCE["ekf-replay"][place],
    )
    part = np.sqrt(1.0 / len(found.nees) + 1.0 / script.REFERENCE_RUNS)
    error_m = (
        part
        * np.std(found.squared_m2 - replay.squared_m2)
        / (found.rmse_m + replay.rmse_m)
    )
    error = part * np.std(found.nees - replay.nees)
    assert (
        abs(found.rmse_m - replay.rmse_m - (rmse_m - replay_m))
        < 3.0 * error_m + ROUNDING_M
    )
    assert (
        abs(found.anees - replay.anees - (anees - replay_anees))
        < 3.0 * error + ROUNDING_ANEES
    )


@pytest.mark.parametrize("lag", script.REFERENCE_LAGS)
@pytest.mark.parametrize("name", CONSISTENT)
def test_a_consistent_method_is_as_sure_as_it_should_be(
    ladder, name: str, lag: int
) -> None:
    nees = ladder[lag][name].nees
    low, high = chi2.ppf([0.0005, 0.9995], 2 * len(nees))
    assert low < nees.sum() < high
