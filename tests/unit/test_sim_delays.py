import numpy as np
import pytest
from scipy import stats

from fgtrack.core.types import BoolArray, FloatArray, IntArray
from fgtrack.sim.delays import (
    AnyDelay,
    ConstantDelay,
    GammaDelay,
    LossyDelay,
    MarkovDelay,
    MarkovTimeDelay,
    NoDelay,
    UniformDelay,
    draw_delays,
)

STAMPS_S = np.arange(20_000) / 20.0
LIDAR = GammaDelay(min_s=0.09, mean_s=0.151, q90_s=0.191)
RADAR = GammaDelay(min_s=0.03, mean_s=0.062, q90_s=0.089)
ALL = (
    NoDelay(),
    ConstantDelay(0.1),
    UniformDelay(0.1, 0.3),
    LIDAR,
    RADAR,
    LossyDelay(0.1, base=RADAR),
    MarkovDelay(RADAR, LossyDelay(0.7, base=LIDAR), to_bad=0.05, to_good=0.2),
    MarkovTimeDelay(RADAR, UniformDelay(0.1, 0.5), to_bad_per_s=0.5, to_good_per_s=2.0),
)


def drawn(model: AnyDelay, seed: int = 0) -> FloatArray:
    return draw_delays(model, np.random.default_rng(seed), STAMPS_S)


@pytest.mark.parametrize("model", ALL, ids=lambda model: model.kind)
def test_delays_are_one_per_message_never_negative_and_the_same_for_the_same_seed(
    model: AnyDelay,
) -> None:
    delays = drawn(model)
    assert delays.shape == STAMPS_S.shape
    assert np.nanmin(delays) >= 0.0
    np.testing.assert_array_equal(delays, drawn(model))
    assert draw_delays(model, np.random.default_rng(0), np.empty(0)).shape == (0,)


@pytest.mark.parametrize(
    "model", [LIDAR, RADAR, GammaDelay(0.0, 0.1, 0.27), GammaDelay(0.0, 0.1, 0.1003)]
)
def test_a_gamma_delay_has_exactly_the_mean_and_quantile_it_was_given(
    model: GammaDelay,
) -> None:
    distribution = stats.gamma(model.shape, loc=model.min_s, scale=model.scale_s)
    assert distribution.mean() == pytest.approx(model.mean_s, abs=1e-9)
    assert distribution.ppf(0.9) == pytest.approx(model.q90_s, abs=1e-9)


@pytest.mark.parametrize(
    ("model", "distribution"),
    [
        (UniformDelay(0.1, 0.3), stats.uniform(0.1, 0.2)),
        (LIDAR, stats.gamma(LIDAR.shape, loc=0.09, scale=LIDAR.scale_s)),
        (RADAR, stats.gamma(RADAR.shape, loc=0.03, scale=RADAR.scale_s)),
    ],
    ids=lambda value: getattr(value, "kind", ""),
)
def test_delays_follow_their_distribution(
    model: AnyDelay, distribution: stats.rv_continuous
) -> None:
    assert stats.kstest(drawn(model), distribution.cdf).pvalue > 1e-4


def test_a_lossy_delay_loses_its_share_and_leaves_the_others_alone() -> None:
    delays = drawn(LossyDelay(0.1, base=RADAR))
    lost = np.isnan(delays)
    assert stats.binomtest(int(lost.sum()), len(lost), 0.1).pvalue > 1e-4
    np.testing.assert_array_equal(delays[~lost], drawn(RADAR)[~lost])
    assert np.isnan(drawn(LossyDelay(1.0))).all()


GOOD, BAD = ConstantDelay(0.1), ConstantDelay(0.5)


def runs(bad: BoolArray) -> IntArray:
    """Lengths of the bursts, without those at either end."""
    edges = np.flatnonzero(np.diff(bad.astype(int)))
    return np.diff(edges)[bad[edges[:-1] + 1]]


@pytest.mark.parametrize(("to_bad", "to_good"), [(0.05, 0.2), (0.9, 0.6)])
def test_a_chain_is_bad_as_often_and_as_long_as_its_probabilities_say(
    to_bad: float, to_good: float
) -> None:
    model = MarkovDelay(GOOD, BAD, to_bad, to_good)
    bad = drawn(model) == 0.5
    share, memory = to_bad / (to_bad + to_good), 1.0 - to_bad - to_good
    # Messages k apart correlate with memory^k, hence the variance of their mean.
    variance = share * (1.0 - share) * (1.0 + memory) / (1.0 - memory) / len(bad)
    assert bad.mean() == pytest.approx(share, abs=4.0 * np.sqrt(variance))
    lengths = runs(bad)
    assert lengths.mean() == pytest.approx(
        1.0 / to_good, abs=4.0 * np.sqrt((1.0 - to_good) / len(lengths)) / to_good
    )
    # Geometric, not only in the mean; long bursts in one class, so that each has enough of them.
    longest = int(stats.geom(to_good).isf(50.0 / len(lengths))) + 1
    found = np.bincount(np.minimum(lengths, longest), minlength=longest + 1)[1:]
    chances = np.append(
        stats.geom(to_good).pmf(np.arange(1, longest)),
        stats.geom(to_good).sf(longest - 1),
    )
    assert stats.chisquare(found, chances * len(lengths)).pvalue > 1e-4


@pytest.mark.parametrize("rate_hz", [5.0, 200.0])
def test_a_chain_in_time_is_the_same_however_often_it_is_looked_at(
    rate_hz: float,
) -> None:
    to_bad, to_good, count = 0.5, 2.0, 40_000
    model = MarkovTimeDelay(GOOD, BAD, to_bad, to_good)
    bad = (
        draw_delays(model, np.random.default_rng(3), np.arange(count) / rate_hz) == 0.5
    )
    memory = np.exp(-(to_bad + to_good) / rate_hz)
    variance = 0.2 * 0.8 * (1.0 + memory) / (1.0 - memory) / count
    assert bad.mean() == pytest.approx(0.2, abs=4.0 * np.sqrt(variance))
    leave = 0.8 * (1.0 - memory)  # P(good | bad) from one look to the next
    lengths = runs(bad)
    assert lengths.mean() == pytest.approx(
        1.0 / leave, abs=4.0 * np.sqrt((1.0 - leave) / len(lengths)) / leave
    )
    if (
        rate_hz == 200.0
    ):  # often enough to see a burst from its beginning to its end: 1 / to_good on average
        assert lengths.mean() / rate_hz == pytest.approx(
            1.0 / to_good, abs=4.0 * 0.5 / np.sqrt(len(lengths))
        )


def test_a_chain_in_time_forgets_over_a_gap_and_stays_at_equal_stamps() -> None:
    model = MarkovTimeDelay(GOOD, BAD, 1.0, 1.0)
    pairs = np.array(
        [
            draw_delays(model, np.random.default_rng(seed), np.array([0.0, 0.0, 1e6]))
            for seed in range(400)
        ]
    )
    np.testing.assert_array_equal(pairs[:, 0], pairs[:, 1])
    assert (
        stats.binomtest(int((pairs[:, 1] == pairs[:, 2]).sum()), 400, 0.5).pvalue > 1e-4
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantDelay(delay_s=float("nan")), "delay_s"),
        (lambda: UniformDelay(min_s=0.2, max_s=-0.1), "max_s"),
        (
            lambda: UniformDelay(min_s=0.08, max_s=1e-9),
            "max_s: must not be below min_s, is 1e-09",
        ),
        (lambda: GammaDelay(0.1, 0.1, 0.2), "mean_s"),
        (lambda: GammaDelay(0.1, 0.2, 0.2), "q90_s: no gamma distribution"),
        (lambda: LossyDelay(probability=-0.1), "probability"),
        (lambda: MarkovDelay(GOOD, BAD, to_bad=0.5, to_good=0.0), "to_good"),
        (
            lambda: MarkovTimeDelay(GOOD, BAD, to_bad_per_s=1.0, to_good_per_s=0.0),
            "to_good_per_s",
        ),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]
