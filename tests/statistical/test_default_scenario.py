"""The default scenario over many seeds: what keeping late detections wins, and what waiting 0.3 s does."""

from dataclasses import replace

import numpy as np
import pytest

from fgtrack.evaluation.lagged import LagMetrics
from fgtrack.evaluation.metrics import evaluate
from fgtrack.pipeline.replay import replay_in_memory
from fgtrack.pipeline.shipped import read_config, read_scenario
from fgtrack.sim.simulate import simulate

NUM_SEEDS = 20
LAG_S = 0.3


def by_lag(seed: int, estimator: str) -> dict[float, LagMetrics]:
    config = replace(read_config("smoother", track_map="oval", pit_map="oval"), estimator=estimator)
    run, broken = replay_in_memory(simulate(read_scenario("default"), np.random.default_rng(seed)), config)
    assert broken is None
    return {found.lag_s: found for found in evaluate(run).lagged}


@pytest.mark.slow
def test_smoother_and_replay_tie_now_and_beat_the_backward_forward_step() -> None:
    runs = {
        name: [by_lag(seed, name) for seed in range(NUM_SEEDS)]
        for name in ("smoother", "ekf-replay", "ekf-backward-forward")
    }
    smoother_m, replay_m, wiping_m = (
        np.mean([run[0.0].errors["position_m"].rmse for run in found]) for found in runs.values()
    )
    assert smoother_m <= 1.01 * replay_m
    assert max(smoother_m, replay_m) <= 0.75 * wiping_m
    assert np.mean([run[LAG_S].gain("position_m") for run in runs["smoother"]]) >= 0.3
