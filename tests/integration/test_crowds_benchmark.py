"""The benchmark of crowds runs, and its table has a row for everything that it does."""

import sys

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_crowds


def test_the_table_has_time_and_memory_of_every_case(capsys: pytest.CaptureFixture[str]) -> None:
    bench_crowds.main(detections=60, tracks=5, lists=3)
    head, rule, *rows = capsys.readouterr().out.splitlines()
    assert head == "| what | processor time [s] | memory [MB] |"
    assert rule.count("|") == head.count("|")
    kinds = [row.split(":")[0].removeprefix("| ") for row in rows]
    assert kinds.count("merge") == 3
    assert sum(kind.startswith("association by") for kind in kinds) == 2 * len(bench_crowds.ASSOCIATIONS)
    assert sum(kind.startswith("tick") for kind in kinds) == 4
    assert all(float(cell) >= 0.0 for row in rows for cell in row.strip("| ").split("|")[1:])
