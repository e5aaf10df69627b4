"""The default scenario over many seeds, with the paper's noise and with fitted noise.

What keeping late detections wins, what waiting 0.3 s does, and whether the covariances say how large the errors are.
"""

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest

import fgtrack
from fgtrack.evaluation.intervals import paired
from fgtrack.evaluation.metrics import Metrics, evaluate

NUM_SEEDS = 10
LAG_S = 0.3
ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")


@cache
def metrics(config: str) -> Mapping[str, list[Metrics]]:
    """Of every estimator and seed; the fit has seen none of these seeds."""
    return {
        name: [
            evaluate(
                fgtrack.replay(
                    fgtrack.simulate("default", seed=seed),
                    config,
                    map="oval",
                    estimator=name,
                )
            )
            for seed in range(1, NUM_SEEDS + 1)
        ]
        for name in ESTIMATORS
    }


def rmse_m(config: str) -> dict[str, list[float]]:
    return {
        name: [
            one.truth.overall.errors["position_m"].rmse
            for one in found
            if one.truth is not None
        ]
        for name, found in metrics(config).items()
    }


@pytest.mark.slow
@pytest.mark.parametrize(("config", "at_least"), [("smoother", 0.2), ("tuned", 0.05)])
def test_smoother_and_replay_tie_now_and_beat_the_backward_forward_step(
    config: str, at_least: float
) -> None:
    found = rmse_m(config)
    tie = paired(np.log(found["smoother"]), np.log(found["ekf-replay"]))
    assert max(abs(tie.low), abs(tie.high)) < 0.01
    for name in ("smoother", "ekf-replay"):
        assert (
            paired(np.log(found[name]), np.log(found["ekf-backward-forward"])).high
            < -at_least
        )
    assert (
        np.mean(
            [
                one.gain("position_m")
                for run in metrics(config)["smoother"]
                for one in run.lagged[1:2]
            ]
        )
        >= 0.3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smoother", "ekf-replay"])
def test_with_fitted_noise_the_covariances_say_how_large_the_errors_are(
    name: str,
) -> None:
    found = metrics("tuned")[name]
    assert 1.7 <= np.mean([one.consistency.position_nees.mean for one in found]) <= 2.6
    for sensor in ("lidar_cluster", "radar"):
        assert np.mean(
            [
                one.consistency.nis[sensor].mean / one.consistency.nis[sensor].dof
                for one in found
            ]
        ) == (pytest.approx(1.0, abs=0.2))


@pytest.mark.slow
def test_with_the_noise_of_the_paper_they_do_not() -> None:
    assert (
        np.mean(
            [
                one.consistency.position_nees.mean
                for one in metrics("smoother")["smoother"]
            ]
        )
        > 5.0
    )
