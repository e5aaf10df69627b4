"""Predictions from the published states, and the figures of the evaluation of Karle et al. 2023."""

from pathlib import Path

import pytest
from evaluation_runs import WEST, run_beside, write_run

from fgtrack.core.types import TrackReport
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.scores.prediction import prediction_errors
from fgtrack.runs import Run


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return run_beside(tmp_path / "run")


def test_a_prediction_is_judged_where_the_truth_goes_on(run: Run) -> None:
    """The truth lasts for 5 s, so one second can be judged of all 30 predictions, five of none."""
    found = evaluate(run).predictions["arc"]
    assert {horizon: one.final_m.count for horizon, one in found.items()} == {
        "1s": 30,
        "2s": 30,
        "3s": 20,
        "5s": 0,
    }
    assert (
        found["1s"].final_m.mean == found["1s"].average_m.mean == pytest.approx(2.0)
    )  # WEST drives straight on
    assert (
        evaluate(run).as_dict()["predictions"]["arc"]["1s"]["final_m"]["mean"]
        == found["1s"].final_m.mean
    )


def test_an_error_of_the_speed_grows_with_the_horizon(tmp_path: Path) -> None:
    tracks: list[list[TrackReport]] = [
        [WEST.track(k, 1, speed_mps=1.0)] for k in range(10)
    ]
    made = write_run(tmp_path / "run", tracks, truth=WEST.truth(range(300)))
    found = prediction_errors(made, match(made))["arc"]
    assert list(found) == ["1s", "2s", "3s", "5s"]
    for horizon, one in found.items():
        horizon_s = float(horizon.removesuffix("s"))
        assert one.final_m.mean == pytest.approx(horizon_s)
        assert one.average_m.mean == pytest.approx((horizon_s + 0.1) / 2.0)
