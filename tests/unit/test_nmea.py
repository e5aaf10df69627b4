"""Logs of AIS, made with pyais."""

import math

import pytest

pyais = pytest.importorskip("pyais", reason="pyais is not installed (extra `ais`)")

from fgtrack.core.errors import DataError  # noqa: E402
from fgtrack.inputs.source import input_kind, open_input  # noqa: E402


def ship(second, latitude=53.36, longitude=5.21, mmsi=244730036, **more):
    given = {
        "msg_type": 1,
        "lat": latitude,
        "lon": longitude,
        "speed": 10.0,
        "course": 90.0,
        "second": second,
        **more,
    }
    return "\n".join(pyais.encode_dict({"mmsi": mmsi, **given}, sentence_type="VDM"))


def rmc(time):
    return f"$GPRMC,{time},A,5310.8115,N,00525.7025,E,0.0,0.0,160414,0.7,E,A*10"


def messages(folder, *lines):
    (folder / "ship.log").write_text("\n".join(lines) + "\n")
    return list(open_input(folder / "ship.log").messages())


def test_the_second_of_a_report_is_the_latest_before_its_receipt(tmp_path):
    first, early, late = messages(tmp_path, ship(10), rmc("195719"), ship(18), ship(50))
    assert input_kind(tmp_path) == "nmea"
    assert (
        first.receipt_ns == early.receipt_ns == (1_397_678_239 + 1) * 10**9
    )  # 16 April 2014, 19:57:19
    assert [
        (each.receipt_ns - each.stamp_ns) / 1e9 for each in (first, early, late)
    ] == [10.0, 2.0, 30.0]
    (item,) = first.objects
    assert (item.id, item.x_m, item.y_m) == ("244730036", 0.0, 0.0)
    assert (item.speed_mps, item.yaw_rad) == (
        pytest.approx(5.144, abs=1e-3),
        pytest.approx(0.0),
    )


def test_a_second_just_ahead_shows_that_the_clock_of_the_log_is_late(tmp_path):
    (one,) = messages(tmp_path, rmc("195719"), ship(22))
    assert one.stamp_ns == one.receipt_ns == 1_397_678_242 * 10**9


def test_the_time_of_a_tag_block_counts_before_that_of_a_sentence(tmp_path):
    (one,) = messages(tmp_path, rmc("195719"), f"\\c:1397678300*00\\{ship(19)}")
    assert (one.receipt_ns / 1e9, one.stamp_ns / 1e9) == (1_397_678_301, 1_397_678_299)


def test_time_of_day_goes_on_at_midnight(tmp_path):
    gll = "$GPGLL,5310.8115,N,00525.7025,E,{},A,A*4D"
    lists = messages(tmp_path, rmc("235959"), ship(60), gll.format("000001"), ship(60))
    assert (lists[1].receipt_ns - lists[0].receipt_ns) / 1e9 == 2.0


def test_reports_without_position_or_speed_and_damaged_ones(tmp_path):
    unknown = ship(10, latitude=91.0, longitude=181.0)
    damaged = ship(10).replace("!AIVDM,1,1", "!AIVDM,1,x")
    (one,) = messages(
        tmp_path, rmc("195719"), unknown, damaged, ship(60, speed=102.3, course=360.0)
    )
    assert one.objects[0].speed_mps is None
    assert one.objects[0].yaw_rad is None
    assert one.stamp_ns == one.receipt_ns
    assert not math.isnan(one.objects[0].x_m)


def test_a_log_without_a_clock_is_refused(tmp_path):
    with pytest.raises(DataError, match="has no time: a log needs tag blocks"):
        messages(tmp_path, ship(10))
