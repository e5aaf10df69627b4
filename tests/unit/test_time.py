"""Times that no recording has, and their probable unit."""

import pytest

from fgtrack.core.time import NS_PER_S, epoch_unit, wrong_unit

YEAR_NS = 31_557_600 * NS_PER_S
NOW_S = 1_790_000_000


@pytest.mark.parametrize(
    ("value", "unit"),
    [(NOW_S, "s"), (NOW_S * 1e3, "ms"), (NOW_S * 1e9, "ns"), (9e8, None)],
)
def test_the_unit_is_that_in_which_a_time_is_of_this_century(
    value: float, unit: str | None
) -> None:
    assert epoch_unit(value) == unit


def test_too_many_times_in_too_little_time_are_of_another_unit() -> None:
    start_ns = NOW_S * NS_PER_S
    assert wrong_unit(10, NOW_S, NOW_S + 8) == (
        "10 times within 8e-09 s, which no sensor sends: they are not in ns, but probably in s since 1970"
    )
    assert wrong_unit(9, NOW_S, NOW_S + 8) is None
    assert wrong_unit(1001, start_ns, start_ns + 10_000_000) is None  # 100 kHz
    assert (
        wrong_unit(1002, start_ns, start_ns + 10_000_000)
        == "1002 times within 0.01 s, which no sensor sends: they are not in ns"
    )
    assert wrong_unit(1000, start_ns, start_ns) is None


def test_no_recording_is_longer_than_ten_years() -> None:
    assert wrong_unit(2, 0, 10 * YEAR_NS) is None
    assert str(wrong_unit(2, 0, 20 * YEAR_NS)).startswith("is 20 years long")
