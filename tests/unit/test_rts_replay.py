"""The replaying EKF with a smoothing pass over its window."""

import numpy as np
import pytest
from support.oosm import LAG_S, LINEAR, STEP_S, in_sequence, measured, prior, stamp

import fgtrack
from fgtrack.estimation.registry import estimator
from fgtrack.models.motion import CTRV
from fgtrack.testing.references import dense_joint


def test_states_of_the_past_are_the_joint_posterior_with_a_late_measurement() -> None:
    rng = np.random.default_rng(1)
    late = measured(rng, 0.75, std=0.2)
    received = [*in_sequence(rng), late]
    one = estimator("ekf-rts", LINEAR, prior(), lag_s=LAG_S)
    for each in received:
        one.update(each)
    stamps = [stamp(at_s) for at_s in (0.3, 0.72, 0.75, 1.0, 2.0, 2.3)]
    exact = dense_joint(LINEAR, prior(), received, stamps)
    for stamp_ns in stamps:
        state = one.state_at(stamp_ns)
        np.testing.assert_allclose(state.mean, exact[stamp_ns].mean, atol=1e-8)
        np.testing.assert_allclose(
            state.covariance, exact[stamp_ns].covariance, rtol=1e-7, atol=1e-12
        )


def test_the_newest_state_is_that_of_the_filter() -> None:
    rng = np.random.default_rng(2)
    received = [*in_sequence(rng, CTRV()), measured(rng, 0.55, CTRV())]
    both = [
        estimator(name, CTRV(), prior(), lag_s=LAG_S)
        for name in ("ekf-rts", "ekf-replay")
    ]
    for one in both:
        for each in received:
            one.update(each)
    newest, past = stamp(2.0), stamp(2.0 - 3.0 * STEP_S)
    smoothed, filtered = (one.state_at(newest) for one in both)
    np.testing.assert_allclose(smoothed.mean, filtered.mean, atol=1e-9)
    smoothed, filtered = (one.state_at(past).covariance[0, 0] for one in both)
    assert smoothed < 0.9 * filtered


def test_a_run_publishes_lagged_states_of_both_filters() -> None:
    messages = list(fgtrack.simulate("single_opponent", seed=1, duration_s=4.0))
    runs = {
        name: fgtrack.replay(
            messages,
            "smoother",
            estimator=name,
            map="oval",
            set={"options.ekf-replay.lagged_s": 0.3},
        )
        for name in ("ekf-replay", "ekf-rts", "smoother-banded")
    }
    rmse_m = {}
    for name, run in runs.items():
        assert set(run.lagged["lag_s"]) == {0.3}
        [lag] = [each for each in fgtrack.evaluate(run).lagged if each.lag_s == 0.3]
        rmse_m[name] = lag.errors["position_m"].rmse
    assert rmse_m["ekf-rts"] == pytest.approx(rmse_m["smoother-banded"], rel=0.03)
    assert rmse_m["ekf-rts"] < 0.95 * rmse_m["ekf-replay"]


def test_a_lag_beyond_the_window_is_refused() -> None:
    for name in ("ekf-replay", "ekf-rts"):
        with pytest.raises(fgtrack.CallError, match="lagged_s: must lie between"):
            estimator(name, LINEAR, prior(), lag_s=0.5, lagged_s=[0.6])
