"""Stamps and receipts, constants between clocks, and repetitions are found from the times themselves."""

import re
from collections.abc import Mapping

import numpy as np
import pytest

from fgtrack.meaning.times import clock_constant, loop_of, time_columns

T0 = 1_700_000_000.0
N = 200
STAMPS = T0 + 0.1 * np.arange(N)
LATE = STAMPS + 0.06 + np.random.default_rng(1).uniform(0.0, 0.02, N)


def words(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]


def chosen(columns: Mapping[str, np.ndarray]) -> tuple[tuple[str, ...], ...]:
    result = time_columns(columns, {name: words(name) for name in columns})
    assert result is not None
    return result.stamp, result.receipt


@pytest.mark.parametrize(
    ("log", "stamp"),
    [
        ("%time", "field.header.stamp"),
        ("__time", "/radar/header/stamp"),
        ("bag_time", "sensor_time"),
        ("rx_time", "time"),
        ("t_log", "t"),
        ("a", "b"),
    ],
)
def test_the_later_time_is_the_receipt_in_either_order(log: str, stamp: str) -> None:
    expected = ((stamp,), (log,))
    assert chosen({log: LATE, stamp: STAMPS}) == expected
    assert chosen({stamp: STAMPS, log: LATE}) == expected


def test_seconds_and_nanoseconds_of_one_name_are_joined() -> None:
    columns = {
        "Time": LATE,
        "header.stamp.secs": np.floor(STAMPS),
        "header.stamp.nsecs": np.round(STAMPS % 1.0 * 1e9),
    }
    assert chosen(columns) == (
        ("header.stamp.secs", "header.stamp.nsecs"),
        ("Time",),
    )


def test_equal_times_have_no_receipt() -> None:
    assert chosen({"time": STAMPS, "header.stamp": STAMPS}) == (("header.stamp",), ())


def test_a_time_of_another_origin_is_no_receipt() -> None:
    assert chosen({"uptime": STAMPS - T0, "header.stamp": STAMPS})[1] == ()


@pytest.mark.parametrize("offset_s", [18.0, -18.0, 37.0, -37.0, 3600.0, -19800.0, 19.0])
def test_a_constant_between_clocks_is_recognised(offset_s: float) -> None:
    result = clock_constant(LATE - (STAMPS + offset_s))
    assert result is not None
    assert result.offset_s == offset_s
    assert result.delay_s == pytest.approx(0.07, abs=0.01)


@pytest.mark.parametrize("delay_s", [0.06, 2.5, 6.0, 11.0, -0.2, 27.0, 5000.0])
def test_a_delay_is_no_constant(delay_s: float) -> None:
    assert clock_constant(np.full(N, delay_s)) is None


def test_delays_over_a_wide_range_are_no_constant() -> None:
    assert clock_constant(np.linspace(10.0, 27.0, N)) is None


def nanoseconds(times_s: np.ndarray) -> np.ndarray:
    return np.round(times_s * 1e9).astype(np.int64)


def test_stamps_that_repeat_while_receipts_go_on_are_a_loop() -> None:
    stamps_ns = nanoseconds(T0 + 0.1 * (np.arange(N) % 80))
    result = loop_of(stamps_ns, nanoseconds(LATE))
    assert result is not None
    assert (result.index, result.back_s) == (80, pytest.approx(7.9))


@pytest.mark.parametrize("wrong", [0.0, T0 - 5.0, T0 + 100.0])
def test_one_wrong_stamp_is_no_loop(wrong: float) -> None:
    stamps_s = STAMPS.copy()
    stamps_s[90] = wrong
    assert loop_of(nanoseconds(stamps_s), nanoseconds(LATE)) is None


def test_a_clock_that_is_set_back_is_no_loop() -> None:
    stamps_s = STAMPS.copy()
    stamps_s[100:] -= 3.0
    receipts = nanoseconds(LATE + np.where(np.arange(N) < 100, 0.0, 0.01))
    assert loop_of(nanoseconds(stamps_s + 0.003 * np.arange(N)), receipts) is None
