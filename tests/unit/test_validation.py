"""Whatever a reader meets: one line that names the place, and everything before it is there."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.errors import UntilBreak
from fgtrack.inputs.info import describe
from fgtrack.inputs.source import open_input
from fgtrack.inputs.stream import read_stream, write_stream
from fgtrack.inputs.validation import validated
from fgtrack.pipeline.replay import replay_in_memory

EGO = EgoState(1, 2, 0.0, 0.0, 0.0, 0.0)
TRUTH = TruthState(1, 2, 3, 0.0, 0.0)
LIST = DetectionList("radar", 1, 2, (Detection(x_m=1.0, y_m=2.0),))


def of(**fields: object) -> DetectionList:
    return replace(LIST, objects=(LIST.objects[0], replace(LIST.objects[0], **fields)))


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (replace(EGO, stamp_ns="1"), "stamp_ns: a 64 bit integer expected, not '1'"),
        (
            replace(LIST, stamp_ns=1 << 63),
            "stamp_ns: a 64 bit integer expected, not 9223372036854775808",
        ),
        (
            replace(LIST, receipt_ns=-(1 << 63)),
            "receipt_ns: at most 4e.18 ns from 0 expected, not -922",
        ),
        (
            replace(EGO, receipt_ns=4 * 10**18 + 1),
            "receipt_ns: at most 4e.18 ns from 0 expected",
        ),
        (
            replace(TRUTH, object_id="car"),
            "object_id: a 64 bit integer expected, not 'car'",
        ),
        (replace(EGO, x_m="1.0"), "x_m: a number expected, not '1.0'"),
        (replace(EGO, x_m=True), "x_m: a number expected, not True"),
        (replace(TRUTH, y_m=10**400), "y_m: a number expected, not 10"),
        (
            replace(EGO, covariance=(1.0, None, "x")),
            "covariance: a list of numbers expected",
        ),
        (replace(TRUTH, outline_m=[1.0]), "outline_m: x and y of at least"),
        (
            replace(TRUTH, outline_m=(0.0,) * 7),
            "outline_m: x and y of at least three corners",
        ),
        (replace(LIST, sensor=""), "sensor: a name expected, not ''"),
        (replace(LIST, sensor="\ud800"), r"sensor: a name .* not '\\ud800'"),
        (replace(EGO, in_pit=1), "in_pit: true or false expected, not 1"),
        (
            replace(LIST, frame="world"),
            "frame: one of ego, map, sensor expected, not 'world'",
        ),
        (
            replace(LIST, objects=({"x_m": 1.0},)),
            r"radar: objects\[0\]: a dict is not a detection",
        ),
        (
            of(speed_mps="fast"),
            r"radar: objects\[1\]: speed_mps: a number expected, not 'fast'",
        ),
        (of(stamp_ns=0.5), r"radar: objects\[1\]: stamp_ns: a 64 bit"),
        (of(object_id=1 << 64), r"radar: objects\[1\]: object_id: a 64 bit"),
        (of(covariance="1234"), r"radar: objects\[1\]: covariance: a list"),
        ("message", "a str is not a message"),
    ],
)
def test_what_is_no_message_ends_the_input_in_one_short_line(
    message: object, complaint: str
) -> None:
    readable = UntilBreak(
        validated(Path("drive"), lambda: iter([EGO, LIST, message, EGO]))
    )
    assert list(readable) == [EGO, LIST]
    with pytest.raises(DataError, match=f"^drive: message 3: {complaint}") as caught:
        readable.raise_error()
    assert len(str(caught.value)) < 400
    assert str(caught.value).isprintable()


def test_descriptions_that_are_not_finite_are_none_and_measurements_pass_as_they_are() -> (
    None
):
    given = Detection(
        x_m=float("inf"), score=float("nan"), length_m=float("-inf"), width_m=2.0
    )
    (found,) = validated(Path("drive"), lambda: iter([replace(LIST, objects=(given,))]))
    assert isinstance(found, DetectionList)
    assert found.objects == (Detection(x_m=float("inf"), width_m=2.0),)
    (same,) = validated(Path("drive"), lambda: iter([LIST]))
    assert same is LIST


def test_numbers_that_are_not_finite_and_those_of_numpy_pass() -> None:
    passing = [
        replace(EGO, x_m=float("nan")),
        of(
            x_m=float("inf"), speed_mps=np.float32(1.5), stamp_ns=np.int64(3), range_m=7
        ),
        replace(TRUTH, yaw_rad=None, stamp_ns=np.int64(1)),
        replace(LIST, objects=()),
    ]
    assert len(list(validated(Path("x"), lambda: iter(passing)))) == 4


@pytest.mark.parametrize(
    "error",
    [KeyError("x"), RecursionError("deep"), ZeroDivisionError(), UnicodeError("a\nb")],
)
def test_whatever_a_reader_raises_is_one_line(error: Exception) -> None:
    def messages() -> Iterator[Message]:
        yield EGO
        raise error

    with pytest.raises(
        DataError, match=r"^x: cannot be read beyond message 1 \([\w' ]+\): repair"
    ) as caught:
        list(validated(Path("x"), messages))
    assert "\n" not in str(caught.value)


def log(folder: Path, *, bad_byte: bool = False, time: object = 300) -> Path:
    """A log of the published tracker of which the third row is damaged."""
    ego = {"in_pit": False, "state": [1.0, 2.0, 3.0, 40.0, 0.1, -1.0]}
    rows = [
        [100 * k, {"radar": [[], 100 * k]}, ego | {"t": 100 * k}] for k in (1, 2, 3, 4)
    ]
    rows[2][0] = time
    text = [";".join(map(json.dumps, row)).encode() for row in rows]
    if bad_byte:
        text[2] = text[2].replace(b"radar", b"ra\xffar")
    folder.mkdir()
    (folder / "data_logs.csv").write_bytes(
        b"\n".join([b"time_ns;detection_input;ego_state", *text, b""])
    )
    return folder


@pytest.mark.parametrize(
    ("make", "complaint", "least"),
    [
        (
            lambda path: log(path, bad_byte=True),
            r"data_logs\.csv:4: .*bytes that are not text in UTF-8",
            4,
        ),
        (
            lambda path: log(path, time="noon"),
            r"message 5: receipt_ns: .* not 'noon'",
            4,
        ),
        (
            lambda path: log(path, time=float("inf")),
            "message 5: receipt_ns: .* not inf",
            4,
        ),
    ],
)
def test_a_damaged_input_is_replayed_converted_and_described_up_to_there(
    tmp_path, make, complaint, least
) -> None:
    path = make(tmp_path / "input")
    readable = UntilBreak(open_input(path).messages())
    messages = list(readable)
    assert isinstance(readable.error, DataError)
    assert readable.error.args == (str(readable.error),)
    with pytest.raises(DataError, match=complaint):
        readable.raise_error()
    assert len(messages) >= least
    problem = describe(path).problem
    assert problem is not None
    assert "\n" not in problem
    run = replay_in_memory(
        open_input(path).messages(), Config(ignore_sensors=("lidar_",))
    )
    assert run.meta["broken_off"] == str(readable.error)
    assert run.meta["complete"]
    with pytest.raises(DataError, match=complaint):
        write_stream(tmp_path / "out.jsonl", open_input(path).messages())
    assert list(read_stream(tmp_path / "out.jsonl")) == messages
