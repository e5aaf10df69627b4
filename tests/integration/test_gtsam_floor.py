"""The benchmark of what gtsam is asked: the solver with callbacks gives the states of the one without."""

import sys

import numpy as np
import pytest
from support.scripts import EXPERIMENTS

sys.path.insert(0, str(EXPERIMENTS))
import bench_gtsam_floor as floor
from bench_tracker import traffic

from fgtrack.estimation.factor_graph.backends.base import Change
from fgtrack.estimation.smoothing.settings import SmootherSettings
from fgtrack.models.motion import CTRV


def test_linear_factors_and_callbacks_give_the_same_means() -> None:
    """Callbacks are linearised by iSAM2, linear factors by the window."""
    asked, whole_us = floor.record(traffic(1)[:90])
    assert sum(isinstance(each, Change) for each in asked) > 20
    thresholds = SmootherSettings().thresholds(CTRV(), curved=False)
    linear, means = floor.replayed(asked, floor.LinearBackend)
    calls, others = floor.replayed(asked, lambda: floor.CallbackBackend(thresholds))
    assert len(means) == len(others) > 20
    for mean, other in zip(means, others, strict=True):
        np.testing.assert_allclose(mean, other, atol=1e-8)
    assert all(part > 0.0 for part in (*linear, *calls, whole_us))


def test_the_table_adds_up(capsys: pytest.CaptureFixture[str]) -> None:
    floor.main(rounds=1, num_ticks=60)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()[2:]]
    linear = [float(row[1]) for row in rows]
    assert linear[4] == pytest.approx(sum(linear[:4]), abs=3.0)
    assert linear[6] == pytest.approx(linear[4] / linear[5], abs=0.01)
