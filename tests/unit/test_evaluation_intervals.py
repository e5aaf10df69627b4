"""Differences and their confidence intervals: closed forms, coverage, the length of correlation."""

import math

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import ttest_rel

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.intervals import (
    correlation_length,
    mean_square,
    paired,
    sums_by_stamp,
    within_run,
)


def mean(sums: FloatArray) -> FloatArray:
    return sums[0] / sums[1]


def rmse_difference(sums: FloatArray) -> FloatArray:
    return np.sqrt(sums[0] / sums[2]) - np.sqrt(sums[1] / sums[2])


def correlated(rng: np.random.Generator, n: int, correlation: float) -> FloatArray:
    """A first-order autoregressive series with variance 1, shape (n,)."""
    start = 20 * math.ceil(1.0 / (1.0 - correlation))
    noise = rng.standard_normal(n + start)
    return np.asarray(
        lfilter([math.sqrt(1.0 - correlation**2)], [1.0, -correlation], noise)[start:]
    )


def test_over_seeds_it_is_the_paired_t_interval() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(0.5, 0.1, 8), rng.normal(0.4, 0.1, 8)
    found = paired(a, b)
    expected = ttest_rel(a, b).confidence_interval(0.95)
    np.testing.assert_allclose(
        (found.mean, found.low, found.high), ((a - b).mean(), *expected), rtol=1e-12
    )
    assert found.count == 8


def test_pairs_with_a_missing_value_are_left_out() -> None:
    assert paired([1.0, math.nan, 3.0, 5.0], [0.0, 2.0, 1.0, math.nan]) == paired(
        [1.0, 3.0], [0.0, 1.0]
    )


def test_one_pair_has_no_interval_and_none_no_mean() -> None:
    one, none = paired([2.0], [1.0]), paired([], [])
    assert one.mean == 1.0
    assert math.isnan(one.low)
    assert not one.is_significant
    assert math.isnan(none.mean)
    assert none.count == 0


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_interval_within_a_run_covers_the_truth_as_often_as_it_says(
    correlation: float,
) -> None:
    rng = np.random.default_rng(2)
    true_difference = math.sqrt(1.25) - math.sqrt(1.49)
    runs, hits, naive = 120, 0, 0
    for _ in range(runs):
        common = correlated(rng, 400, correlation)
        a, b = (
            common + scale * correlated(rng, 400, correlation) for scale in (0.5, 0.7)
        )
        ticks = np.stack([a**2, b**2, np.ones(400)], axis=-1)
        found = within_run(ticks, rmse_difference)
        hits += found.low <= true_difference <= found.high
        shuffled = within_run(rng.permutation(ticks), rmse_difference)
        naive += shuffled.low <= true_difference <= shuffled.high
    assert 0.88 <= hits / runs <= 0.99  # 0.95 within two or three standard errors
    if correlation:
        assert naive / runs < 0.8  # as if the ticks were independent


def test_without_correlation_the_standard_error_is_the_textbook_one() -> None:
    values = np.random.default_rng(3).standard_normal(400)
    found = within_run(np.stack([values, np.ones(400)], axis=-1), mean)
    assert found.mean == pytest.approx(values.mean())
    assert (found.high - found.low) / 2.0 == pytest.approx(
        1.97 * values.std() / 20.0, rel=0.15
    )


def test_sums_are_those_of_each_stamp_without_what_is_not_known() -> None:
    samples = np.array([[1.0, 10.0], [2.0, np.nan], [4.0, 40.0], [8.0, 80.0]])
    assert sums_by_stamp(np.array([7, 7, 3, 7]), samples).tolist() == [
        [4.0, 40.0, 1.0],
        [9.0, 90.0, 2.0],
    ]


def test_the_correlation_length_is_that_of_a_first_order_autoregression() -> None:
    rng = np.random.default_rng(8)
    for rho in (0.0, 0.5, 0.9):
        lengths = [correlation_length(correlated(rng, 1000, rho)) for _ in range(20)]
        assert np.mean(lengths) == pytest.approx((1.0 + rho) / (1.0 - rho), rel=0.25)


def test_the_correlation_of_a_trend_is_as_long_as_the_run() -> None:
    assert correlation_length(np.linspace(0.0, 1.0, 90)) == 90.0
    assert correlation_length(np.ones(90)) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("times", [30, 120, 400])
@pytest.mark.parametrize("samples", [15, 60, 200])
def test_of_twenty_true_ties_one_is_called_a_difference(
    samples: int, times: int
) -> None:
    """At so many samples per correlation time, in a run of so many of these times."""
    rng, n = np.random.default_rng(1), samples * times
    series = (correlated(rng, n, math.exp(-1.0 / samples)) for _ in range(1000))
    share = np.mean(
        [
            within_run(np.stack([x, np.ones(n)], axis=-1), mean).is_significant
            for x in series
        ]
    )
    assert (
        0.03 < share < 0.075
    )  # 5 % within three standard errors, and a bias of half a per cent


def test_a_sum_of_zeros_and_a_short_run_do_no_harm() -> None:
    zeros = np.stack([np.zeros(50), np.ones(50)], axis=-1)
    assert within_run(zeros, mean).high == 0.0
    short = within_run(np.ones((5, 2)), mean)
    assert short.mean == 1.0
    assert not short.is_significant
    assert math.isnan(within_run(np.zeros((0, 2)), mean).mean)


def test_the_interval_of_a_mean_square_is_positive_where_few_blocks_tell_it() -> None:
    squares = np.full(40, 0.1)
    squares[5:9] = 40.0  # one stretch
    ticks = np.stack([squares, np.ones(40)], axis=-1)
    assert within_run(ticks, mean).low < 0.0
    found = mean_square(ticks)
    assert found.mean == pytest.approx(squares.mean())
    assert 0.0 < found.low < found.mean < found.high
    assert mean_square(np.tile([0.0, 1.0], (40, 1))).mean == 0.0
    assert not mean_square(np.tile([0.0, 1.0], (40, 1))).is_known
