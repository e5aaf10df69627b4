"""How certain a clock offset against the truth is, where few stretches of the recording tell it."""

import numpy as np
import pytest
from scipy.special import stdtrit

from fgtrack.pipeline.truth_offsets import _solved

PERIOD_NS = 50_000_000
STRETCH = 100
"""Samples in a stretch of 5 s."""


def recording(rng: np.random.Generator, offset_s: float = 0.0) -> tuple[float, float, float]:
    """A minute of an object that drives ahead, overtaken in four stretches; errors of positions last for a second."""
    count = 12 * STRETCH
    overtaking = np.zeros(count)
    for place, speed_mps in ((1, 10.0), (4, -8.0), (7, 6.0), (10, -9.0)):
        overtaking[place * STRETCH : (place + 1) * STRETCH] = speed_mps
    g = np.stack([overtaking, np.zeros(count)], axis=-1)
    ways = np.tile([1.0, 0.0], (count, 1))
    r = np.repeat(rng.normal(0.0, 0.5, (count // 20, 2)), 20, axis=0) - g * offset_s
    stamps_ns = 5_000_000_000 * 7 + np.arange(count) * PERIOD_NS
    return _solved(r, g, ways, stamps_ns)[:3]


def test_an_interval_of_the_offset_holds_it_as_often_as_it_says() -> None:
    rng = np.random.default_rng(1)
    found = np.array([recording(rng) for _ in range(400)])
    z, dof = np.abs(found[:, 0]) / found[:, 1], found[:, 2]
    assert (dof < 4.0).all(), "four stretches tell it"
    missed = float((z > stdtrit(dof, 0.995)).mean())
    assert missed < 0.01 + 3.0 * np.sqrt(0.01 * 0.99 / 400)
    assert float((z > 4.0).mean()) > 0.01, "four standard deviations would not do"


def test_an_offset_is_found_where_the_speed_changes() -> None:
    offset_s, std_s, dof = recording(np.random.default_rng(2), 0.5)
    assert abs(offset_s - 0.5) < std_s * stdtrit(dof, 0.995) < 0.5


def test_a_bias_is_of_the_frame_in_which_it_stays() -> None:
    rng = np.random.default_rng(3)
    yaw_rad = np.linspace(0.0, 3.0, 12 * STRETCH)
    ego, vehicle = np.stack([np.cos(yaw_rad), np.sin(yaw_rad)], axis=-1), np.tile([1.0, 0.0], (len(yaw_rad), 1))
    g = 10.0 * np.stack([np.sin(5.0 * yaw_rad), np.cos(3.0 * yaw_rad)], axis=-1)
    stamps_ns = np.arange(len(yaw_rad)) * PERIOD_NS
    for true, other in ((ego, vehicle), (vehicle, ego)):
        r = rng.normal(0.0, 0.3, (len(yaw_rad), 2)) - 1.5 * true
        found = _solved(r, g, true, stamps_ns)
        assert found.bias_m == pytest.approx((1.5, 0.0), abs=0.1)
        assert max(found.bias_std_m) < 0.05
        assert found.cost < 0.8 * _solved(r, g, other, stamps_ns).cost
