"""Predicted positions: on the arc, and along the track."""

import math

import numpy as np
import pytest

from fgtrack.evaluation.scores.predictor import arc_positions, rail_positions
from fgtrack.models.oval import make_oval

TRACK = make_oval()
AHEAD_S = 0.1 * np.arange(1, 51)


def on_the_track(
    s_m: np.ndarray, lateral_m: float, speed_mps: float = 60.0
) -> np.ndarray:
    """States that follow the track at `lateral_m`, with its turn rate, shape (n, 5)."""
    xy = TRACK.position(s_m, np.full(len(s_m), lateral_m))
    curvature = TRACK.view(xy, 0.0, 0.0).curvature_radpm
    yaw_rate = speed_mps * curvature / (1.0 - curvature * lateral_m)
    return np.column_stack(
        [xy, TRACK.view(xy, 0.0, 0.0).yaw_rad, np.full(len(s_m), speed_mps), yaw_rate]
    )


def test_an_arc_is_a_circle() -> None:
    (positions,) = arc_positions(
        np.array([[10.0, 0.0, math.pi / 2, 20.0, 2.0]]), np.array([math.pi / 2])
    )
    assert positions[0] == pytest.approx(
        [-10.0, 0.0], abs=1e-9
    )  # half of a circle of 10 m


@pytest.mark.parametrize("lateral_m", [-6.0, 0.0, 4.0])
def test_a_rail_keeps_its_speed_and_its_place_across_the_track(
    lateral_m: float,
) -> None:
    states = on_the_track(np.linspace(0.0, TRACK.length_m, 40), lateral_m)
    positions = rail_positions(TRACK, states, AHEAD_S)
    steps_m = np.linalg.norm(np.diff(positions, axis=1), axis=2)
    np.testing.assert_allclose(steps_m, 6.0, atol=0.02)
    # Off by what the arc leaves the lane in 0.2 s where the curvature changes.
    np.testing.assert_allclose(TRACK.frenet(positions[:, -1])[1], lateral_m, atol=0.05)
    ahead_m = np.mod(
        TRACK.frenet(positions[:, -1])[0] - TRACK.frenet(states[:, :2])[0],
        TRACK.length_m,
    )
    curvature = TRACK.view(states[:, :2], 0.0, 0.0).curvature_radpm
    straight = np.abs(curvature) < 1e-9
    assert not straight.all()
    assert (
        np.sign(ahead_m - 300.0)[~straight & (np.abs(ahead_m - 300.0) > 0.1)]
        == np.sign(lateral_m)
    ).all()


def test_until_a_fifth_of_a_second_a_rail_is_the_arc() -> None:
    states = on_the_track(np.array([100.0, 700.0]), 2.0)
    states[:, 4] += 0.5
    rail, arc = rail_positions(TRACK, states, AHEAD_S), arc_positions(states, AHEAD_S)
    np.testing.assert_array_equal(rail[:, :2], arc[:, :2])
    assert np.abs(rail[:, 2:] - arc[:, 2:]).max() > 1.0


def test_who_is_beyond_a_bound_goes_on_along_it_and_who_drives_back_stays() -> None:
    (left_m,), (right_m,) = TRACK.bounds(np.array([0.0]))
    states = np.concatenate(
        [
            on_the_track(np.array([50.0]), lateral)
            for lateral in (left_m + 2.0, -right_m - 2.0)
        ]
    )
    lateral_m = TRACK.frenet(rail_positions(TRACK, states, AHEAD_S)[:, -1])[1]
    np.testing.assert_allclose(lateral_m, [left_m, -right_m], atol=1e-6)
    states[:, 3] = -10.0
    stays = rail_positions(TRACK, states, AHEAD_S)
    np.testing.assert_array_equal(stays[:, 2], stays[:, -1])
    assert rail_positions(TRACK, states[:0], AHEAD_S).shape == (0, 50, 2)
