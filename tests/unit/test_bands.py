"""Many values are drawn as the bands of their quantiles."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from fgtrack.show.figures.bands import MOST_DOTS, draw_values, quantile_bands, thinned
from fgtrack.show.figures.errors import moving_rms


def test_the_bands_are_the_quantiles_of_the_values_in_each_interval():
    rng = np.random.default_rng(0)
    x = np.repeat(np.arange(300.0), 101)
    y = np.concatenate([rng.permutation(101) + 1000.0 * k for k in range(300)])
    shuffled = rng.permutation(len(x))
    middles, bands = quantile_bands(x[shuffled], y[shuffled])
    expected = np.array([5.0, 25.0, 50.0, 75.0, 95.0])[:, None]
    np.testing.assert_array_equal(bands, expected + 1000.0 * np.arange(300))
    assert middles[0] == pytest.approx(0.5 * 299 / 300)


def test_an_interval_without_values_is_a_gap_and_unknown_values_do_not_count():
    x = np.array([0.0, 0.0, 100.0, 50.0])
    _, bands = quantile_bands(x, np.array([1.0, 1.0, 3.0, np.nan]))
    assert np.isnan(bands).all(axis=0).sum() == 298
    assert bands[2, [0, -1]].tolist() == [1.0, 3.0]


def test_few_values_are_dots_and_many_are_bands():
    for count, dots in ((MOST_DOTS, MOST_DOTS), (MOST_DOTS + 1, 300)):
        axes = Figure().subplots()
        values = np.arange(float(count))
        draw_values(axes, values, values, "black", "radar")
        [line] = axes.lines
        assert len(line.get_xdata()) == dots
        assert ("50 and 90 %" in line.get_label()) == (dots == 300)
        assert len(axes.collections) == (2 if dots == 300 else 0)


def test_a_thinned_line_keeps_its_ends():
    assert thinned(5).tolist() == [0, 1, 2, 3, 4]
    rows = thinned(1_000_000)
    assert (len(rows), rows[0], rows[-1]) == (3000, 0, 999_999)
    assert (np.diff(rows) > 0).all()


def test_the_moving_error_of_a_long_run_uses_every_value_of_its_window():
    stamps_ns = np.arange(10_000) * 10
    values = np.random.default_rng(1).normal(size=10_000)
    at_ns, rms = moving_rms(stamps_ns, values, 2000)
    assert len(at_ns) == 3000
    k = 1500
    inside = (stamps_ns >= at_ns[k] - 1000) & (stamps_ns <= at_ns[k] + 1000)
    assert rms[k] == pytest.approx(np.sqrt(np.mean(values[inside] ** 2)), rel=1e-9)
