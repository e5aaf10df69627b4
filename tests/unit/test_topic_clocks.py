"""Stamps in another time zone stay stamps; stamps of an unrelated clock do not."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fgtrack.inputs.info import TopicInfo
from fgtrack.meaning.topics import topic_part


def part(p50_s: float) -> Any:
    """Part of an odometry topic with this median delay."""
    name = "nav_msgs/msg/Odometry"
    delay = dict.fromkeys(("mean_s", "p50_s", "p90_s", "max_s"), p50_s)
    topic = TopicInfo("/odom", name, 100, 50.0, delay, None, None, {})
    entry = SimpleNamespace(name="/odom", type=name, problem=None)
    bag = SimpleNamespace(topics=(entry,), path=Path())
    return topic_part(bag, topic, []).item  # type: ignore[arg-type]


@pytest.mark.parametrize("p50_s", [0.05, -7199.95, 3600.1, 19800.08])
def test_stamps_of_a_time_zone_are_used(p50_s: float) -> None:
    assert part(p50_s).stamp_from == "message"


@pytest.mark.parametrize("p50_s", [1.7e9, -5003.0, 86400.0 * 30])
def test_stamps_of_an_unrelated_clock_are_not_used(p50_s: float) -> None:
    assert part(p50_s).stamp_from == "receipt"
