import numpy as np
import pytest
from scipy import stats

from fgtrack.core.types import FloatArray
from fgtrack.sim.delays import (
    AnyDelay,
    BurstDelay,
    ConstantDelay,
    GammaDelay,
    LossyDelay,
    NoDelay,
    NormalDelay,
    UniformDelay,
)

STAMPS_S = np.arange(20_000) / 20.0
LIDAR = GammaDelay(min_s=0.09, mean_s=0.151, q90_s=0.191)
RADAR = GammaDelay(min_s=0.03, mean_s=0.062, q90_s=0.089)
ALL = (
    NoDelay(),
    ConstantDelay(0.1),
    UniformDelay(0.1, 0.3),
    NormalDelay(0.02, 0.05),
    LIDAR,
    RADAR,
    BurstDelay(0.01, 0.5, 1.0, base=LIDAR),
    LossyDelay(0.1, base=RADAR),
)


def drawn(model: AnyDelay, seed: int = 0) -> FloatArray:
    return model.draw(np.random.default_rng(seed), STAMPS_S)


@pytest.mark.parametrize("model", ALL, ids=lambda model: model.kind)
def test_delays_are_one_per_message_never_negative_and_the_same_for_the_same_seed(model: AnyDelay) -> None:
    delays = drawn(model)
    assert delays.shape == STAMPS_S.shape
    assert np.nanmin(delays) >= 0.0
    np.testing.assert_array_equal(delays, drawn(model))
    assert model.draw(np.random.default_rng(0), np.empty(0)).shape == (0,)


@pytest.mark.parametrize("model", [LIDAR, RADAR, GammaDelay(0.0, 0.1, 0.27), GammaDelay(0.0, 0.1, 0.1003)])
def test_a_gamma_delay_has_exactly_the_mean_and_quantile_it_was_given(model: GammaDelay) -> None:
    distribution = stats.gamma(model.shape, loc=model.min_s, scale=model.scale_s)
    assert distribution.mean() == pytest.approx(model.mean_s, abs=1e-9)
    assert distribution.ppf(0.9) == pytest.approx(model.q90_s, abs=1e-9)


@pytest.mark.parametrize(
    ("model", "distribution"),
    [
        (UniformDelay(0.1, 0.3), stats.uniform(0.1, 0.2)),
        (NormalDelay(0.02, 0.05), stats.truncnorm(-0.4, np.inf, loc=0.02, scale=0.05)),
        (LIDAR, stats.gamma(LIDAR.shape, loc=0.09, scale=LIDAR.scale_s)),
        (RADAR, stats.gamma(RADAR.shape, loc=0.03, scale=RADAR.scale_s)),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_delays_follow_their_distribution(model: AnyDelay, distribution: stats.rv_continuous) -> None:
    assert stats.kstest(drawn(model), distribution.cdf).pvalue > 1e-4


def test_in_a_burst_everything_is_late_and_outside_nothing() -> None:
    duration_s, probability = 0.5, 0.01
    late = drawn(BurstDelay(probability, duration_s, 1.0, base=ConstantDelay(0.1))) > 0.5
    ends = np.flatnonzero(np.diff(late.astype(int)))
    lengths = np.diff(ends)[::2] if late[ends[0] + 1] else np.diff(ends)[1::2]
    # At 20 Hz a burst takes 10 messages; one that starts when another ends makes a run of 20, and so on.
    assert set(lengths % 10) == {0}
    # Each message outside a burst starts one: bursts take 10 p of the messages for every one outside.
    expected = 10.0 * probability / (1.0 - probability + 10.0 * probability)
    assert late.mean() == pytest.approx(expected, abs=5.0 * np.sqrt(expected * 10.0 / len(late)))


def test_a_lossy_delay_loses_its_share_and_leaves_the_others_alone() -> None:
    delays = drawn(LossyDelay(0.1, base=RADAR))
    lost = np.isnan(delays)
    assert stats.binomtest(int(lost.sum()), len(lost), 0.1).pvalue > 1e-4
    np.testing.assert_array_equal(delays[~lost], drawn(RADAR)[~lost])
    assert np.isnan(drawn(LossyDelay(1.0))).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantDelay(-0.1), r"delay_s: must not be negative, is -0\.1"),
        (lambda: ConstantDelay(float("nan")), "delay_s"),
        (lambda: UniformDelay(-0.1, 0.1), "min_s"),
        (lambda: UniformDelay(0.2, 0.1), "max_s"),
        (lambda: NormalDelay(0.1, 0.0), "std_s"),
        (lambda: NormalDelay(-0.1, 0.1), "mean_s"),
        (lambda: GammaDelay(0.1, 0.1, 0.2), "mean_s"),
        (lambda: GammaDelay(0.1, 0.2, 0.2), "q90_s: no gamma fits"),
        (lambda: GammaDelay(0.0, 0.1, 0.3), "q90_s: no gamma fits"),
        (lambda: BurstDelay(1.1, 1.0, 1.0), "probability"),
        (lambda: BurstDelay(0.1, 0.0, 1.0), "duration_s"),
        (lambda: BurstDelay(0.1, 1.0, -1.0), "extra_s"),
        (lambda: LossyDelay(-0.1), "probability"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]
