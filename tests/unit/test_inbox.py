import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from support.tracking import START_NS, message, ms

from fgtrack.core.types import Detection, DetectionList, UpdateRecord
from fgtrack.karle2023.tracker_parts import SlotInbox
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.inbox import Inbox, is_usable, stamps

STD = {"x_m": 0.3, "y_m": 0.3}
SENSORS = {
    "lidar": SensorModel(std=STD, max_delay_s=0.3),
    "radar": SensorModel(
        std={**STD, "speed_mps": 0.2}, stamp_from="objects_mean", max_delay_s=0.2
    ),
    "each": SensorModel(std=STD, stamp_from="object"),
}
CAR = Detection(x_m=10.0, y_m=1.0, speed_mps=5.0)
NOWHERE = Detection(x_m=0.0, y_m=0.0, speed_mps=5.0)
BROKEN = Detection(x_m=math.nan, y_m=1.0, speed_mps=5.0)


def queue() -> Inbox:
    return Inbox(SENSORS)


def slot() -> SlotInbox:
    return SlotInbox(SENSORS)


def said(records: list[UpdateRecord]) -> list[tuple[int, str]]:
    return [(record.index, record.disposition.value) for record in records]


def test_all_messages_of_a_tick_are_kept_and_come_out_oldest_first() -> None:
    inbox = queue()
    for stamp_ms in (40.0, 0.0, 20.0):
        assert inbox.put(message(CAR, stamp_ms=stamp_ms)) == []
    assert inbox.put(message(stamp_ms=10.0)) == []
    batches = inbox.collect()
    assert [(batch.stamp_ns - START_NS) // ms(1) for batch in batches] == [
        0,
        10,
        20,
        40,
    ]
    assert [batch.indices for batch in batches] == [(0,), (), (0,), (0,)]
    assert inbox.collect() == []


def test_a_copy_is_recognised_behind_other_lists() -> None:
    inbox = queue()
    for stamp_ms in (0.0, 20.0, 40.0):
        assert inbox.put(message(CAR, stamp_ms=stamp_ms)) == []
    assert said(inbox.put(message(CAR, stamp_ms=0.0, delay_ms=70.0))) == [
        (0, "duplicate")
    ]
    assert (
        inbox.put(message(Detection(x_m=10.5, y_m=1.0), stamp_ms=0.0, delay_ms=80.0))
        == []
    )
    assert inbox.put(message(CAR, sensor="radar", stamp_ms=0.0, delay_ms=80.0)) == []


@pytest.mark.parametrize("number", [float, Fraction])
def test_lists_of_one_stamp_that_differ_in_one_number_are_no_copies(
    number: Callable[[int], float],
) -> None:
    inbox = queue()
    for y_m in range(-9, 9):  # -1 and -2 have the same hash
        assert inbox.put(message(Detection(x_m=10.0, y_m=number(y_m)))) == []


def test_a_copy_in_another_order_is_recognised_and_another_number_of_each_is_no_copy() -> (
    None
):
    inbox, other = queue(), Detection(x_m=20.0, y_m=1.0)
    inbox.put(message(CAR, other))
    assert inbox.put(message(CAR, CAR, other)) == []
    assert said(inbox.put(message(other, CAR, delay_ms=5.0))) == [
        (0, "duplicate"),
        (1, "duplicate"),
    ]
    assert inbox.put(message(CAR, other, other, delay_ms=10.0)) == []


def test_a_copy_is_recognised_by_its_bits_where_a_number_that_is_not_used_is_nan() -> (
    None
):
    inbox = queue()
    for delay_ms, refused in ((0.0, []), (5.0, [(0, "duplicate")])):
        nan = Detection(
            x_m=10.0, y_m=1.0, z_m=float("nan"), class_name="".join(("c", "ar"))
        )
        assert said(inbox.put(message(nan, delay_ms=delay_ms))) == refused


def test_a_list_that_comes_again_when_all_are_forgotten_is_no_copy() -> None:
    inbox = Inbox(SENSORS, memory_s=0.1)
    for delay_ms in (0.0, 299.0, 700.0):
        inbox.put(message(CAR, sensor="each", delay_ms=delay_ms))
    assert len(inbox.collect()) == 2  # the second one is a copy


@pytest.mark.parametrize(
    ("delay_ms", "refused"), [(300.0, []), (300.000001, [(0, "too_old")])]
)
def test_a_message_later_than_its_sensor_may_be_is_too_old(
    delay_ms: float, refused: list[object]
) -> None:
    inbox = queue()
    assert said(inbox.put(message(CAR, delay_ms=delay_ms))) == refused
    assert len(inbox.collect()) == 1 - len(refused)


@pytest.mark.parametrize(
    ("ahead_ms", "refused"), [(1000.0, []), (1000.000001, [(0, "invalid")])]
)
def test_a_stamp_of_the_far_future_is_invalid(
    ahead_ms: float, refused: list[object]
) -> None:
    assert said(queue().put(message(CAR, delay_ms=-ahead_ms))) == refused


def test_single_detections_that_are_none_end_and_the_others_stay() -> None:
    inbox = queue()
    assert said(inbox.put(message(NOWHERE, CAR, BROKEN))) == [
        (0, "invalid"),
        (2, "invalid"),
    ]
    [batch] = inbox.collect()
    assert batch.indices == (1,)


def test_a_list_of_nothing_but_invalid_detections_does_not_say_that_nothing_was_seen() -> (
    None
):
    inbox = queue()
    inbox.put(message(BROKEN))
    assert inbox.collect() == []


def test_detections_with_stamps_of_their_own_are_batches_of_their_own() -> None:
    inbox = queue()
    items = [
        Detection(x_m=1.0, y_m=1.0, stamp_ns=stamp)
        for stamp in (START_NS - 7, None, START_NS - 7)
    ]
    inbox.put(message(*items, sensor="each"))
    assert [
        (batch.stamp_ns - START_NS, batch.indices) for batch in inbox.collect()
    ] == [(-7, (0, 2)), (0, (1,))]


def test_the_mean_stamp_is_that_of_the_detections_which_have_one() -> None:
    items = [
        Detection(x_m=1.0, y_m=1.0, stamp_ns=stamp)
        for stamp in (START_NS + 10, None, START_NS + 21)
    ]
    assert stamps(message(*items), SENSORS["radar"]) == [START_NS + 15] * 3
    assert stamps(message(*items), SENSORS["lidar"]) == [START_NS] * 3
    assert stamps(message(CAR, CAR), SENSORS["radar"]) == [START_NS] * 2


def test_a_record_names_the_detections_own_stamp() -> None:
    item = Detection(x_m=0.0, y_m=0.0, stamp_ns=START_NS - 5)
    [record] = queue().put(message(item, delay_ms=1.0))
    assert (record.sensor, record.stamp_ns, record.receipt_ns, record.index) == (
        "lidar",
        START_NS - 5,
        START_NS + ms(1),
        0,
    )


# --- what is usable

ANY = SensorModel(std={**STD, "yaw_rad": 0.1, "range_m": 1.0, "bearing_rad": 0.1})


@pytest.mark.parametrize(
    ("given", "usable"),
    [
        ({"x_m": 1.0, "y_m": 2.0}, True),
        ({"x_m": 0.0, "y_m": 2.0}, True),
        ({"x_m": 0.0, "y_m": -0.0}, False),
        ({"x_m": 1.0}, False),
        ({"y_m": 1.0, "bearing_rad": 0.1}, False),
        ({"yaw_rad": 1.0}, False),
        ({"range_m": 10.0}, False),
        ({"bearing_rad": 0.0}, True),
        ({"range_m": 10.0, "bearing_rad": 0.0}, True),
        ({"x_m": 1.0, "y_m": math.inf}, False),
        ({"x_m": 1.0, "y_m": 1e200}, False),
        ({"x_m": 1.0, "y_m": 2.0, "yaw_rad": math.nan}, False),
        (
            {"x_m": 1.0, "y_m": 2.0, "speed_mps": math.nan},
            True,
        ),  # this sensor's speed is not used
        ({}, False),
    ],
)
def test_a_detection_is_usable_if_it_says_where_it_is(
    given: dict[str, float], usable: bool
) -> None:
    assert is_usable(Detection(**given), ANY) == usable


@pytest.mark.parametrize(
    ("matrix", "usable"),
    [
        (np.eye(2), True),
        ([[2.0, 1.0], [1.0, 2.0]], True),
        ([[2.0, 1.0], [1.0 + 1e-7, 2.0]], True),
        ([[2.0, 1.0], [-1.0, 2.0]], False),
        ([[1.0, 2.0], [2.0, 1.0]], False),
        (np.zeros((2, 2)), False),
        (-np.eye(2), False),
        (1e-12 * np.eye(2), True),
        (1e-13 * np.eye(2), False),
        (1e-300 * np.eye(2), False),
        ([[1.0, math.nan], [math.nan, 1.0]], False),
        ([[math.inf, 0.0], [0.0, 1.0]], False),
        (np.eye(3), False),
    ],
)
def test_a_covariance_must_be_one(matrix, usable: bool) -> None:
    item = Detection(x_m=1.0, y_m=2.0, covariance=tuple(np.ravel(matrix).tolist()))
    assert is_usable(item, ANY) == usable
    assert is_usable(
        item, SensorModel(std=STD, message_covariance=False)
    )  # not used, not looked at


def test_a_covariance_is_judged_by_the_components_in_use() -> None:
    item = Detection(
        x_m=1.0,
        y_m=2.0,
        speed_mps=3.0,
        covariance=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0),
    )
    assert is_usable(item, SensorModel(std=STD))
    assert not is_usable(item, SensorModel(std={**STD, "speed_mps": 1.0}))


def test_a_second_message_within_a_tick_supersedes_the_first() -> None:
    inbox = slot()
    assert inbox.put(message(CAR, NOWHERE, stamp_ms=0.0)) != []
    assert said(inbox.put(message(CAR, CAR, stamp_ms=10.0))) == [(0, "superseded")]
    [batch] = inbox.collect()
    assert (batch.stamp_ns, batch.indices) == (START_NS + ms(10), (0, 1))


def test_a_list_of_broken_detections_empties_the_slot_and_is_not_remembered() -> None:
    inbox = slot()
    inbox.put(message(CAR, stamp_ms=0.0))
    assert sorted(said(inbox.put(message(BROKEN, stamp_ms=10.0)))) == [
        (0, "invalid"),
        (0, "superseded"),
    ]
    assert inbox.collect() == []
    assert inbox.put(message(CAR, stamp_ms=10.0)) == []


def test_the_published_mean_of_stamps_is_that_of_floating_point() -> None:
    own = [START_NS + 100, START_NS + 433]
    items = tuple(
        Detection(x_m=1.0, y_m=1.0, speed_mps=1.0, stamp_ns=stamp) for stamp in own
    )
    inbox = slot()
    inbox.put(DetectionList("radar", START_NS, START_NS + 1000, items))
    [batch] = inbox.collect()
    assert batch.stamp_ns == int((float(own[0]) + float(own[1])) / 2)
    assert batch.stamp_ns != sum(own) // 2
    assert batch.stamp_ns % 256 == 0
