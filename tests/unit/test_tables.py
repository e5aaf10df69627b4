"""CSV files by a mapping of their columns."""

import gzip
import math
from dataclasses import replace
from pathlib import Path

import pytest

from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import validate
from fgtrack.core.errors import CallError, DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.formats.common import object_id
from fgtrack.inputs.settings import CsvInput, CsvTable, Field, Filter, InputConfig
from fgtrack.inputs.source import input_kind, open_input
from fgtrack.meaning.draft import opened
from fgtrack.pipeline.replay import replay_in_memory

EGO = CsvTable(
    {"stamp": "t", "x_m": "x", "y_m": "y", "yaw_rad": "yaw", "speed_mps": "v"},
    "ego.csv",
)
RADAR = CsvTable({"stamp": "t", "receipt": "seen", "x_m": "x", "y_m": "y"}, "radar.csv")
RADAR_TEXT = "t,seen,x,y\n1.0,1.1,30,2\n1.0,1.1,40,-2\n1.05,1.15,31,2\n"


def write(folder: Path, **files: str) -> Path:
    for name, text in files.items():
        (folder / f"{name}.csv").write_text(text, errors="surrogateescape")
    return folder


def messages(path: Path, **tables: object) -> list[Message]:
    return list(open_input(path, InputConfig(csv=CsvInput(**tables))).messages())


def test_rows_become_messages_in_the_order_of_receipt(tmp_path):
    ego = "t,x,y,yaw,v\n1.0,0,0,0.5,10\n1.12,1,0,0.5,10\n"
    truth = "t;id;px;py\n1.1;car_a;30.5;2\n"
    write(tmp_path, ego=ego, radar=RADAR_TEXT, truth=truth)
    cars = CsvTable(
        {"stamp": "t", "object_id": "id", "x_m": "px", "y_m": "py"}, "truth.csv"
    )
    assert messages(tmp_path, ego=EGO, detections={"radar": RADAR}, truth=cars) == [
        EgoState(1_000_000_000, 1_000_000_000, 0.0, 0.0, 0.5, 10.0),
        TruthState(1_100_000_000, 1_100_000_000, object_id("car_a"), 30.5, 2.0),
        DetectionList(
            "radar",
            1_000_000_000,
            1_100_000_000,
            (Detection(x_m=30.0, y_m=2.0), Detection(x_m=40.0, y_m=-2.0)),
        ),
        EgoState(1_120_000_000, 1_120_000_000, 1.0, 0.0, 0.5, 10.0),
        DetectionList(
            "radar", 1_050_000_000, 1_150_000_000, (Detection(x_m=31.0, y_m=2.0),)
        ),
    ]
    assert input_kind(tmp_path) == input_kind(tmp_path / "radar.csv") == "csv"


def test_one_file_may_hold_everything(tmp_path):
    """Rows are told apart by a filter; a compass in degrees, milliseconds and km/h are converted."""
    path = tmp_path / "log.csv"
    path.write_text(
        "kind\tms\ta\tb\theading\tkmh\tsnr\n"
        "ego\t1500.25\t1\t2\t350\t36\t\n"
        "radar\t1500.5\t10\t\t-10\t\t9\n"
        "radar\t1500.5\t20\t\t5\t\t3\n"
    )
    heading = Field("heading", scale=-1.0, offset=90.0, degrees=True)
    ego = {
        "stamp": "ms",
        "x_m": "a",
        "y_m": "b",
        "yaw_rad": heading,
        "speed_mps": Field("kmh", scale=1 / 3.6),
    }
    radar = {
        "stamp": "ms",
        "range_m": "a",
        "bearing_rad": Field("heading", scale=-1.0, degrees=True),
    }
    found = messages(
        path,
        ego=CsvTable(ego, time_unit="ms", filters={"kind": Filter(one_of=("ego",))}),
        detections={
            "radar": CsvTable(
                radar,
                time_unit="ms",
                frame="sensor",
                filters={"kind": Filter(one_of=("radar",)), "snr": Filter(min=6.0)},
            )
        },
    )
    assert found[0] == EgoState(
        1_500_250_000,
        1_500_250_000,
        1.0,
        2.0,
        pytest.approx(math.radians(100.0)),
        pytest.approx(10.0),
    )
    assert sorted(found[1].left_out) == ["filters.kind", "filters.snr"]
    bearing_rad = pytest.approx(math.radians(10.0))
    assert found[1:] == [
        DetectionList(
            "radar",
            1_500_500_000,
            1_500_500_000,
            (Detection(range_m=10.0, bearing_rad=bearing_rad),),
            "sensor",
        )
    ]


def test_where_no_row_passes_an_empty_list_says_what_was_left_out(tmp_path):
    write(tmp_path, radar=RADAR_TEXT)
    (found,) = messages(
        tmp_path, detections={"radar": replace(RADAR, filters={"x": Filter(min=50.0)})}
    )
    assert (found.stamp_ns, found.objects, found.left_out) == (
        1_000_000_000,
        (),
        ("filters.x",) * 3,
    )


def test_an_empty_cell_is_not_given_and_a_row_without_a_measurement_is_a_scan_that_saw_nothing(
    tmp_path,
):
    write(tmp_path, radar="t,seen,x,y,v,name\n1,1,30,2,,car\n2,2,,,,\n3,3,nan,2,5,\n")
    columns = {**RADAR.columns, "speed_mps": "v", "class_name": "name"}
    first, second, third = messages(
        tmp_path, detections={"radar": CsvTable(columns, "radar.csv")}
    )
    assert first.objects == (Detection(x_m=30.0, y_m=2.0, class_name="car"),)
    assert second.objects == ()
    assert math.isnan(third.objects[0].x_m)
    assert third.objects[0].speed_mps == 5.0


def test_times_keep_all_their_digits(tmp_path):
    write(tmp_path, radar="t,seen,x,y\n1700000000.123456789,1700000000.2,1,2\n")
    (found,) = messages(tmp_path, detections={"radar": RADAR})
    assert (found.stamp_ns, found.receipt_ns) == (
        1_700_000_000_123_456_789,
        1_700_000_000_200_000_000,
    )
    late = CsvTable(RADAR.columns, "radar.csv", stamp_from="receipt")
    (found,) = messages(tmp_path, detections={"radar": late})
    assert found.stamp_ns == found.receipt_ns == 1_700_000_000_200_000_000
    assert messages(tmp_path, truth=late) == [
        TruthState(found.stamp_ns, found.stamp_ns, 0, 1.0, 2.0)
    ]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (
            "t,seen,x\n1,1,2\n",
            r"radar\.csv:1: has no column 'y'; its columns are t, seen, x",
        ),
        (
            "t,seen,x,y,x\n",
            r"radar\.csv:1: two columns have the same name: t, seen, x, y, x",
        ),
        (RADAR_TEXT + "2,2,far,1\n", r"radar\.csv:5: x: 'far' is not a number"),
        (RADAR_TEXT + "noon,2,1,1\n", r"radar\.csv:5: t: 'noon' is not a time"),
        (
            RADAR_TEXT + "1e999999999,2,1,1\n",
            r"radar\.csv:5: t: '1e999999999' is not a time",
        ),
        (
            RADAR_TEXT + "1e15,2,1,1\n",
            r"radar\.csv:5: t: '1e15' is not a time in s: correct the cell or `time_unit`",
        ),
        (RADAR_TEXT + "2,2,1\n", r"radar\.csv:5: has 3 cells, but the header has 4"),
        (
            RADAR_TEXT + '2,2,"' + "1" * 200_000 + '",1\n',
            r"radar\.csv:4: cannot be read any further \(field larger",
        ),
        (RADAR_TEXT + "2,2,\udcff,1\n", r"radar\.csv:5: x: '.' is not a number"),
        ("", r"radar\.csv:1: has no column 't'"),
    ],
)
def test_a_damaged_file_is_one_line_and_what_is_before_it_is_replayed(
    tmp_path, text, complaint
):
    write(
        tmp_path,
        ego="t,x,y,yaw,v\n" + "".join(f"{k / 10},0,0,0,1\n" for k in range(30)),
        radar=text,
    )
    config = InputConfig(csv=CsvInput(EGO, {"radar": RADAR}))
    readable = UntilBreak(open_input(tmp_path, config).messages())
    with pytest.raises(DataError, match=complaint) as caught:  # noqa: PT012 - wrong from the start, or at a row
        list(readable)
        readable.raise_error()
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300
    if text.startswith(RADAR_TEXT):
        run = replay_in_memory(open_input(tmp_path, config).messages(), Config())
        assert run.meta["broken_off"] == str(caught.value)
        assert run.tables["detections"].num_rows == 3


@pytest.mark.parametrize(
    ("unit", "times", "complaint"),
    [
        (
            "ns",
            [f"{1_700_000_000 + 0.05 * k:.2f}" for k in range(30)],
            r"radar\.csv: .*probably in s since 1970: change `time_unit`",
        ),
        (
            "ns",
            [f"{0.05 * k:.2f}" for k in range(100)],
            r"radar\.csv: .*change `time_unit` \(input\.csv\.detec",
        ),
        (
            "s",
            [f"{1_700_000_000_000 + 50 * k}" for k in range(30)],
            r"radar\.csv:2: t: .*not a time in s: correct the cell or `time_unit`",
        ),
    ],
)
def test_times_in_another_unit_name_file_and_key(tmp_path, unit, times, complaint):
    write(tmp_path, radar="t,x,y\n" + "".join(f"{time},1,2\n" for time in times))
    with pytest.raises(DataError, match=complaint):
        messages(
            tmp_path,
            detections={
                "radar": CsvTable(
                    {"stamp": "t", "x_m": "x", "y_m": "y"}, "radar.csv", unit
                )
            },
        )


@pytest.mark.parametrize(
    ("unit", "factor"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)]
)
def test_times_in_their_unit_are_read(tmp_path, unit, factor):
    for start_s in (0.0, 1.7, 1_700_000_000.0):
        write(
            tmp_path,
            radar="t,x,y\n"
            + "".join(f"{(start_s + 0.05 * k) * factor!r},1,2\n" for k in range(30)),
        )
        table = CsvTable({"stamp": "t", "x_m": "x", "y_m": "y"}, "radar.csv", unit)
        assert len(messages(tmp_path, detections={"radar": table})) == 30


def test_an_angle_of_many_turns_is_not_wrapped_as_it_may_be_in_degrees(tmp_path):
    write(tmp_path, radar="t,a\n1,10\n2,290\n")
    compass = Field("a", scale=-1.0, offset=90.0)
    table = CsvTable({"stamp": "t", "bearing_rad": compass}, "radar.csv")
    assert [
        item.objects[0].bearing_rad
        for item in messages(tmp_path, detections={"radar": table})
    ] == [80.0, -200.0]
    table = replace(
        table, columns={"stamp": "t", "bearing_rad": replace(compass, degrees=True)}
    )
    (north, south) = [
        item.objects[0].bearing_rad
        for item in messages(tmp_path, detections={"radar": table})
    ]
    assert (north, south) == pytest.approx((math.radians(80.0), math.radians(160.0)))


@pytest.mark.parametrize(
    ("role", "columns", "complaint"),
    [
        (
            "ego",
            {"stamp": "t"},
            r"input\.csv\.ego\.columns: must name stamp, x_m, y_m$",
        ),
        (
            "truth",
            {"stamp": "t"},
            r"input\.csv\.truth\.columns: must name stamp, x_m, y_m$",
        ),
        (
            "radar",
            {"x_m": "x"},
            r"input\.csv\.detections\.radar\.columns: must name stamp",
        ),
        ("radar", {"stamp": "t", "speed": "v"}, "unknown component 'speed'"),
        (
            "radar",
            {"stamp": "t", "score": "x"},
            "stamp and a measured component, one of x_m",
        ),
    ],
)
def test_a_mapping_that_does_not_fit_is_one_line(tmp_path, role, columns, complaint):
    write(tmp_path, radar=RADAR_TEXT)

    def tables(table):
        return {"detections": {"radar": table}} if role == "radar" else {role: table}

    with pytest.raises(CallError, match=complaint):
        messages(tmp_path, **tables(CsvTable(columns, "radar.csv")))
    with pytest.raises(CallError, match=r"is a folder, so .* must name its file"):
        messages(tmp_path, detections={"radar": CsvTable({"stamp": "t", "x_m": "x"})})
    with pytest.raises(
        CallError, match=r"name its columns in input\.csv: radar\.csv has t, seen, x, y"
    ):
        messages(tmp_path)


def test_the_mapping_is_written_in_the_configuration(tmp_path):
    write(tmp_path, radar=RADAR_TEXT)
    columns = {"stamp": "t", "x_m": "x", "y_m": {"path": "y", "scale": -1}}
    raw = {
        "input": {
            "csv": {"detections": {"radar": {"file": "radar.csv", "columns": columns}}}
        }
    }
    (first, _) = open_input(tmp_path, validate(Config, raw, "test").input).messages()
    assert [item.y_m for item in first.objects] == [-2.0, 2.0]


REPORTS = {
    "flights.csv": "time,received,lat,lon,icao24\n10,11,41.3,2.08,4ca911\n12,14,41.31,2.08,4ca911\n",
    "ships.csv": "t;mmsi;latitude;longitude\n10;244730036;41.3;2.08\n12;244730036;41.31;2.08\n",
    "cars.txt.gz": "pub_time(ms) sub_time(ms) utmX(m) utmY(m) v \n1000 1100 0.0 0.0 1 \n1200 1300 0.0 1110.7 1 \n",
}


@pytest.mark.parametrize(
    ("name", "sensor", "delay_s"),
    [
        (n, s, d)
        for n, s, d in zip(
            REPORTS, ("adsb", "ais", "reports"), (2.0, 0.0, 0.1), strict=True
        )
    ],
)
def test_position_reports_need_no_mapping(tmp_path, name, sensor, delay_s):
    text = REPORTS[name].encode()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    for path in (tmp_path, tmp_path / name):
        last = list(opened(path).source.messages())[-1]
        assert isinstance(last, DetectionList)
        assert (last.sensor, last.frame) == (sensor, "map")
        assert (last.receipt_ns - last.stamp_ns) / 1e9 == delay_s
        assert last.objects[0].y_m == pytest.approx(1110.7, abs=0.5)


def test_several_tables_of_reports_are_several_sensors(tmp_path):
    for name in ("flights.csv", "ships.csv"):
        (tmp_path / name).write_text(REPORTS[name])
    messages = list(opened(tmp_path).source.messages())
    assert {(each.sensor, each.frame) for each in messages} == {
        ("flights", "map"),
        ("ships", "map"),
    }


@pytest.mark.parametrize(
    ("text", "time_ns"),
    [
        ("2024-01-02 07:41:03Z.515", 1704181263_515000000),
        ("2024-01-02T07:41:03.515Z", 1704181263_515000000),
        ("2024-01-02T08:41:03+01:00", 1704181263_000000000),
    ],
)
def test_times_may_be_dates(tmp_path, text, time_ns):
    (tmp_path / "a.csv").write_text(f"time,lat,lon\n{text},41.3,2.08\n")
    assert next(opened(tmp_path).source.messages()).stamp_ns == time_ns


def test_rows_that_repeat_a_position_are_left_out_and_unnamed_columns_ignored(tmp_path):
    (tmp_path / "a.csv").write_text(
        "time,lat,lon,hex,no_position,,\n1,41.3,2.08,0x4ca911,P,x,y\n2,41.3,2.08,0x4ca911,N,x,y\n"
    )
    (one,) = opened(tmp_path).source.messages()
    assert one.objects[0].id == "4CA911"
    assert one.left_out == ("filters.no_position",)


def test_one_wrong_clock_among_many_does_not_make_a_table_years_long(tmp_path):
    rows = "".join(f"2024-01-02 07:41:{k % 60:02}.{k},41.3,2.08\n" for k in range(120))
    (tmp_path / "a.csv").write_text(
        f"time,lat,lon\n1970-01-01 00:00:00,41.3,2.08\n{rows}"
    )
    read = list(opened(tmp_path).source.messages())
    assert len(read) == 120
    assert read[0].left_out == ("wrong receipt",)


def test_seconds_and_nanoseconds_in_two_columns_are_added(tmp_path):
    write(
        tmp_path,
        radar="s,ns,x,y\n1700000000,100000000,30,2\n1700000000,200000001,31,2\n",
    )
    table = CsvTable({"stamp": ["s", "ns"], "x_m": "x", "y_m": "y"}, "radar.csv")
    assert [each.stamp_ns for each in messages(tmp_path, detections={"r": table})] == [
        1_700_000_000_100_000_000,
        1_700_000_000_200_000_001,
    ]


def test_three_columns_are_no_time(tmp_path):
    write(tmp_path, radar="a,b,c,x,y\n1,2,3,30,2\n")
    table = CsvTable({"stamp": ["a", "b", "c"], "x_m": "x", "y_m": "y"}, "radar.csv")
    with pytest.raises(DataError, match="one column, or seconds and nanoseconds"):
        messages(tmp_path, detections={"r": table})


def test_a_relative_velocity_gives_its_part_along_the_line_of_sight(tmp_path):
    write(tmp_path, radar="t,x,y,vx,vy\n1,30,40,-5,10\n2,30,40,,10\n3,0,-20,7,4\n")
    columns = {"stamp": "t", "x_m": "x", "y_m": "y", "range_rate_mps": ["vx", "vy"]}
    read = messages(tmp_path, detections={"r": CsvTable(columns, "radar.csv")})
    rates = [each.objects[0].range_rate_mps for each in read]
    assert rates[0] == pytest.approx(-5.0 * 0.6 + 10.0 * 0.8)
    assert rates[1] is None
    assert rates[2] == pytest.approx(-4.0)


def test_a_relative_velocity_may_have_a_unit_and_belong_to_a_bearing(tmp_path):
    write(tmp_path, radar="t,r,b,vx,vy\n1,50,1.5707963,1,-36\n")
    rate = Field(["vx", "vy"], scale=1.0 / 3.6)
    columns = {"stamp": "t", "range_m": "r", "bearing_rad": "b", "range_rate_mps": rate}
    [read] = messages(tmp_path, detections={"r": CsvTable(columns, "radar.csv")})
    assert read.objects[0].range_rate_mps == pytest.approx(-10.0, abs=1e-6)


def test_a_relative_velocity_is_refused_for_positions_in_the_map(tmp_path):
    write(tmp_path, radar="t,x,y,vx,vy\n1,30,40,-5,10\n")
    columns = {"stamp": "t", "x_m": "x", "y_m": "y", "range_rate_mps": ["vx", "vy"]}
    table = CsvTable(columns, "radar.csv", frame="map")
    with pytest.raises(CallError, match="positions in the frame ego or sensor"):
        messages(tmp_path, detections={"r": table})


def test_numbers_that_mean_unknown_are_missing_values(tmp_path):
    write(tmp_path, radar="t,x,y,sog\n1,30,40,10\n2,31,40,102.3\n3,,,102.3\n")
    speed = Field("sog", scale=0.514444, unknown=(102.3,))
    columns = {"stamp": "t", "x_m": "x", "y_m": "y", "speed_mps": speed}
    read = messages(tmp_path, detections={"r": CsvTable(columns, "radar.csv")})
    assert read[0].objects[0].speed_mps == pytest.approx(5.14444)
    assert read[1].objects == (Detection(x_m=31.0, y_m=40.0),)
    assert read[2].objects == ()
