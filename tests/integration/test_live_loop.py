"""The loop of docs/live, by the clock of the machine, and the benchmark that lasts an hour, for some seconds."""

import json
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from support.scripts import EXPERIMENTS, LIVE, load_file

import fgtrack

sys.path.insert(0, str(EXPERIMENTS))
import bench_live

LOOP = LIVE / "loop.py"


def test_the_loop_publishes_a_drive_and_accounts_for_every_detection() -> None:
    loop = load_file(LOOP, "live")
    tracker = fgtrack.Tracker.from_config("smoother", map="oval")
    published: list[fgtrack.TracksAt] = []
    behind_s: list[float] = []

    def publish(one: fgtrack.TracksAt) -> None:
        published.append(one)
        behind_s.append((time.time_ns() - one.stamp_ns) / 1e9)

    loop.run(tracker, loop.drive(duration_s=1.5), publish)
    stamps_ns = [one.stamp_ns for one in published]
    assert all(before < after for before, after in pairwise(stamps_ns))
    assert all(stamp_ns % loop.PERIOD_NS == 0 for stamp_ns in stamps_ns)
    assert len(stamps_ns) + tracker.timing.skipped >= 70
    assert min(behind_s) >= 0.1
    assert [track.stamp_ns for track in published[-1].tracks] == [stamps_ns[-1]]
    found = {sensor: sum(counts.values()) for sensor, counts in tracker.counts.items()}
    assert found == {name: one.detections for name, one in tracker.lateness.items() if one.detections}
    assert sum(found.values()) > 30
    assert tracker.lateness["radar"].delay_median_s == pytest.approx(0.06, abs=0.05)
    assert tracker.refused == tracker.failures == {}


@pytest.mark.slow
def test_a_soak_of_some_seconds_accounts_for_every_detection(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench_live.main(tmp_path, duration_s=3.0, objects=2, estimator="ekf-replay", parts=3)
    text = capsys.readouterr().out
    assert (tmp_path / "live.md").read_text(encoding="utf-8") == text
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| ")][1:]
    until_min = [float(row[1]) for row in rows]
    assert until_min == sorted(until_min)
    assert (len(rows), until_min[-1] >= 2.9 / 60) == (3, True)
    assert all(float(row[2]) > 10.0 for row in rows)
    result = json.loads((tmp_path / "live.json").read_text(encoding="utf-8"))
    counted = {sensor: sum(counts.values()) for sensor, counts in result["counts"].items()}
    assert counted == result["sent"]
    assert sum(counted.values()) > 100
    assert result["refused"] == result["failures"] == {}
    assert result["timing"]["ticks"] == sum(part["ticks"] for part in result["parts"])
    assert all(part["tick_ms"] == sorted(part["tick_ms"]) and len(part["tick_ms"]) == 3 for part in result["parts"])
    ticks = sum(int(row[5].split()[2]) + int(row[6]) for row in rows)  # done and skipped
    assert ticks == pytest.approx(50 * 60 * until_min[-1], abs=5)
