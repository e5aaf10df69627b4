"""Ego states that arrive late change no final track of a tracker that decides by hypotheses."""

from collections.abc import Mapping
from typing import Any

import pytest

from fgtrack.testing.drawn_scenes import drawn
from fgtrack.testing.outcomes import difference, outcome

LOW_PASS: Mapping[str, Any] = {"yaw_weight": 0.7, "yaw_rate_weight": 0.5}
SPEED = {"speed_std_mps": 10.0, "ego_speed_factor": 1.0, "slow_ego_mps": 20.0}


@pytest.mark.parametrize(
    ("seed", "frame", "config"),
    [
        (0, "ego", {}),
        (1, "ego", {"ego": LOW_PASS, "birth": SPEED}),
        (2, "map", {"birth": SPEED}),
    ],
)
def test_late_poses_give_the_tracks_of_a_stream_in_order(
    seed: int, frame: str, config: Mapping[str, Any]
) -> None:
    scene = drawn(seed, num_objects=4, length_s=3.5, frame=frame, **config)
    in_order = outcome(scene)
    assert difference(outcome(scene.late(seed, 0.0, 0.4)), in_order) == ""
    assert difference(outcome(scene.late(seed, 0.8, 0.4)), in_order) == ""


def test_a_list_before_the_first_ego_state_is_used_once_it_has_come() -> None:
    scene = drawn(3, num_objects=3, length_s=3.0, ego={"wait_s": 0.0})
    late = scene.late(3, 0.0, 0.0)
    without = [each for each in late.messages if each.stamp_ns > 0]
    assert len(without) == len(late.messages) - 1
    in_order = outcome(scene)
    delayed = scene.late(3, 0.0, 0.9)
    found = outcome(delayed)
    assert {each.disposition.value for each in found.records} >= {"failed"}
    assert difference(found, in_order) == ""


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize(
    "config",
    [
        {"ego": {**LOW_PASS, "wait_s": 0.0}},
        {"ego": {"position_std_m": 0.1, "position_time_s": 5.0}},
    ],
)
def test_late_poses_in_many_scenes(seed: int, config: Mapping[str, Any]) -> None:
    kinds = ("range_bearing", "position") if seed % 2 else ("position", "bearing")
    scene = drawn(seed, kinds, num_objects=1 + seed % 12, **config)
    assert difference(outcome(scene.late(seed, 0.9, 0.5)), outcome(scene)) == ""
