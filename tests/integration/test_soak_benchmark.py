"""The soak of a day, as twice half a minute: every detection accounted for, the same rows twice, failures seen."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.scripts import EXPERIMENTS

from fgtrack.core.types import DetectionList, EgoState

sys.path.insert(0, str(EXPERIMENTS))
import bench_soak
from bench_memory import whole_laps

SMALL = {"hours": 0.5 / 60.0, "parts": 3, "runs": 2, "jobs": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("soak")
    page = out / "page.md"
    page.write_text("# Soak\n<!-- begin soak -->\nold\n<!-- end soak -->\n")
    bench_soak.main(out, estimator="ekf-replay", page=page, **SMALL)
    return out


def test_half_a_minute_of_race_is_accounted_for_and_the_same_twice(folder: Path) -> None:
    first, second = (bench_soak.read(folder / f"ekf-replay-{number}.json") for number in (1, 2))
    assert len(first) == len(second) == 3
    assert first[-1].sent == sum(first[-1].counts.values()) > 500
    assert [part.digest for part in first] == [part.digest for part in second]
    assert len({part.digest for part in first}) == 3
    assert first[-1].counts["birth"] > 5
    for disposition in ("in_sequence", "out_of_sequence", "too_old", "duplicate", "merged"):
        assert first[-1].counts[disposition] > 0
    assert first[-1].failures == {}


def test_table_figure_and_page_say_the_same(folder: Path) -> None:
    said = (folder / "soak.md").read_text()
    assert said in (folder / "page.md").read_text().replace("<!-- begin soak -->\n\n", "").replace("\n\n<!--", "\n<!--")
    assert "2 runs have the same" in said
    assert (folder / "soak.png").stat().st_size > 10_000


def test_the_race_has_what_makes_it_hard() -> None:
    """Cars that come and go, late, lost and repeated lists, wrong stamps; in order of receipt."""
    race = list(bench_soak.messages(whole_laps()[0] * 3.0 / 3600.0, 0))
    receipts_ns = [message.receipt_ns for message in race]
    assert receipts_ns == sorted(receipts_ns)
    lists = [message for message in race if isinstance(message, DetectionList)]
    delays_s = np.array([message.receipt_ns - message.stamp_ns for message in lists]) / 1e9
    assert (np.abs(delays_s) > 1.0).any()
    assert np.quantile(delays_s, 0.98) > 0.3
    copies = Counter((message.sensor, message.stamp_ns, repr(message.objects)) for message in lists)
    assert 0 < sum(count > 1 for count in copies.values()) < len(lists) / 20
    per_sensor = Counter(message.sensor for message in lists)
    assert per_sensor["lidar_cluster"] < 0.99 * per_sensor["radar"]
    sizes = [len(message.objects) for message in lists if message.sensor == "lidar_cluster"]
    assert min(sizes) <= 1 < max(sizes)
    assert any(isinstance(message, EgoState) for message in race)


def part(**changes: object) -> bench_soak.Part:
    counts = {"birth": 1, "in_sequence": 9}
    right = bench_soak.Part(1.0, 100.0, 10, (1e3, 2e3), 1.0, 2.0, 10, counts, {}, {}, 50, "ab", 1.0)
    return replace(right, **changes)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({}, None),
        ({"memory_mb": 100.9}, None),
        ({"memory_mb": 101.1}, "memory grew by 1.10 %"),
        ({"sent": 11}, "11 detections were sent, 10 ended"),
        ({"failures": {"track ended": 1, "diverged": 3}}, "failures: {'track ended': 1}"),
        ({"digest": "cd"}, "the runs differ up to 1 h"),
    ],
)
def test_what_does_not_hold_is_said(changes: dict[str, object], problem: str | None) -> None:
    said = bench_soak.problems([[part(), part(**changes)], [part(), part()]])
    if problem is None:
        assert said == []
    else:
        assert len(said) == 1
        assert problem in said[0]
