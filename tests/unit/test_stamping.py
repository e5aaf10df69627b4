"""Stamps as they should have been."""

from dataclasses import replace

import pytest

from fgtrack.core.types import Detection, DetectionList
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.stamping import mended

MS = 1_000_000
LIST = DetectionList("radar", 400 * MS, 500 * MS, (Detection(1.0, 2.0, stamp_ns=390 * MS), Detection(3.0, 4.0)))


@pytest.mark.parametrize(
    ("settings", "stamp_ms", "own_ms"),
    [
        ({}, 400, 390),
        ({"clock_offset_s": 0.03}, 370, 360),
        ({"stamp_from": "receipt"}, 500, None),
        ({"stamp_from": "receipt", "clock_offset_s": 0.03}, 470, None),
    ],
)
def test_the_offset_of_a_clock_is_taken_off_and_a_receipt_may_stand_for_a_stamp(settings, stamp_ms, own_ms) -> None:
    """With `receipt` the offset is the latency of the sensor."""
    own_ns = None if own_ms is None else own_ms * MS
    expected = replace(
        LIST, stamp_ns=stamp_ms * MS, objects=(replace(LIST.objects[0], stamp_ns=own_ns), LIST.objects[1])
    )
    assert mended(LIST, {"radar": SensorModel(std={"x_m": 1.0, "y_m": 1.0}, **settings)}) == expected
