"""The loop of docs/live, and the benchmark that lasts an hour, for some seconds."""

import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from support.scripts import EXPERIMENTS, LIVE, load_file

import fgtrack
from fgtrack.core.types import TruthState

sys.path.insert(0, str(EXPERIMENTS))
import bench_live

LOOP = LIVE / "loop.py"


def test_the_loop_publishes_a_drive_and_accounts_for_every_detection() -> None:
    """By a clock that stands until the loop has done what is due: no verdict depends on the machine."""
    loop = load_file(LOOP, "live")
    tracker = fgtrack.Tracker.from_config("smoother", map="oval")
    sent = [
        m
        for m in fgtrack.simulate("single_opponent", seed=1, duration_s=1.5)
        if not isinstance(m, TruthState)
    ]
    clock_ns, polls = sent[0].receipt_ns, 0
    published: dict[int, tuple[fgtrack.TrackReport, ...]] = {}

    def now_ns() -> int:
        nonlocal polls
        polls += 1
        return clock_ns

    def source() -> Iterator[fgtrack.EgoState | fgtrack.DetectionList]:
        nonlocal clock_ns
        for message in sent:
            clock_ns, before = message.receipt_ns, polls
            while polls < before + 3:  # a due tick lies between two of them
                time.sleep(0.0001)
            yield message

    loop.run(tracker, source(), published.__setitem__, now_ns)
    stamps_ns = list(published)
    assert all(stamp_ns % loop.PERIOD_NS == 0 for stamp_ns in stamps_ns)
    passed = len(stamps_ns) - 1 + tracker.timing.skipped
    assert stamps_ns[-1] - stamps_ns[0] == passed * loop.PERIOD_NS > 1_300_000_000
    assert [track.stamp_ns for track in published[stamps_ns[-1]]] == [stamps_ns[-1]]
    received = Counter(
        m.sensor
        for m in sent
        if isinstance(m, fgtrack.DetectionList)
        for _ in m.objects
    )
    assert {
        sensor: sum(counts.values()) for sensor, counts in tracker.counts.items()
    } == received
    assert tracker.lateness["radar"].delay_median_s == pytest.approx(0.06, abs=0.01)
    assert tracker.refused == tracker.failures == {}


def test_the_loop_goes_on_publishing_after_the_clock_was_set_back() -> None:
    loop = load_file(LOOP, "live")
    tracker = fgtrack.Tracker.from_config("smoother", map="oval")
    begin_ns, polls, back_ns = 1_000 * fgtrack.NS_PER_S, 0, 0
    published = list[int]()

    def now_ns() -> int:
        nonlocal polls
        polls += 1
        return begin_ns + polls * 1_000_000 - back_ns

    def source() -> Iterator[fgtrack.EgoState]:
        nonlocal back_ns
        while polls < 1_000:
            time.sleep(0.0001)
        back_ns = 5 * fgtrack.NS_PER_S
        while polls < 2_000:
            time.sleep(0.0001)
        yield from ()

    loop.run(tracker, source(), lambda stamp_ns, _: published.append(stamp_ns), now_ns)
    assert tracker.refused["clock was set back, tracks ended"] == 1
    backwards = [b - a for a, b in pairwise(published) if b < a]
    assert len(backwards) == 1
    assert len(published) > 60


def test_the_drive_of_the_loop_keeps_the_stamps_of_the_simulation() -> None:
    drive = list(load_file(LOOP, "live").drive(duration_s=0.2))
    sent = [
        m
        for m in fgtrack.simulate("single_opponent", seed=1, duration_s=0.2)
        if not isinstance(m, TruthState)
    ]
    assert [m.stamp_ns - drive[0].stamp_ns for m in drive] == [
        m.stamp_ns - sent[0].stamp_ns for m in sent
    ]
    assert all(m.receipt_ns >= m.stamp_ns for m in drive)


def test_tracks_are_boxes_in_foxglove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    foxglove = pytest.importorskip("foxglove")
    monkeypatch.syspath_prepend(LIVE)
    script = load_file(LIVE / "foxglove_tracks.py", "live")
    state = fgtrack.TrackState(1_500_000_000, np.array([3.0, 4, 0, 20, 0]), np.eye(5))
    tracks = [
        fgtrack.TrackReport(k, status, state, 5)
        for k, status in enumerate(fgtrack.TrackStatus)
    ]
    server = foxglove.start_server(port=0)
    with foxglove.open_mcap(tmp_path / "tracks.mcap"):
        script.publish(state.stamp_ns, tuple(tracks))
        script.publish(state.stamp_ns + 20_000_000, ())
    server.stop()
    with open(tmp_path / "tracks.mcap", "rb") as file:
        sent = list(make_reader(file).iter_messages(topics=["/tracks"]))
    assert [message.log_time for _, _, message in sent] == [
        1_500_000_000,
        1_520_000_000,
    ]
    assert b"2: 20 m/s" in sent[0][2].data
    assert len(sent[1][2].data) == 0


@pytest.mark.slow
def test_a_soak_of_some_seconds_accounts_for_every_detection(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench_live.main(
        tmp_path, duration_s=3.0, objects=2, estimator="ekf-replay", parts=3
    )
    text = capsys.readouterr().out
    assert (tmp_path / "live.md").read_text(encoding="utf-8") == text
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| ")][2:]
    until_min = [float(row[1]) for row in rows]
    assert until_min == sorted(until_min)
    assert (len(rows), until_min[-1] >= 2.9 / 60) == (3, True)
    assert all(float(row[2]) > 10.0 for row in rows)
    result = json.loads((tmp_path / "live.json").read_text(encoding="utf-8"))
    counted = {
        sensor: sum(counts.values()) for sensor, counts in result["counts"].items()
    }
    assert counted == result["sent"]
    assert sum(counted.values()) > 100
    assert result["refused"] == result["failures"] == {}
    assert result["timing"]["ticks"] == sum(part["ticks"] for part in result["parts"])
    assert all(
        part["tick_ms"] == sorted(part["tick_ms"]) and len(part["tick_ms"]) == 3
        for part in result["parts"]
    )
    ticks = sum(
        int(row[5].split()[2]) + int(row[6]) for row in rows
    )  # done and skipped
    assert ticks == pytest.approx(50 * 60 * until_min[-1], abs=5)
