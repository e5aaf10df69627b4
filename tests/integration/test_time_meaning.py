"""Columns of stamps and receipts of a table, by their times."""

from collections.abc import Callable
from pathlib import Path

import pytest

from fgtrack.core.types import DetectionList
from fgtrack.meaning.draft import opened

T0 = 1_700_000_000


def lists(folder: Path, names: str, cells: Callable[[int], str]) -> list[DetectionList]:
    """Lists of a radar with two objects at 10 Hz for 4 s; `cells` gives the times after k tenths of a second."""
    ego = ["time,x,y,yaw,speed"]
    ego += [f"{T0 + k // 10}.{k % 10},{k},0,0,10" for k in range(40)]
    rows = [names]
    for k in range(40):
        rows += [f"{cells(k)},{30 + k},{y}" for y in (0, 4)]
    (folder / "ego.csv").write_text("\n".join(ego))
    (folder / "radar.csv").write_text("\n".join(rows))
    messages = opened(folder).source.messages()
    return [each for each in messages if isinstance(each, DetectionList)]


def s(k: int, ms: int = 0) -> str:
    return f"{T0 + k // 10}.{k % 10}{ms:02d}"


def ns(k: int, ms: int = 0) -> str:
    return s(k, ms).replace(".", "") + "000000"


@pytest.mark.parametrize(
    ("names", "cells"),
    [
        ("%time,field.header.stamp,x,y", lambda k: f"{ns(k, 60)},{ns(k)}"),
        ("__time,/radar/header/stamp,x,y", lambda k: f"{s(k, 60)},{s(k)}"),
        (
            "recorded,bag_time,sensor_time,x,y",
            lambda k: f"{s(k, 60)},{s(k, 60)},{s(k)}",
        ),
        (
            "Time,header.stamp.secs,header.stamp.nsecs,x,y",
            lambda k: f"{s(k, 60)},{T0 + k // 10},{k % 10}00000000",
        ),
        ("stamp,log_time,x,y", lambda k: f"{s(k)},{s(k, 60)}"),
    ],
)
def test_a_header_stamp_is_the_stamp_and_the_log_time_the_receipt(
    tmp_path: Path, names: str, cells: Callable[[int], str]
) -> None:
    read = lists(tmp_path, names, cells)
    assert len(read) == 40
    assert {len(each.objects) for each in read} == {2}
    assert read[7].stamp_ns == T0 * 1_000_000_000 + 700_000_000
    assert {each.receipt_ns - each.stamp_ns for each in read} == {60_000_000}


def test_seconds_and_nanoseconds_give_a_list_for_each_scan(tmp_path: Path) -> None:
    names = "header.stamp.sec,header.stamp.nanosec,x,y"
    read = lists(tmp_path, names, lambda k: f"{T0 + k // 10},{k % 10}00000000")
    assert len(read) == 40
    assert read[13].stamp_ns == (T0 + 1) * 1_000_000_000 + 300_000_000


def test_times_in_milliseconds_are_read(tmp_path: Path) -> None:
    read = lists(
        tmp_path,
        "stamp_ms,rx_time_ms,x,y",
        lambda k: f"{s(k).replace('.', '')},{s(k, 30).replace('.', '')}",
    )
    assert read[5].receipt_ns - read[5].stamp_ns == 30_000_000
