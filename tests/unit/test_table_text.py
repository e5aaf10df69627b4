"""Tables as people export them: encodings, separators, headers, decimal commas, dates."""

import gzip
from datetime import UTC, datetime

import pytest

from fgtrack.core.errors import DataError
from fgtrack.inputs.formats.tables import rows
from fgtrack.inputs.formats.time_texts import form_of
from fgtrack.inputs.settings import CsvInput, CsvTable, InputConfig
from fgtrack.inputs.source import open_input

HEADER = ("time", "x", "y")
ROWS = [("0.5", "-1.25", "20"), ("1.5", "2.125", "-3.75"), ("2", "0", "1e3")]


def read(file, delimiter=None):
    """Header and rows as lists of cells."""
    (_, header), *rest = rows(file, delimiter)
    return list(header), [list(cells.values()) for _, cells in rest]


def lines(separator=",", end="\n", comma=False, header=HEADER):
    every = [header, *ROWS] if header else ROWS
    return "".join(
        separator.join(
            cell.replace(".", ",") if comma and number else cell for cell in row
        )
        + end
        for number, row in enumerate(every)
    )


@pytest.mark.parametrize(
    "content",
    [
        lines().encode(),
        lines(end="\r\n").encode("utf-8-sig"),
        lines(end="\r").encode(),
        lines("\t").encode("utf-16"),
        lines("\t").encode("utf-16-le"),
        lines(";").encode("utf-16-be"),
        lines().encode("utf-32"),
        lines("|").encode(),
        lines(" ").encode(),
        lines("   ").encode(),
        lines(";", comma=True).encode(),
        lines("\t", comma=True, end="\r\n").encode("utf-16"),
        lines(", ").encode(),
        ("sep=;\n" + lines(";", comma=True)).encode(),
        ("\n\n" + lines()).encode(),
        ("# exported on Tuesday\n# by me, too, and so on\n" + lines()).encode(),
        gzip.compress(lines(";", comma=True).encode("utf-8-sig"), mtime=0),
        lines(end=",\n").encode(),
        lines(end=",,,\n").encode(),
        (lines().replace("\n", ",,\n", 1)).encode(),
        b'"time","x","y"\n"0.5","-1.25","20"\n"1.5","2.125","-3.75"\n"2","0","1e3"\n',
    ],
)
def test_the_same_table_in_many_forms(tmp_path, content):
    (tmp_path / "a.csv").write_bytes(content)
    header, cells = read(tmp_path / "a.csv")
    assert [name for name in header if name] == list(HEADER)
    assert [[float(cell) for cell in row[:3]] for row in cells] == [
        [float(cell) for cell in row] for row in ROWS
    ]


def test_a_comment_before_the_first_row_is_the_header_if_it_has_as_many_cells(tmp_path):
    (tmp_path / "a.txt").write_text("# timestamp tx ty\n0.5 1 2\n1.5 2 3\n")
    assert read(tmp_path / "a.txt") == (
        ["timestamp", "tx", "ty"],
        [["0.5", "1", "2"], ["1.5", "2", "3"]],
    )
    (tmp_path / "b.csv").write_text("# Timestamp,MMSI\n14/11/2023 22:13:20,5\n")
    assert read(tmp_path / "b.csv")[0] == ["# Timestamp", "MMSI"]


def test_a_trajectory_without_a_header_is_recognised_by_its_quaternions(tmp_path):
    (tmp_path / "a.txt").write_text("0.5 1 2 0 0 0 0 1\n1.5 2 3 0 0 0 0.6 0.8\n")
    header, cells = read(tmp_path / "a.txt")
    assert header == ["timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]
    assert len(cells) == 2


@pytest.mark.parametrize(
    "text",
    [
        lines(header=None),
        lines(";", header=None, comma=True),
        "2023-11-14T22:13:20Z,1,2\n2023-11-14T22:13:21Z,1,2\n",
        "0,1,2\n0.5,1,2\n",
        "0.5 1 2 0 0 0 0 7\n1.5 2 3 0 0 0 0.6 0.8\n",
    ],
)
def test_a_table_without_names_is_one_clear_line(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(DataError, match=r"a\.csv:1: has no header, its first line"):
        read(tmp_path / "a.csv")


def test_words_of_another_language_are_read(tmp_path):
    (tmp_path / "a.csv").write_bytes("Zeit;Höhe °;x\n1;2;3\n".encode("cp1252"))
    assert read(tmp_path / "a.csv")[0] == ["Zeit", "Höhe °", "x"]


def test_commas_stay_in_a_table_with_points(tmp_path):
    (tmp_path / "a.csv").write_text("t;x;flags\n0.5;1.5;1,2\n1.5;2.5;3,4\n")
    assert read(tmp_path / "a.csv")[1] == [["0.5", "1.5", "1,2"], ["1.5", "2.5", "3,4"]]


def test_points_of_thousands_are_removed_beside_decimal_commas(tmp_path):
    (tmp_path / "a.csv").write_text("t;x\n0,5;1.234,5\n1,5;-12.345.678,25\n")
    assert read(tmp_path / "a.csv")[1] == [["0.5", "1234.5"], ["1.5", "-12345678.25"]]


def test_a_wrong_row_names_its_line_behind_comments(tmp_path):
    (tmp_path / "a.csv").write_text("# a\n\n" + lines() + "1,2\n")
    with pytest.raises(DataError, match=r"a\.csv:7: has 2 cells, but the header has 3"):
        read(tmp_path / "a.csv")


START = datetime(2023, 11, 14, 22, 13, 20, 123456, tzinfo=UTC)


@pytest.mark.parametrize(
    "form",
    [
        "%Y-%m-%dT%H:%M:%S.%fZ",
        "%Y-%m-%d %H:%M:%S,%f",
        "%Y/%m/%d %H:%M:%S.%f",
        "%Y%m%dT%H%M%S.%f",
        "%d/%m/%Y %H:%M:%S.%f",
        "%m/%d/%Y %H:%M:%S.%f",
        "%m/%d/%Y %I:%M:%S.%f %p",
        "%d.%m.%Y %H:%M:%S.%f",
        "%d.%m.%y %H:%M:%S,%f",
        "%d-%b-%Y %H:%M:%S.%f",
        "%b %d, %Y %H:%M:%S.%f",
        "%a, %d %b %Y %H:%M:%S.%f GMT",
        "%Y-%m-%d %H:%M:%S.%f+0000",
        "%Y-%m-%d %H:%M:%S.%f UTC",
        "%d/%m/%Y %H:%M:%S:%f",
    ],
)
def test_dates_are_read_in_many_forms(form):
    text = START.strftime(form)
    found = form_of([text])
    assert found is not None
    assert found.time_ns(text) == 1_700_000_000_123_456_000


def test_a_zone_is_subtracted_and_digits_are_exact():
    text = "2023-11-14T17:13:20.123456789-05:00"
    found = form_of([text])
    assert found is not None
    assert found.time_ns(text) == 1_700_000_000_123_456_789


def test_the_order_of_day_and_month_follows_from_the_whole_column():
    day_first = [f"{day:02}/11/2023 22:13:20" for day in range(9, 15)]
    month_first = [f"11/{day:02}/2023 22:13:20" for day in range(9, 15)]
    for texts in (day_first, month_first):
        form = form_of(texts)
        assert form is not None
        assert form.time_ns(texts[-1]) == 1_700_000_000 * 10**9
    over_midnight = ["11/03/2023 23:59:59", "11/04/2023 00:00:01"]
    form = form_of(over_midnight)
    assert form is not None
    assert form.time_ns(over_midnight[1]) - form.time_ns(over_midnight[0]) == 2 * 10**9


@pytest.mark.parametrize(
    "text", ["1700000000.5", "noon", "", "12", "2023-11-14", "1:2"]
)
def test_other_texts_are_no_dates(text):
    assert form_of([text]) is None


def stamps_s(folder, **tables):
    """Stamps of all messages of `a.csv` in `folder`."""
    config = InputConfig(csv=CsvInput(detections={"radar": CsvTable(**tables)}))
    return [each.stamp_ns / 1e9 for each in open_input(folder, config).messages()]


COLUMNS = {"stamp": "time", "x_m": "x", "y_m": "y"}


def test_times_of_day_continue_after_midnight(tmp_path):
    times = ["23:59:59.5", "23:59:59.9", "00:00:00.1", "00:00:00.3"]
    (tmp_path / "a.csv").write_text(
        "time,x,y\n" + "".join(f"{time},1,2\n" for time in times)
    )
    assert stamps_s(tmp_path / "a.csv", columns=COLUMNS) == pytest.approx(
        [86399.5, 86399.9, 86400.1, 86400.3]
    )


def test_a_time_of_day_has_the_date_of_the_receipt(tmp_path):
    (tmp_path / "a.csv").write_text(
        "time,seen,x,y\n23:59:59.9,2023-11-15 00:00:00.1,1,2\n"
        "00:00:00.4,2023-11-15 00:00:00.6,1,2\n"
    )
    columns = {**COLUMNS, "receipt": "seen"}
    midnight_s = datetime(2023, 11, 15, tzinfo=UTC).timestamp()
    assert stamps_s(tmp_path / "a.csv", columns=columns) == pytest.approx(
        [midnight_s - 0.1, midnight_s + 0.4]
    )


def test_date_and_time_in_two_columns(tmp_path):
    (tmp_path / "a.csv").write_text(
        "date,time,x,y\n14/11/2023,22:13:20.5,1,2\n14/11/2023,22:13:21,1,2\n"
    )
    columns = {**COLUMNS, "stamp": ["date", "time"]}
    assert stamps_s(tmp_path / "a.csv", columns=columns) == [1.7e9 + 0.5, 1.7e9 + 1.0]


@pytest.mark.parametrize(
    "bad", ["", "n/a", "2023-13-14 22:13:20", "0000-00-00 00:00:00"]
)
@pytest.mark.parametrize("is_date", [True, False])
def test_a_row_with_a_wrong_time_is_left_out_and_counted(tmp_path, bad, is_date):
    times = [
        f"2023-11-14 22:{13 + k // 60}:{k % 60:02}" if is_date else f"{k}.5"
        for k in range(60)
    ]
    times[33] = bad
    (tmp_path / "a.csv").write_text(
        "time,x,y\n" + "".join(f"{time},1,2\n" for time in times)
    )
    config = InputConfig(csv=CsvInput(detections={"radar": CsvTable(COLUMNS)}))
    read = list(open_input(tmp_path / "a.csv", config).messages())
    assert len(read) == 59
    assert read[0].left_out == ("wrong time",)


def test_many_wrong_times_end_a_table(tmp_path):
    times = ["1", "2", "noon", "noon", "5", "6"]
    (tmp_path / "a.csv").write_text(
        "time,x,y\n" + "".join(f"{time},1,2\n" for time in times)
    )
    with pytest.raises(DataError, match=r"a\.csv:4: time: 'noon' is not a time in s"):
        stamps_s(tmp_path / "a.csv", columns=COLUMNS)
