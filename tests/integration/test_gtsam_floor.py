"""The benchmark of what gtsam is asked."""

import sys

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_gtsam_floor as floor


def test_the_table_adds_up(capsys: pytest.CaptureFixture[str]) -> None:
    floor.main(rounds=1, num_ticks=60)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[2:]]
    *parts, inside, whole = [float(row[1]) for row in rows]
    assert all(part > 0.0 for part in parts)
    assert inside == pytest.approx(sum(parts), abs=3.0)
    assert whole > inside
