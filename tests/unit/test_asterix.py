"""ASTERIX recordings, made with libasterix."""

import math
from importlib import import_module
from importlib.util import find_spec

import pytest

from fgtrack.core.errors import DataError
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.formats.asterix_records import RecordReader
from fgtrack.inputs.settings import AsterixInput, InputConfig, Origin
from fgtrack.inputs.source import input_kind, open_input

pytestmark = pytest.mark.skipif(
    find_spec("asterix") is None,
    reason="libasterix is not installed (extra `asterix`)",
)

AIRPORT = Origin(41.3, 2.08)


def edition(name):
    """An edition of a category. The module takes seconds to load, so no other test file loads it."""
    return getattr(import_module("asterix.generated"), name)


def block(kind, *records):
    return (
        kind.create([kind.cv_record.create(record) for record in records])
        .unparse()
        .to_bytes()
    )


def surface(time_s, x_m, y_m, kind=3, address=None, sic=7, coasted=0):
    target = {"220": address} if address else {}
    target |= (
        {"170": ((("CNF", 0), ("TRE", 0), ("CST", coasted), 0, 0, 0, None),)}
        if coasted
        else {}
    )
    head = {"010": (("SAC", 0), ("SIC", sic)), "000": 1, "140": (time_s, "s")}
    where = {
        "042": (("X", (x_m, "m")), ("Y", (y_m, "m"))),
        "202": (("VX", 12), ("VY", 16)),
    }  # in 0.25 m/s
    return block(
        edition("Cat_010_1_1"),
        {**head, "020": ((("TYP", kind), 0, 0, 0, 0, None),), **where, **target},
    )


def aircraft(
    received_s,
    sent_s,
    latitude,
    longitude,
    kind="Cat_021_2_6",
    nacp=9,
    address=0x4CACAA,
):
    quality = ((0, 7, None), (0, 0, nacp, None))
    return block(
        edition(kind),
        {
            "010": (("SAC", 0), ("SIC", 1)),
            "080": address,
            "073": (received_s, "s"),
            "077": (sent_s, "s"),
            "131": (("LAT", (latitude, "°")), ("LON", (longitude, "°"))),
            "145": (100.0, "FL"),
            "160": (("RE", 0), ("GS", (0.1, "NM/s")), ("TA", (90.0, "°"))),
            "090": quality,
        },
    )


def lists(path, **settings):
    return list(open_input(path, InputConfig(**settings)).messages())


def test_a_report_of_an_aircraft_has_both_times_identity_and_accuracy(tmp_path):
    (tmp_path / "a.ast").write_bytes(
        aircraft(100.5, 100.75, 41.31, 2.08) + aircraft(99.5, 101.0, 41.3, 2.09, nacp=0)
    )
    assert input_kind(tmp_path) == input_kind(tmp_path / "a.ast") == "asterix"
    first, second = lists(tmp_path / "a.ast", origin=AIRPORT)
    (item,) = first.objects
    assert (first.sensor, first.frame, first.stamp_ns, first.receipt_ns) == (
        "adsb",
        "map",
        100_500_000_000,
        100_750_000_000,
    )
    assert (item.id, item.y_m) == ("4CACAA", pytest.approx(1110.7, abs=1.0))
    assert (item.speed_mps, item.yaw_rad) == (
        pytest.approx(185.2, abs=0.3),
        pytest.approx(0.0, abs=1e-3),
    )
    assert item.z_m == pytest.approx(10_000 * 0.3048)
    assert math.sqrt(item.covariance[0]) == pytest.approx(30.0 / 2.4477)
    assert second.objects[0].covariance is None  # NACp 0: unknown, and a later version
    assert (second.stamp_ns, second.receipt_ns) == (99_500_000_000, 101_000_000_000)


#: 95 % radii of NACp 1 to 8 in nautical miles, and of 9 to 11 in metres, as the categories are defined.
NAUTICAL = (10.0, 4.0, 2.0, 1.0, 0.5, 0.3, 0.1, 0.05)
RADII_M = [*(1852.0 * each for each in NAUTICAL), 30.0, 10.0, 3.0]


@pytest.mark.parametrize(("nacp", "radius_m"), [*enumerate(RADII_M, start=1)])
def test_an_accuracy_category_is_a_radius_with_a_probability_of_95_percent(
    nacp, radius_m, tmp_path
):
    (tmp_path / "a.ast").write_bytes(aircraft(100.5, 100.75, 41.31, 2.08, nacp=nacp))
    (one,) = lists(tmp_path / "a.ast", origin=AIRPORT)
    std_m = radius_m / math.sqrt(-2.0 * math.log(0.05))
    assert math.sqrt(one.objects[0].covariance[0]) == pytest.approx(std_m, rel=1e-4)


def test_the_items_of_the_times_are_settings(tmp_path):
    (tmp_path / "a.ast").write_bytes(aircraft(100.5, 100.75, 41.31, 2.08))
    (one,) = lists(
        tmp_path / "a.ast", asterix=AsterixInput(stamp={21: "077"}, receipt={21: "077"})
    )
    assert one.stamp_ns == one.receipt_ns == 100_750_000_000


def test_records_of_one_stamp_are_one_list_and_each_station_has_its_place(
    tmp_path, caplog
):
    smr = (
        surface(50.0, 100.0, 0.0) + surface(50.0, 200.0, 0.0) + surface(49.5, 0.0, 50.0)
    )
    (tmp_path / "smr.ast").write_bytes(smr)
    (tmp_path / "mlat.ast").write_bytes(
        surface(50.25, 0.0, 0.0, kind=1, address=0x4CA911, sic=107)
    )
    stations = {
        7: AIRPORT,
        107: Origin(AIRPORT.latitude_deg + 0.01, AIRPORT.longitude_deg),
    }
    first, late, other = lists(tmp_path, asterix=AsterixInput(stations=stations))
    assert [item.x_m for item in first.objects] == pytest.approx(
        [100.0, 200.0], abs=1e-3
    )
    assert (first.sensor, other.sensor) == ("smr", "mlat")
    assert (first.objects[0].speed_mps, first.objects[0].yaw_rad) == (
        5.0,
        pytest.approx(math.atan2(4.0, 3.0)),
    )
    assert late.receipt_ns - late.stamp_ns == 500_000_000  # the newest stamp before it
    assert other.objects[0].y_m == pytest.approx(1110.7, abs=1.0)
    assert other.objects[0].id == "4CA911"
    assert not caplog.records
    lists(tmp_path)  # the stations are 1.1 km apart
    (warning,) = caplog.records
    assert (
        "stations 107 and 7 (SIC) report positions relative to the station"
        in warning.message
    )


def test_extrapolated_positions_are_left_out(tmp_path):
    (tmp_path / "a.ast").write_bytes(
        surface(50.0, 100.0, 0.0) + surface(51.0, 120.0, 0.0, coasted=3)
    )
    assert [each.stamp_ns for each in lists(tmp_path / "a.ast")] == [50_000_000_000]


def test_stamps_go_on_at_midnight(tmp_path):
    (tmp_path / "a.ast").write_bytes(
        b"".join(surface(t, 0.0, 9.0) for t in (86_399.5, 0.5, 86_399.75, 1.0))
    )
    assert [each.stamp_ns / 1e9 for each in lists(tmp_path / "a.ast")] == [
        86_399.5,
        86_400.5,
        86_399.75,
        86_401.0,
    ]


STEP_S = 1.0 / 128.0
"""Resolution of the times."""


@pytest.mark.parametrize(
    "sent_s", [-2.0, -1.0, -0.25, -STEP_S, 0.0, STEP_S, 0.5, 30.0, 3600.0]
)
@pytest.mark.parametrize(
    "received_s", [0.0, STEP_S, 0.25, 100.5, 43_200.0, 86_399.5, 86_400.0 - STEP_S]
)
def test_the_delay_between_two_times_of_day_has_a_sign_and_crosses_midnight(
    tmp_path, received_s, sent_s
):
    (tmp_path / "a.ast").write_bytes(
        aircraft(received_s, (received_s + sent_s) % 86_400.0, 41.3, 2.08)
    )
    (one,) = lists(tmp_path / "a.ast")
    assert one.stamp_ns == round(received_s * 1e9)
    assert one.receipt_ns - one.stamp_ns == round(sent_s * 1e9)


def test_reports_that_are_sent_before_they_are_received_stay_on_their_day(tmp_path):
    times_s = [86_399.0 + 0.25 * k for k in range(40)]
    sent_s = [
        time_s + (-STEP_S if k % 4 == 0 else 0.5) for k, time_s in enumerate(times_s)
    ]
    reports = zip(times_s, sent_s, strict=True)
    (tmp_path / "a.ast").write_bytes(
        b"".join(
            aircraft(time_s % 86_400.0, end_s % 86_400.0, 41.3, 2.08)
            for time_s, end_s in reports
        )
    )
    found = lists(tmp_path / "a.ast")
    assert [each.stamp_ns for each in found] == [
        round(time_s * 1e9) for time_s in times_s
    ]
    newest_s = [max(sent_s[: k + 1]) for k in range(len(sent_s))]
    assert [each.receipt_ns for each in found] == [
        round(time_s * 1e9) for time_s in newest_s
    ]


def test_a_first_report_of_just_after_midnight_that_was_sent_before_moves_no_other(
    tmp_path,
):
    reports = ((STEP_S, 86_400.0 - STEP_S), (0.25, 0.75), (86_399.75, 0.5), (1.0, 1.25))
    (tmp_path / "a.ast").write_bytes(
        b"".join(aircraft(*times_s, 41.3, 2.08) for times_s in reports)
    )
    assert [each.stamp_ns / 1e9 for each in lists(tmp_path / "a.ast")] == [
        STEP_S,
        0.25,
        -0.25,
        1.0,
    ]


def test_a_damaged_file_is_one_line_behind_what_is_before(tmp_path):
    whole = surface(50.0, 100.0, 0.0)
    (tmp_path / "a.ast").write_bytes(whole + whole[:-3])
    readable = UntilBreak(open_input(tmp_path / "a.ast").messages())
    assert [each.stamp_ns for each in readable] == [50_000_000_000]
    assert f"breaks off in the block at byte {len(whole)}" in str(readable.error)


def test_an_unknown_edition_is_named(tmp_path):
    (tmp_path / "a.ast").write_bytes(surface(50.0, 100.0, 0.0))
    with pytest.raises(
        Exception, match=r"category 21 has no edition 9\.9, choose from 0\.23"
    ):
        lists(tmp_path / "a.ast", asterix=AsterixInput(editions={21: "9.9"}))


def test_numbers_behind_compound_extended_and_repeated_items_are_those_of_the_library(
    tmp_path,
):
    from asterix.base import Bits

    record = {
        "010": (("SAC", 1), ("SIC", 2)),
        "070": (36_000.5, "s"),
        "105": (("LAT", (41.3, "°")), ("LON", (-2.08, "°"))),
        "185": (("VX", (-3.25, "m/s")), ("VY", (4.0, "m/s"))),
        "380": {"ADR": 0x4CA911, "ID": "ABC123", "MHG": (90.0, "°")},
        "080": ((0, 0, 0, 0, 0, None), (1, 0, 0, 0, 0, 0, 0, None)),
        "290": {"TRK": (1.0, "s"), "SSR": (2.0, "s")},
        "136": (100.0, "FL"),
        "510": [(1, 2), (3, 4)],
    }
    raw = block(edition("Cat_062_1_21"), record, record)
    names = [
        "070",
        "105/LAT",
        "105/LON",
        "185/VX",
        "185/VY",
        "380/ADR",
        "136",
        "290/SSR",
    ]
    both = list(RecordReader(edition("Cat_062_1_21"), names, {})(raw[3:]))
    (own, _) = edition("Cat_062_1_21").cv_uap.parse(Bits.from_bytes(raw[3:]))
    expected = {}
    for name in names:
        item, _, part = name.partition("/")
        variation = own.get_item(item).variation
        content = (variation.get_item(part).variation if part else variation).content
        expected[name] = (
            content.as_quantity()
            if hasattr(content, "as_quantity")
            else content.as_uint()
        )
    assert both == [expected, expected]
    (tmp_path / "a.ast").write_bytes(raw)
    (one,) = lists(tmp_path / "a.ast")
    assert (one.sensor, one.objects[0].id, one.objects[0].speed_mps) == (
        "system",
        "4CA911",
        math.hypot(3.25, 4.0),
    )


def test_a_block_that_ends_inside_a_record_is_named(tmp_path):
    whole = surface(50.0, 100.0, 0.0)
    damaged = whole[:1] + (len(whole) - 1).to_bytes(2, "big") + whole[3:-1]
    (tmp_path / "a.ast").write_bytes(whole + damaged)
    readable = UntilBreak(open_input(tmp_path / "a.ast").messages())
    assert len(list(readable)) == 1
    assert f"cannot decode category 10 at byte {len(whole)}" in str(readable.error)


@pytest.mark.parametrize("ending", [".raw", ".asterix", ".bin"])
def test_a_recording_is_recognised_by_its_blocks(tmp_path, ending):
    content = b"".join(surface(50.0 + k, 100.0, 0.0) for k in range(5))
    file = tmp_path / f"airport{ending}"
    file.write_bytes(content)
    assert input_kind(file) == input_kind(tmp_path) == "asterix"
    assert len(lists(tmp_path)) == 5
    file.write_bytes(bytes(range(256)) * 8)
    with pytest.raises(DataError, match="has a format that fgtrack does not read"):
        input_kind(file)


@pytest.mark.parametrize("wrong_s", [3700.0, 30_000.0, -7200.0])
@pytest.mark.parametrize("number", [0, 30, 59])
def test_a_report_with_a_wrong_time_is_left_out_and_counted(tmp_path, wrong_s, number):
    times = [40_000.0 + k for k in range(60)]
    times[number] += wrong_s
    (tmp_path / "a.ast").write_bytes(
        b"".join(surface(time_s, 100.0 + k, 0.0) for k, time_s in enumerate(times))
    )
    read = lists(tmp_path)
    kept = [each.stamp_ns // 10**9 - 40_000 for each in read]
    assert kept == [k for k in range(60) if k != number]
    assert all(each.receipt_ns == each.stamp_ns for each in read)
    counted = [reason for each in read for reason in each.left_out]
    assert counted == ["wrong time"]


def test_a_wrong_transmission_time_delays_no_other_report(tmp_path):
    reports = [
        aircraft(40_000.0 + k, 40_000.5 + k + 5000.0 * (k == 20), 41.3, 2.08)
        for k in range(60)
    ]
    (tmp_path / "a.ast").write_bytes(b"".join(reports))
    read = lists(tmp_path)
    assert len(read) == 59
    assert {each.receipt_ns - each.stamp_ns for each in read} == {5 * 10**8}


def test_times_continue_after_midnight_with_delays_of_either_sign(tmp_path):
    reports = [
        aircraft(
            (86_390.0 + k) % 86_400, (86_390.0 + k + d) % 86_400, 41.3, 2.08, address=k
        )
        for k in range(20)
        for d in [(-1 / 128, 0.0, 0.5)[k % 3]]
    ]
    (tmp_path / "a.ast").write_bytes(b"".join(reports))
    read = lists(tmp_path)
    assert [round(each.stamp_ns / 1e9) for each in read] == list(range(86_390, 86_410))
    assert max(each.receipt_ns - each.stamp_ns for each in read) == 5 * 10**8
