import gzip
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fgtrack.core.errors import CallError
from fgtrack.core.types import DetectionList, EgoState
from fgtrack.pipeline.clock import Delivered, listed_ticks, message_ticks, node_ticks, read_ticks

MS = 1_000_000
receipts = st.lists(st.integers(0, 300 * MS), max_size=20).map(sorted)


def received(*receipts_ns: int) -> list[Delivered]:
    return [DetectionList("lidar", 0, receipt_ns, ()) for receipt_ns in receipts_ns]


def told(ticks) -> list[tuple[int, list[int]]]:
    return [(tick.now_ns, [message.receipt_ns for message in tick.messages]) for tick in ticks]


def test_ticks_lie_on_multiples_of_the_period_from_the_first_receipt_to_the_last() -> None:
    found = told(node_ticks(received(25 * MS, 30 * MS, 81 * MS), 50.0))
    assert found == [(40 * MS, [25 * MS, 30 * MS]), (60 * MS, []), (80 * MS, []), (100 * MS, [81 * MS])]


def test_what_is_received_at_a_tick_is_delivered_with_it() -> None:
    found = told(node_ticks(received(40 * MS, 60 * MS, 60 * MS + 1), 50.0))
    assert found == [(40 * MS, [40 * MS]), (60 * MS, [60 * MS]), (80 * MS, [60 * MS + 1])]


@given(receipts_ns=receipts, node_hz=st.sampled_from([7.0, 20.0, 50.0, 333.0]))
def test_every_message_is_delivered_once_at_the_first_tick_after_it(receipts_ns: list[int], node_hz: float) -> None:
    step_ns = int(1e9 / node_hz)
    ticks = list(node_ticks(received(*receipts_ns), node_hz))
    assert [m.receipt_ns for tick in ticks for m in tick.messages] == receipts_ns
    for tick in ticks:
        assert tick.now_ns % step_ns == 0
        assert all(tick.now_ns - step_ns < m.receipt_ns <= tick.now_ns for m in tick.messages)
    assert (
        [tick.now_ns for tick in ticks] == [ticks[0].now_ns + k * step_ns for k in range(len(ticks))] if ticks else True
    )
    assert not ticks or (ticks[0].messages and ticks[-1].messages)


def test_without_a_period_every_receipt_is_a_tick() -> None:
    messages = [*received(5), EgoState(0, 5, 0.0, 0.0, 0.0, 0.0), *received(7, 7, 9)]
    assert told(message_ticks(messages)) == [(5, [5, 5]), (7, [7, 7]), (9, [9])]


@pytest.mark.parametrize("ticks", [lambda m: node_ticks(m, 50.0), message_ticks, lambda m: listed_ticks(m, [])])
def test_without_messages_there_are_no_ticks(ticks) -> None:
    assert list(ticks([])) == []


def test_listed_ticks_are_kept_and_one_more_takes_the_rest() -> None:
    assert told(listed_ticks(received(5, 10, 12, 30, 31), [1, 10, 20])) == [
        (1, []),
        (10, [5, 10]),
        (20, [12]),
        (31, [30, 31]),
    ]
    assert told(listed_ticks(received(5), [10, 20])) == [(10, [5]), (20, [])]


@pytest.mark.parametrize("name", ["ticks.jsonl", "ticks.jsonl.gz"])
def test_ticks_are_read_from_plain_and_gzipped_lines(tmp_path: Path, name: str) -> None:
    text = "".join(json.dumps({"now_ns": now_ns, "more": []}) + "\n" for now_ns in (3, 5, 8)).encode()
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith("gz") else text)
    assert read_ticks(tmp_path / name) == [3, 5, 8]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b'{"now_ns": 5}\n{"now_ns": 5}\n', "not ascending"),
        (b'{"later": 5}\n', "no list of ticks"),
        (b"5\n", "no list of ticks"),
        (b"text\n", "no list of ticks"),
        (b'{"now_ns": 1e999}\n', "an integer of 64 bits"),
        (b'{"now_ns": 5.5}\n', "an integer of 64 bits"),
        (b'{"now_ns": true}\n', "an integer of 64 bits"),
        (b'{"now_ns": "5"}\n', "an integer of 64 bits"),
        (b'{"now_ns": %d}\n' % 10**30, "an integer of 64 bits"),
        (b'{"now_ns": %b}\n' % (b"1" * 5000), "an integer of 64 bits"),
        (b"[" * 100_000, "no list of ticks"),
        (b'{"now_ns": 5, "more": "%b"}\n' % (b"x" * (1 << 20)), "a line of ticks with more than"),
        (b"\xff\xfe", "no list of ticks"),
        (b"\x1f\x8bbroken", "ticks"),
        (gzip.compress(b'{"now_ns": 5}\n')[:-9], "no list of ticks"),
        (b"\x1f\x8b\x08" + 7 * b"\0" + b"\xff", "no list of ticks"),
        (None, "cannot be read"),
    ],
    ids=[
        *("not ascending", "no time", "no object", "no JSON", "infinite", "broken", "true", "a text", "too large"),
        *("too long", "too deep", "a long line", "no text", "no gzip", "cut off", "damaged", "missing"),
    ],
)
def test_a_file_that_is_no_list_of_ticks_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "ticks.jsonl"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CallError, match=message) as error:
        read_ticks(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_ticks_that_unpack_without_end_are_refused_in_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = b'{"now_ns": %d}' + b" " * 1000 + b"\n"
    path = tmp_path / "ticks.jsonl.gz"
    path.write_bytes(gzip.compress(b"".join(line % k for k in range(2000))))
    assert len(read_ticks(path)) == 2000
    monkeypatch.setattr("fgtrack.pipeline.clock._LARGEST_BYTES", 1 << 20)
    with pytest.raises(CallError, match=r"more than 1 MB of ticks, replay the recording in parts"):
        read_ticks(path)
