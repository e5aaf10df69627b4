"""Changes along a recording: a line or a step in the estimates of its parts."""

import numpy as np
import pytest

from fgtrack.advice.changes import PartEstimate, change_of


def estimates(values, std=0.002):
    return [
        PartEstimate(30.0 + 300.0 * k, float(value), std)
        for k, value in enumerate(values)
    ]


def scatter(seed, count=12):
    return np.random.default_rng(seed).normal(0.0, 0.002, count)


def test_a_drift_is_a_line_and_reaches_the_tolerance_at_its_share_of_the_time():
    change = change_of(estimates(scatter(0) + np.linspace(0.0, 0.04, 12)), 0.01)
    assert change is not None
    assert not change.is_step
    assert change.size == pytest.approx(0.04, abs=change.half)
    assert change.from_s == pytest.approx(30.0 + 3300.0 / 4.0, rel=0.15)


@pytest.mark.parametrize("first", [1, 4, 7, 11])
def test_a_step_lies_between_the_parts_before_and_after_it(first):
    values = scatter(first)
    values[first:] -= 0.035
    change = change_of(estimates(values), 0.01)
    assert change is not None
    assert change.is_step
    assert change.size == pytest.approx(-0.035, abs=max(change.half, 0.006))
    assert (change.from_s, change.until_s) == (
        300.0 * first - 270.0,
        300.0 * first + 30,
    )


def test_errors_that_are_common_to_all_parts_hide_no_change():
    values = 0.5 + scatter(3)
    values[7:] += 0.035
    change = change_of(estimates(values, std=0.05), 0.01)
    assert change is not None
    assert change.from_s == 30.0 + 6 * 300.0


def test_few_parts_and_changes_below_the_tolerance_are_no_findings():
    assert change_of(estimates([0.0, 0.0, 0.04, 0.04]), 0.01) is None
    assert change_of([], 0.01) is None
    values = scatter(5) + np.linspace(0.0, 0.008, 12)
    assert change_of(estimates(values), 0.02) is None


@pytest.mark.parametrize("count", [5, 12])
def test_scatter_alone_is_rarely_a_change(count):
    found = [
        change_of(estimates(scatter(seed, count)), 0.0) is not None
        for seed in range(1000)
    ]
    # At most 2 x 0.0005 for each of the `count` shapes.
    assert sum(found) <= 1000 * 0.001 * count + 3.0 * np.sqrt(count)
