import gzip
import json
import logging
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import drive, exact, message_lists, shared

from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.inputs.errors import TruncatedInput, UntilBreak
from fgtrack.inputs.stream import read_header, read_stream, write_stream

HEADER = {"type": "header", "format": "fgtrack-stream/1"}
EGO = {
    "type": "ego",
    "stamp_ns": 1,
    "receipt_ns": 2,
    "x_m": 0,
    "y_m": 0,
    "yaw_rad": 0.0,
    "speed_mps": 1.5,
}
LIST = {
    "type": "detections",
    "sensor": "lidar",
    "stamp_ns": 1,
    "receipt_ns": 2,
    "frame": "ego",
    "objects": [],
}


def write_records(path: Path, *records: object) -> Path:
    path.write_text("".join(json.dumps(record) + "\n" for record in records))
    return path


@given(messages=message_lists(), suffix=st.sampled_from([".jsonl", ".jsonl.gz"]))
def test_what_is_written_is_read_to_the_bit(tmp_path_factory, messages, suffix):
    path = tmp_path_factory.mktemp("stream") / f"a{suffix}"
    assert write_stream(path, messages, {"note": "x"}) == len(messages)
    assert exact(list(read_stream(path))) == exact(messages)
    assert read_header(path)["note"] == "x"


def test_the_same_messages_give_the_same_bytes(tmp_path):
    for name in ("a.jsonl.gz", "b.jsonl.gz"):
        write_stream(tmp_path / name, drive())
    assert (tmp_path / "a.jsonl.gz").read_bytes() == (
        tmp_path / "b.jsonl.gz"
    ).read_bytes()


def test_gzip_is_recognised_by_content_and_not_by_name(tmp_path):
    write_stream(tmp_path / "a.jsonl.gz", drive())
    (tmp_path / "a.jsonl.gz").rename(tmp_path / "a.txt")
    assert list(read_stream(tmp_path / "a.txt")) == drive()


def test_what_is_none_is_not_written(tmp_path):
    message = DetectionList("lidar", 1, 2, (Detection(x_m=1.0, y_m=math.nan),))
    write_stream(tmp_path / "a.jsonl", [message])
    record = json.loads((tmp_path / "a.jsonl").read_text().splitlines()[1])
    assert record["objects"][0].keys() == {"x_m", "y_m"}
    assert record.keys() == LIST.keys()


def test_numpy_scalars_are_written_as_numbers(tmp_path):
    write_stream(
        tmp_path / "a.jsonl", [EgoState(np.int64(1), 2, np.float64(0.1), 0.0, 0.0, 1.0)]
    )
    assert list(read_stream(tmp_path / "a.jsonl")) == [
        EgoState(1, 2, 0.1, 0.0, 0.0, 1.0)
    ]


def test_a_reference_stream_survives_a_round_trip_to_the_byte(tmp_path):
    source = shared("reference/short10/stream.jsonl.gz")
    header = {
        key: value for key, value in read_header(source).items() if key not in HEADER
    }
    write_stream(tmp_path / "a.jsonl", read_stream(source), header)
    assert (tmp_path / "a.jsonl").read_bytes() == gzip.decompress(source.read_bytes())


def test_unknown_keys_are_ignored_and_counted_in_one_warning(tmp_path, caplog):
    path = write_records(
        tmp_path / "a.jsonl",
        HEADER,
        EGO | {"mood": 1},
        LIST | {"objects": [{"x_m": 1.0, "colour": "red"}, {"colour": "blue"}]},
    )
    with caplog.at_level(logging.WARNING):
        assert len(list(read_stream(path))) == 2
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: ignored unknown keys: ego.mood (1), objects.colour (2)"
    ]


@pytest.mark.parametrize(
    ("record", "complaint"),
    [
        (EGO | {"type": "egg"}, "unknown record type 'egg'"),
        ({key: value for key, value in EGO.items() if key != "x_m"}, "x_m: is missing"),
        (EGO | {"x_m": "1"}, "x_m: a number expected"),
        (EGO | {"x_m": True}, "x_m: a number expected"),
        (EGO | {"stamp_ns": 1 << 63}, "stamp_ns: a 64 bit integer expected"),
        (EGO | {"x_m": 10**400}, "x_m: "),
        (LIST | {"frame": []}, "frame: one of ego, map, sensor expected"),
        (LIST | {"objects": {}}, "objects: a list expected"),
        (LIST | {"objects": [{}, 3]}, "objects: a JSON object expected"),
        (EGO | {"covariance": [1.0, 2.0]}, "covariance: a list of 5 x 5"),
        ([], "is not a JSON object"),
    ],
)
def test_a_bad_record_is_one_line_with_file_and_line(tmp_path, record, complaint):
    path = write_records(tmp_path / "a.jsonl", HEADER, EGO, record)
    with pytest.raises(DataError) as caught:
        list(read_stream(path))
    assert str(caught.value).startswith(f"{path}:3: ")
    assert complaint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "nonsense\n",
        json.dumps(EGO) + "\n",
        '{"type": "header", "format": "fgtrack-stream/2"}\n',
        "[" * 10**5,
    ],
)
def test_what_does_not_start_with_the_header_is_no_stream(tmp_path, text):
    (tmp_path / "a.jsonl").write_text(text)
    with pytest.raises(DataError):
        list(read_stream(tmp_path / "a.jsonl"))


@pytest.mark.parametrize("name", ["a.jsonl", "a.jsonl.gz"])
@pytest.mark.parametrize("kept", [0.3, 0.7, 0.999])
def test_a_truncated_stream_gives_all_before_the_break_and_says_where_it_is(
    tmp_path, name, kept
):
    messages = drive()
    path = tmp_path / name
    write_stream(path, messages)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    readable = UntilBreak(read_stream(path))
    found = list(readable)
    assert found == messages[: len(found)]
    with pytest.raises(TruncatedInput, match=r"breaks off .* record") as caught:
        readable.raise_error()
    assert "\n" not in str(caught.value)
    if name.endswith("l"):
        assert len(found) == data[: int(len(data) * kept)].count(b"\n") - 1


def test_a_stream_without_a_last_newline_is_whole(tmp_path):
    write_stream(tmp_path / "a.jsonl", drive())
    (tmp_path / "a.jsonl").write_bytes((tmp_path / "a.jsonl").read_bytes()[:-1])
    assert list(read_stream(tmp_path / "a.jsonl")) == drive()


def test_a_killed_writer_leaves_a_readable_part_and_no_short_stream(tmp_path):
    def breaking():
        yield from drive()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_stream(tmp_path / "a.jsonl", breaking())
    assert not (tmp_path / "a.jsonl").exists()
    (part,) = tmp_path.glob("a.jsonl.*.part/a.jsonl")
    assert list(read_stream(part)) == drive()
