"""The soak of a day, as twice half a minute: every detection accounted for, the same rows twice, failures seen."""

import json
import sys
from pathlib import Path

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_soak

SMALL = {"hours": 0.5 / 60.0, "parts": 3, "runs": 2, "jobs": 1}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("soak")
    bench_soak.main(out, estimator="ekf-replay", **SMALL)
    return out


def test_half_a_minute_of_race_is_accounted_for_and_the_same_twice(
    folder: Path,
) -> None:
    first, second = (
        [
            bench_soak.Part(**part)
            for part in json.loads((folder / f"ekf-replay-{number}.json").read_text())
        ]
        for number in (1, 2)
    )
    assert len(first) == len(second) == 3
    assert first[-1].sent == sum(first[-1].counts.values()) > 500
    assert [part.digest for part in first] == [part.digest for part in second]
    assert len({part.digest for part in first}) == 3
    assert first[-1].counts["birth"] > 5
    for disposition in (
        "in_sequence",
        "out_of_sequence",
        "too_old",
        "duplicate",
        "merged",
    ):
        assert first[-1].counts[disposition] > 0
    assert first[-1].failures == {}


def test_table_and_figure_are_written(folder: Path) -> None:
    text = (folder / "soak.md").read_text()
    assert "2 times 0.00833 h of race" in text
    assert "NOT AS PROMISED" not in text
    assert (folder / "soak.png").stat().st_size > 10_000
