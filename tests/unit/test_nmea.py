"""Logs of AIS, made with pyais."""

import math
from datetime import UTC, datetime
from functools import reduce
from operator import xor

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


def checked(sentence):
    """The sentence with its checksum, which covers the bytes behind the first one."""
    return f"{sentence}*{reduce(xor, sentence[1:].encode()):02X}"


def rmc(time, date="160414"):
    return checked(f"$GPRMC,{time},A,5310.8115,N,00525.7025,E,0.0,0.0,{date},0.7,E,A")


def tag(time, station="r1"):
    body = f"s:{station},c:{time}"
    return f"\\{body}*{reduce(xor, body.encode()):02X}\\"


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
    (one,) = messages(tmp_path, rmc("195719"), f"{tag(1397678300)}{ship(19)}")
    assert (one.receipt_ns / 1e9, one.stamp_ns / 1e9) == (1_397_678_301, 1_397_678_299)


def test_time_of_day_goes_on_at_midnight(tmp_path):
    gll = checked("$GPGLL,5310.8115,N,00525.7025,E,000001,A,A")
    lists = messages(tmp_path, rmc("235959"), ship(60), gll, ship(60))
    assert (lists[1].receipt_ns - lists[0].receipt_ns) / 1e9 == 2.0


def test_reports_without_position_or_speed_and_damaged_ones(tmp_path):
    unknown = ship(10, latitude=91.0, longitude=181.0)
    damaged = checked(ship(10).split("*")[0].replace("!AIVDM,1,1", "!AIVDM,1,x"))
    (one,) = messages(
        tmp_path, rmc("195719"), unknown, damaged, ship(60, speed=102.3, course=360.0)
    )
    assert one.objects[0].speed_mps is None
    assert one.objects[0].yaw_rad is None
    assert one.stamp_ns == one.receipt_ns
    assert one.left_out == ("missing position",)
    assert not math.isnan(one.objects[0].x_m)


def test_a_log_without_a_clock_is_refused(tmp_path):
    with pytest.raises(DataError, match="has no time: a log needs tag blocks"):
        messages(tmp_path, ship(10))


START_S = 1_700_000_000


def series(count, form, start_s=START_S):
    """A report every 10 s of a ship that moves to the east; `form` gives the lines from time and report."""
    return [
        form(start_s + 10 * k, ship((start_s + 10 * k) % 60, longitude=5.0 + 1e-3 * k))
        for k in range(count)
    ]


def stamps_s(lists):
    return [each.stamp_ns // 10**9 - START_S for each in lists]


def left_out(lists):
    return [reason for each in lists for reason in each.left_out]


def iso(time):
    return datetime.fromtimestamp(time, UTC)


@pytest.mark.parametrize(
    "form",
    [
        lambda t, report: f"{tag(t)}{report}",
        lambda t, report: f"{tag(1000 * t)}{report}",
        lambda t, report: f"\\g:1-1-77*{0:02X}\\{tag(t)}{report}",
        lambda t, report: f"{report},r003669945,{t}",
        lambda t, report: f"{report},s27540,d-106,T01.36,r09,{t}",
        lambda t, report: f"{t} {report}",
        lambda t, report: f"{t}.25,{report}",
        lambda t, report: f"{1000 * t};N;{report}",
        lambda t, report: f"{iso(t):%Y-%m-%dT%H:%M:%SZ} {report}",
        lambda t, report: f"[{iso(t):%Y-%m-%d %H:%M:%S.%f}] INFO {report}",
        lambda t, report: f'"{iso(t):%Y/%m/%d %H:%M:%S}","{report}"',
        lambda t, report: (
            checked(
                f"$PGHP,1,{iso(t):%Y},{iso(t).month},{iso(t).day},{iso(t).hour},"
                f"{iso(t).minute},{iso(t).second},10,338,2,,1,09"
            )
            + "\n"
            + report
        ),
        lambda t, report: (
            rmc(f"{iso(t):%H%M%S.00}", f"{iso(t):%d%m%y}") + "\n" + report
        ),
        lambda t, report: (
            checked(f"$GPZDA,{iso(t):%H%M%S.00},{iso(t):%d,%m,%Y},00,00")
            + "\n"
            + report
        ),
    ],
)
def test_the_time_of_a_report_is_read_wherever_a_receiver_writes_it(tmp_path, form):
    lists = messages(tmp_path, *series(12, form))
    assert stamps_s(lists) == [10 * k for k in range(12)]
    assert {each.receipt_ns - each.stamp_ns for each in lists} == {10**9}
    assert not left_out(lists)


def test_reports_that_a_satellite_delivers_late_keep_their_time(tmp_path):
    lines = series(100, lambda t, report: f"{tag(t)}{report}")
    moved = [lines[k] for k in range(100) if k % 3] + [
        lines[k] for k in range(0, 100, 3)
    ]
    lists = messages(tmp_path, *moved)
    assert sorted(stamps_s(lists)) == [10 * k for k in range(100)]
    assert all(
        each.objects[0].x_m == pytest.approx(6.66 * (s - 10), rel=1e-2, abs=5.0)
        for each, s in zip(lists, stamps_s(lists), strict=True)
    )
    receipts = [each.receipt_ns for each in lists]
    assert receipts == sorted(receipts)
    assert receipts[-1] == (START_S + 990 + 1) * 10**9


@pytest.mark.parametrize("wrong_s", [-START_S, -30 * 86_400, 3600, 86_400, 10**9])
@pytest.mark.parametrize("number", [0, 25, 59])
def test_a_report_with_a_wrong_time_is_left_out_and_counted(tmp_path, wrong_s, number):
    lines = series(60, lambda t, report: f"{tag(t)}{report}")
    report = lines[number].split("\\")[-1]
    lines[number] = f"{tag(START_S + 10 * number + wrong_s)}{report}"
    lists = messages(tmp_path, *lines)
    read = [each for each in lists if each.objects]
    assert stamps_s(read) == [10 * k for k in range(60) if k != number]
    assert left_out(lists) == ["wrong time"]
    assert max(each.receipt_ns - each.stamp_ns for each in read) == 10**9


def test_a_tag_block_with_a_wrong_checksum_has_no_time(tmp_path):
    lines = series(30, lambda t, report: f"{tag(t)}{report}")
    lines[12] = lines[12].replace("c:17", "c:19")
    assert stamps_s(messages(tmp_path, *lines)) == [10 * k for k in range(30)]


def test_reports_with_a_wrong_checksum_are_left_out_and_counted(tmp_path):
    lines = series(30, lambda t, report: f"{tag(t)}{report}")
    for k in (3, 4, 29):
        at = lines[k].rindex(",0*") - 12
        other = "P" if lines[k][at] != "P" else "0"
        lines[k] = lines[k][:at] + other + lines[k][at + 1 :]
    lists = messages(tmp_path, *lines)
    assert [each.left_out for each in lists if each.left_out] == [
        ("wrong checksum",) * 2,
        ("wrong checksum",),
    ]
    assert len([each for each in lists if each.objects]) == 27


def test_a_break_of_hours_is_no_wrong_time(tmp_path):
    first = series(40, lambda t, report: f"{tag(t)}{report}")
    second = series(40, lambda t, report: f"{tag(t)}{report}", START_S + 36_000)
    lists = messages(tmp_path, *first, *second)
    assert len(lists) == 80
    assert not left_out(lists)


def test_a_message_of_two_sentences_has_the_time_of_the_first(tmp_path):
    payload = pyais.encode_dict(
        {"mmsi": 5, "msg_type": 19, "lat": 1.0, "lon": 2.0, "speed": 3.0, "second": 20}
    )[0].split(",")[5]
    parts = [
        checked(f"!AIVDM,2,{k + 1},4,A,{part},0")
        for k, part in enumerate((payload[:30], payload[30:]))
    ]
    lines = [f"{tag(START_S)}{parts[0]}", f"{tag(START_S + 300)}{ship(60)}", parts[1]]
    (_, late) = messages(tmp_path, *lines)
    assert late.objects[0].id == "5"
    assert stamps_s([late]) == [0]


def test_a_log_begins_with_many_sentences_of_other_instruments(tmp_path):
    depths = [checked(f"$SDDPT,{k}.0,0.0") for k in range(2000)]
    lists = messages(
        tmp_path, *depths, *series(5, lambda t, report: f"{tag(t)}{report}")
    )
    assert stamps_s(lists) == [0, 10, 20, 30, 40]


def test_a_table_with_a_sentence_in_its_texts_stays_a_table(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(f"time,x,y,raw\n1.0,2.0,3.0,{ship(3)!r}\n")
    assert input_kind(file) == "csv"
