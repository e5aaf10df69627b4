"""Fit of a clock offset: its interval where few stretches of the recording determine it, and the bias beside it."""

import numpy as np
import pytest
from scipy.special import stdtrit

from fgtrack.clocks.offsets import _Fit, _solved
from fgtrack.clocks.paths import EgoPath
from fgtrack.core.geometry import rotations
from fgtrack.core.types import EgoState, FloatArray, IntArray

PERIOD_NS = 50_000_000
STRETCH = 100
"""Samples in a stretch of 5 s."""


def solved(
    r: FloatArray, g: FloatArray, yaws_rad: FloatArray, stamps_ns: IntArray
) -> _Fit:
    return _solved(
        r, np.concatenate([g[:, :, None], rotations(yaws_rad)], axis=2), stamps_ns
    )


def recording(
    rng: np.random.Generator, offset_s: float = 0.0
) -> tuple[float, float, float]:
    """A minute of an object that drives ahead, overtaken in four stretches; errors of positions last for a second."""
    count = 12 * STRETCH
    overtaking = np.zeros(count)
    for place, speed_mps in ((1, 10.0), (4, -8.0), (7, 6.0), (10, -9.0)):
        overtaking[place * STRETCH : (place + 1) * STRETCH] = speed_mps
    g = np.stack([overtaking, np.zeros(count)], axis=-1)
    r = np.repeat(rng.normal(0.0, 0.5, (count // 20, 2)), 20, axis=0) - g * offset_s
    stamps_ns = 5_000_000_000 * 7 + np.arange(count) * PERIOD_NS
    found = solved(r, g, np.zeros(count), stamps_ns)
    return found.x[0], found.std[0], found.dof


@pytest.mark.slow
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
    ego, vehicle = yaw_rad, np.zeros(len(yaw_rad))
    g = 10.0 * np.stack([np.sin(5.0 * yaw_rad), np.cos(3.0 * yaw_rad)], axis=-1)
    stamps_ns = np.arange(len(yaw_rad)) * PERIOD_NS
    for true, other in ((ego, vehicle), (vehicle, ego)):
        r = rng.normal(0.0, 0.3, (len(yaw_rad), 2)) - 1.5 * rotations(true)[:, :, 0]
        found = solved(r, g, true, stamps_ns)
        assert found.x[1:] == pytest.approx((1.5, 0.0), abs=0.1)
        assert max(found.std[1:]) < 0.05
        assert found.cost < 0.8 * solved(r, g, other, stamps_ns).cost


def test_the_path_of_the_ego_does_not_move_with_the_noise_of_its_states() -> None:
    rng = np.random.default_rng(0)
    times_s = 0.01 * np.arange(1000)
    yaws_rad = 2.5 + 0.25 * times_s
    positions_m = 200.0 * np.stack([np.sin(yaws_rad), -np.cos(yaws_rad)], axis=-1)
    states = [
        EgoState(
            k * 10_000_000,
            k * 10_000_000,
            x,
            y,
            float(np.arctan2(np.sin(yaw), np.cos(yaw))),
            50.0,
        )
        for k, ((x, y), yaw) in enumerate(
            zip(positions_m + rng.normal(0.0, 0.02, (1000, 2)), yaws_rad, strict=True)
        )
    ]
    ego = EgoPath(reversed(states))
    poses = ego(np.array([1_234_000_000, 5_000_000_000, 20_000_000_000]))
    yaw_rad = 2.5 + 0.25 * 1.234
    assert poses[0] == pytest.approx(
        [200.0 * np.sin(yaw_rad), -200.0 * np.cos(yaw_rad), yaw_rad], abs=0.02
    )
    assert np.isnan(poses[2]).all()
    steps_m = np.diff(ego(np.arange(100, 900) * 10_000_000)[:, :2], axis=0)
    assert np.hypot(*steps_m.T) / 0.01 == pytest.approx(50.0, abs=0.5)
