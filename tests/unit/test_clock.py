"""The ticks of a replay, and corrected stamps."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.meaning.corrected import corrected
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.clock import Delivered, clock_ticks

MS = 1_000_000
receipts = st.lists(st.integers(0, 300 * MS), max_size=20).map(sorted)


def received(*receipts_ns: int) -> list[Delivered]:
    return [DetectionList("lidar", 0, receipt_ns, ()) for receipt_ns in receipts_ns]


def told(found) -> list[tuple[int, list[int]]]:
    return [
        (tick.now_ns, [message.receipt_ns for message in tick.messages])
        for tick in found
    ]


def test_ticks_lie_on_multiples_of_the_period_from_the_first_receipt_to_the_last() -> (
    None
):
    found = told(clock_ticks(received(25 * MS, 30 * MS, 81 * MS), 50.0))
    assert found == [
        (40 * MS, [25 * MS, 30 * MS]),
        (60 * MS, []),
        (80 * MS, []),
        (100 * MS, [81 * MS]),
    ]


def test_what_is_received_at_a_tick_is_delivered_with_it() -> None:
    found = told(clock_ticks(received(40 * MS, 60 * MS, 60 * MS + 1), 50.0))
    assert found == [
        (40 * MS, [40 * MS]),
        (60 * MS, [60 * MS]),
        (80 * MS, [60 * MS + 1]),
    ]


@given(receipts_ns=receipts, node_hz=st.sampled_from([7.0, 20.0, 50.0, 333.0]))
def test_every_message_is_delivered_once_at_the_first_tick_after_it(
    receipts_ns: list[int], node_hz: float
) -> None:
    step_ns = int(1e9 / node_hz)
    found = list(clock_ticks(received(*receipts_ns), node_hz))
    assert [m.receipt_ns for tick in found for m in tick.messages] == receipts_ns
    for tick in found:
        assert tick.now_ns % step_ns == 0
        assert all(
            tick.now_ns - step_ns < m.receipt_ns <= tick.now_ns for m in tick.messages
        )
    if found:
        assert [tick.now_ns for tick in found] == [
            found[0].now_ns + k * step_ns for k in range(len(found))
        ]
        assert found[0].messages
        assert found[-1].messages


def test_without_a_period_every_receipt_is_a_tick() -> None:
    messages = [*received(5), EgoState(0, 5, 0.0, 0.0, 0.0, 0.0), *received(7, 7, 9)]
    assert told(clock_ticks(messages, None)) == [(5, [5, 5]), (7, [7, 7]), (9, [9])]


@pytest.mark.parametrize(
    ("settings", "stamp_ms", "own_ms"),
    [
        ({}, 400, 390),
        ({"clock_offset_s": 0.03}, 370, 360),
        ({"stamp_from": "receipt"}, 500, None),
        (
            {"stamp_from": "receipt", "clock_offset_s": 0.03},
            470,
            None,
        ),  # the latency of the sensor
    ],
)
def test_the_offset_of_a_clock_is_taken_off_and_a_receipt_may_stand_for_a_stamp(
    settings, stamp_ms, own_ms
) -> None:
    given = DetectionList(
        "radar",
        400 * MS,
        500 * MS,
        (Detection(1.0, 2.0, stamp_ns=390 * MS), Detection(3.0, 4.0)),
    )
    first = replace(given.objects[0], stamp_ns=None if own_ms is None else own_ms * MS)
    expected = replace(given, stamp_ns=stamp_ms * MS, objects=(first, given.objects[1]))
    assert (
        corrected(
            given, {"radar": SensorModel(std={"x_m": 1.0, "y_m": 1.0}, **settings)}
        )
        == expected
    )
