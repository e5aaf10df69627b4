import sys

import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import fairness

pytestmark = pytest.mark.slow


def test_a_lever_arm_costs_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [
        line.split("|")[2:5] for line in fairness.lever_arm(1, 8.0).splitlines()[2:]
    ]
    (near_m, *_), (far_m, nees, nis) = (
        [float(cell.split()[0]) for cell in row] for row in rows
    )
    assert far_m == pytest.approx(near_m, rel=0.1)
    assert nees < 5.0
    assert 2.5 < nis < 3.5


def test_innovations_are_judged_by_estimator_and_sensor() -> None:
    rows = fairness.whiteness(1, 4.0).splitlines()[2:]
    assert [row.split("|")[1].strip() for row in rows[::2]] == [
        "smoother",
        "ekf-replay",
        "ekf-backward-forward",
    ]
    assert all(row.split("|")[4].strip() in ("0 of 1", "1 of 1") for row in rows)
