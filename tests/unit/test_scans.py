"""One detection per message, put together to scans."""

import pytest

from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.formats.scans import grouped

MS = 1_000_000


def one(
    stamp_ms: float, receipt_ms: float, x_m: float, sensor: str = "radar"
) -> DetectionList:
    return DetectionList(
        sensor,
        round(stamp_ms * MS),
        round(receipt_ms * MS),
        (Detection(x_m=x_m, y_m=0.0),),
        "sensor",
    )


def ego(receipt_ms: float) -> EgoState:
    return EgoState(round(receipt_ms * MS), round(receipt_ms * MS), 0.0, 0.0, 0.0, 0.0)


def told(messages: list[Message]) -> list[tuple[int, int, list[float]]]:
    """Stamp, receipt in ms, and what is in the lists."""
    return [
        (
            item.stamp_ns // MS,
            item.receipt_ns // MS,
            [each.x_m for each in getattr(item, "objects", ())],
        )
        for item in messages
    ]


def test_equal_stamps_are_one_scan_received_with_its_last_detection() -> None:
    messages = [
        one(0, 5, 1.0),
        ego(6),
        one(0, 7, 2.0),
        ego(8),
        one(50, 55, 3.0),
        ego(60),
    ]
    found = list(grouped(messages, {"radar": 0}))
    assert told(found) == [
        (6, 6, []),
        (0, 7, [1.0, 2.0]),
        (8, 8, []),
        (50, 55, [3.0]),
        (60, 60, []),
    ]
    assert [item.receipt_ns for item in found] == sorted(
        item.receipt_ns for item in found
    )


def test_stamps_within_the_window_are_one_scan_with_stamps_of_their_own() -> None:
    messages = [one(0, 5, 1.0), one(4, 7, 2.0), one(20, 22, 3.0)]
    first, second = grouped(messages, {"radar": 10 * MS})
    assert told([first, second]) == [(2, 7, [1.0, 2.0]), (20, 22, [3.0])]
    assert [item.stamp_ns for item in first.objects] == [0, 4 * MS]
    assert [item.stamp_ns for item in second.objects] == [None]


def test_other_sensors_are_left_alone_and_scans_of_two_sensors_do_not_mix() -> None:
    messages = [
        one(0, 5, 1.0),
        one(0, 6, 9.0, "lidar"),
        one(0, 7, 5.0, "rear"),
        one(0, 8, 2.0),
        one(0, 9, 6.0, "rear"),
    ]
    found = list(grouped(messages, {"radar": 0, "rear": 0}))
    assert [(item.sensor, [each.x_m for each in item.objects]) for item in found] == [
        ("lidar", [9.0]),
        ("radar", [1.0, 2.0]),
        ("rear", [5.0, 6.0]),
    ]


def test_nothing_waits_for_a_sensor_that_has_gone() -> None:
    given = []

    def messages():
        yield one(0, 5, 1.0)
        for tick in range(300):
            yield ego(10.0 + 10.0 * tick)
            given.append(tick)

    found = grouped(messages(), {"radar": 0})
    assert told([next(found)]) == [(0, 5, [1.0])]
    assert given[-1] == 99


def test_what_came_before_a_break_is_given() -> None:
    def messages():
        yield one(0, 5, 1.0)
        yield ego(6)
        yield one(0, 7, 2.0)
        raise DataError("broken")

    readable = UntilBreak(grouped(messages(), {"radar": 0}))
    found = list(readable)
    with pytest.raises(DataError, match="broken"):
        readable.raise_error()
    assert told(found) == [(6, 6, []), (0, 7, [1.0, 2.0])]
