"""The zenoh host of docs/live: messages as bytes, numbers that miss nothing, and two real processes."""

import json
import socket
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.scripts import LIVE, load_file

import fgtrack

TIMEOUT_S = 240.0


@pytest.fixture(scope="module")
def messages() -> Iterator[ModuleType]:
    sys.path.insert(0, str(LIVE))
    import zenoh_messages

    yield zenoh_messages
    sys.path.remove(str(LIVE))


@pytest.fixture(scope="module")
def tracker_script(messages: ModuleType) -> ModuleType:
    pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed (extra `live`)")
    return load_file(LIVE / "zenoh_tracker.py", "live")


# Messages


def test_an_object_list_is_the_same_after_its_journey(messages: ModuleType) -> None:
    stamp_ns = 1_700_000_000_123_456_789
    data = messages.objects_to_cdr(
        stamp_ns, "base_link", [("0", 1.25, -2.0, 0.0), ("1", 1e3, 0.1, 3.0)]
    )
    found = messages.cdr_to_list(data, "radar", stamp_ns + 5)
    assert (found.sensor, found.stamp_ns, found.receipt_ns, found.frame) == (
        "radar",
        stamp_ns,
        stamp_ns + 5,
        "ego",
    )
    assert [(one.x_m, one.y_m) for one in found.objects] == [(1.25, -2.0), (1e3, 0.1)]
    assert messages.stamp_of(data) == stamp_ns
    assert (
        messages.cdr_to_list(messages.objects_to_cdr(0, "map", []), "radar", 1).frame
        == "map"
    )


def test_an_ego_state_is_the_same_after_its_journey(messages: ModuleType) -> None:
    ego = fgtrack.EgoState(1_700_000_000_000_000_001, 7, 10.0, -20.0, -3.0, 30.0, 0.25)
    found = messages.cdr_to_ego(messages.odometry_to_cdr(ego), 7)
    assert (found.stamp_ns, found.receipt_ns, found.x_m, found.y_m) == (
        ego.stamp_ns,
        7,
        10.0,
        -20.0,
    )
    assert (found.yaw_rad, found.speed_mps, found.yaw_rate_radps) == pytest.approx(
        (-3.0, 30.0, 0.25)
    )


# Numbers


@given(st.lists(st.integers(0, 12), max_size=20), st.integers(0, 14))
def test_every_number_is_received_or_missing_and_a_second_time_repeated(
    messages: ModuleType, numbers: list[int], sent: int
) -> None:
    found = messages.Numbers()
    for number in numbers:
        found.add(number)
    found.expect(sent)
    expected = set(range(max([sent, *(number + 1 for number in numbers)])))
    assert found.missing == expected - set(numbers)
    assert (found.received, found.repeated) == (
        len(numbers),
        len(numbers) - len(set(numbers)),
    )


# What comes in


def sample(topic: str, data: bytes, attachment: bytes | None) -> Any:
    def as_bytes(value: bytes) -> Any:
        return SimpleNamespace(to_bytes=lambda: value)

    return SimpleNamespace(
        key_expr=topic,
        payload=as_bytes(data),
        attachment=None if attachment is None else as_bytes(attachment),
    )


def test_what_cannot_be_read_is_counted_and_not_lost(
    messages: ModuleType, tracker_script: ModuleType
) -> None:
    inlet = tracker_script.Inlet(sim_time=True)
    good = messages.objects_to_cdr(5, "base_link", [])
    topic = "vehicle/lists/radar"
    samples = [
        sample(topic, good, messages.attachment(0, 100)),
        sample(topic, good[:-2], messages.attachment(1, 200)),
        sample(topic, good, b"short"),
        sample(topic, good, None),
        sample("vehicle/odometry", b"", messages.attachment(0, 150)),
        sample(
            "vehicle/sent",
            json.dumps({topic: 5, "vehicle/lists/lidar": 3}).encode(),
            None,
        ),
        sample(topic, good, messages.attachment(4, 300)),  # after the end
    ]
    [only] = inlet.messages(samples)
    assert (only.sensor, only.stamp_ns, only.receipt_ns) == ("radar", 5, 100)
    assert inlet.unreadable == {topic: 3, "vehicle/odometry": 1}
    missing = {
        of_topic: sorted(numbers.missing) for of_topic, numbers in inlet.numbers.items()
    }
    assert missing == {
        topic: [2, 3, 4],
        "vehicle/odometry": [],
        "vehicle/lists/lidar": [0, 1, 2],
    }
    assert inlet.now_ns() == 200


# Two processes


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def driven(*options: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What vehicle and tracker say at the end of a drive."""
    pytest.importorskip("zenoh", reason="eclipse-zenoh is not installed (extra `live`)")
    address = f"tcp/127.0.0.1:{free_port()}"
    tracker_command = [
        "zenoh_tracker.py",
        "--listen",
        address,
        "--sim-time",
        "--estimator",
        "ekf-replay",
    ]
    tracker = start(tracker_command)
    try:
        assert tracker.stdout is not None
        assert tracker.stdout.readline() == "ready\n"
        vehicle = start(["zenoh_vehicle.py", "--connect", address, *options])
        try:
            said = [
                process.communicate(timeout=TIMEOUT_S) for process in (vehicle, tracker)
            ]
        finally:
            vehicle.kill()
    finally:
        tracker.kill()
    assert [process.returncode for process in (vehicle, tracker)] == [0, 0], said
    vehicle_says, tracker_says = (json.loads(out.splitlines()[-1]) for out, _ in said)
    return vehicle_says, tracker_says


def start(command: list[str]) -> subprocess.Popen[str]:
    script, *arguments = command
    return subprocess.Popen(
        [sys.executable, str(LIVE / script), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )


def total(counts: dict[str, dict[str, int]]) -> dict[str, int]:
    return {sensor: sum(of_sensor.values()) for sensor, of_sensor in counts.items()}


def simulated(max_lists: int) -> Counter[str]:
    """Detections of the first lists of the drive, by sensor."""
    found: Counter[str] = Counter()
    for message in fgtrack.simulate("single_opponent", seed=1, duration_s=300.0):
        if isinstance(message, fgtrack.DetectionList):
            if max_lists == 0:
                break
            max_lists -= 1
            assert message.receipt_ns > message.stamp_ns
            found[message.sensor] += len(message.objects)
    return found


@pytest.mark.slow
def test_of_ten_thousand_late_messages_none_is_lost_without_a_word() -> None:
    vehicle, tracker = driven("--duration-s", "300", "--max-lists", "10000")
    lists = {
        topic: count
        for topic, count in vehicle["sent"].items()
        if topic.startswith("vehicle/lists/")
    }
    assert sum(lists.values()) == 10_000
    assert tracker["received"] == vehicle["sent"]
    assert set(tracker["lost"].values()) == set(tracker["repeated"].values()) == {0}
    assert total(tracker["counts"]) == simulated(10_000)
    assert (tracker["unreadable"], tracker["refused"], tracker["failures"]) == (
        {},
        {},
        {},
    )
    fused = sum(
        of_sensor.get(name, 0)
        for of_sensor in tracker["counts"].values()
        for name in ("in_sequence", "out_of_sequence")
    )
    assert fused > 0.95 * sum(simulated(10_000).values())
    assert tracker["delay_median_s"]["radar"] == pytest.approx(0.06, abs=0.02)
    assert vehicle["in_order"]
    assert vehicle["tracks"] > 100
