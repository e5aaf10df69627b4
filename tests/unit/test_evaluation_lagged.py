"""Lagged and final states against truth: metrics and figure."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import ROUND, WEST, write_run

from fgtrack.core.types import SmoothedReport
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.scores.lagged import WINDOW, LagMetrics, lag_metrics
from fgtrack.runs import Run

TICKS = range(20)
STEPS = {0.1: 5, 0.2: 10}  # ticks that a lag is long


def smoothed_run(folder: Path) -> Run:
    """Two cars, half as wrong after 0.1 s, a quarter after 0.2 s, a fifth in the end."""
    full = {"along_m": 1.5, "across_m": 2.0, "yaw_rad": -0.2, "speed_mps": 4.0}
    tracks = [[WEST.track(k, 1, **full), ROUND.track(k, 2, **full)] for k in TICKS]
    smoothed: dict[int, list[SmoothedReport]] = {k: [] for k in TICKS}
    for k in TICKS:
        for lag_s, steps in STEPS.items():
            part = {name: error * 2.0 ** (-steps / 5) for name, error in full.items()}
            if k >= steps:
                smoothed[k] += [
                    car.later(k - steps, i, lag_s, **part)
                    for car, i in ((WEST, 1), (ROUND, 2))
                ]
        if k >= 12:
            part = {name: 0.2 * error for name, error in full.items()}
            smoothed[k] += [
                WEST.later(k - 12, 1, **part),
                ROUND.later(k - 12 + 0.3, 2, **part),
            ]
    truth = [*WEST.truth(TICKS), *ROUND.truth(TICKS)]
    meta = {"estimator": "smoother"}
    return write_run(
        folder, tracks, truth=truth, smoothed=smoothed, smoothed_lag_s=0.1, meta=meta
    )


def lagged_of(run: Run) -> dict[object, LagMetrics]:
    return {entry.lag_s: entry for entry in lag_metrics(run, match(run))}


def test_every_lag_has_its_known_errors_at_its_own_stamps(tmp_path: Path) -> None:
    lagged = lagged_of(smoothed_run(tmp_path / "run"))
    assert list(lagged) == [0.0, 0.1, 0.2, WINDOW]
    for lag_s, share, count in [
        (0.0, 1.0, 40),
        (0.1, 0.5, 30),
        (0.2, 0.25, 20),
        (WINDOW, 0.2, 16),
    ]:
        entry = lagged[lag_s]
        assert entry.errors["position_m"].count == entry.position_nees.count == count
        assert entry.errors["position_m"].rmse == pytest.approx(2.5 * share, abs=1e-4)
        assert entry.errors["along_m"].mean == pytest.approx(1.5 * share, abs=1e-4)
        assert entry.errors["speed_mps"].mean == pytest.approx(4.0 * share)
        assert entry.errors["yaw_rad"].mean == pytest.approx(-0.2 * share, abs=1e-9)
        assert entry.position_nees.mean == pytest.approx(6.25 * share**2, abs=1e-4)
        assert entry.present_errors["position_m"].rmse == pytest.approx(2.5)
        for name in ("position_m", "speed_mps", "yaw_rad"):
            assert entry.gain(name) == pytest.approx(1.0 - share, abs=1e-4)
        if lag_s != 0.0:
            assert entry.position_reduction.mean == pytest.approx(
                entry.gain("position_m")
            )


def test_the_present_beside_a_lag_is_that_of_the_same_stamps(tmp_path: Path) -> None:
    """Wrong by 3 m once nothing is measured any more: of these ticks there are no lagged states."""
    tracks = [[WEST.track(k, 1, along_m=1.0 if k < 15 else 3.0)] for k in TICKS]
    smoothed = {k: [WEST.later(k - 5, 1, 0.1, along_m=0.5)] for k in range(5, 20)}
    entry = lagged_of(
        write_run(tmp_path / "run", tracks, truth=WEST.truth(TICKS), smoothed=smoothed)
    )[0.1]
    assert (
        entry.errors["position_m"].count
        == entry.present_errors["position_m"].count
        == 15
    )
    assert entry.present_errors["position_m"].rmse == pytest.approx(1.0)
    assert entry.gain("position_m") == pytest.approx(0.5)


def test_a_state_without_a_pair_at_its_stamp_is_not_judged(tmp_path: Path) -> None:
    """Track 1 follows WEST from tick 4 to 9 and nothing else; it is confirmed at tick 2."""
    tracks = [
        [
            WEST.track(
                k,
                1,
                across_m=0.0 if 4 <= k < 10 else 60.0,
                num_measured=9 if k >= 2 else 1,
            )
        ]
        for k in TICKS
    ]
    smoothed = {
        k: [WEST.later(k - 5, 1, 0.1, along_m=0.5), WEST.later(k - 5.25, 1)]
        for k in range(5, 20)
    }
    lagged = lagged_of(
        write_run(tmp_path / "run", tracks, truth=WEST.truth(TICKS), smoothed=smoothed)
    )
    assert lagged[0.1].errors["position_m"].count == 6
    assert (
        lagged[WINDOW].errors["position_m"].count == 6
    )  # at ticks 3.75, ..., 8.75; that of 2.75 goes with tick 3


def test_without_a_confirmed_track_there_are_no_errors(tmp_path: Path) -> None:
    run = write_run(
        tmp_path / "run",
        [[]] * 9,
        truth=WEST.truth(range(9)),
        smoothed={8: [WEST.later(k, 1) for k in (3, 4)]},
    )
    assert {
        lag_s: entry.errors["position_m"].count
        for lag_s, entry in lagged_of(run).items()
    } == {0.0: 0, WINDOW: 0}


def test_a_state_belongs_to_the_object_that_its_track_followed_at_its_stamp(
    tmp_path: Path,
) -> None:
    twin = replace(WEST, object_id=9, y_m=30.0)
    tracks = [[(WEST if k < 10 else twin).track(k, 1)] for k in TICKS]
    smoothed = {
        k: [(WEST if k - 5 < 10 else twin).later(k - 5, 1, 0.1, along_m=0.5)]
        for k in range(5, 20)
    }
    truth = [*WEST.truth(TICKS), *twin.truth(TICKS)]
    entry = lagged_of(
        write_run(tmp_path / "run", tracks, truth=truth, smoothed=smoothed)
    )[0.1]
    assert entry.errors["position_m"].count == 15
    assert entry.errors["position_m"].rmse == pytest.approx(0.5)


def test_where_truth_has_ended_neither_the_state_nor_its_present_one_counts(
    tmp_path: Path,
) -> None:
    """Truth of WEST ends at tick 10, which is nearest to the state at tick 10.4."""
    tracks = [[WEST.track(k, 1)] for k in TICKS]
    truth = [*WEST.truth(range(11)), *ROUND.truth(TICKS)]
    run = write_run(
        tmp_path / "run",
        tracks,
        truth=truth,
        smoothed={19: [WEST.later(k, 1) for k in (9.4, 10.4)]},
    )
    entry = lagged_of(run)[WINDOW]
    assert (
        entry.errors["position_m"].count
        == entry.present_errors["position_m"].count
        == 1
    )


def test_nees_weighs_the_error_with_the_covariance(tmp_path: Path) -> None:
    covariance = np.eye(5)
    covariance[:2, :2] = [[2.0, 1.0], [1.0, 2.0]]
    flat = np.zeros((5, 5))
    states = []
    for k, P in ((3, covariance), (4, covariance), (5, flat)):
        report = WEST.later(
            k, 1, 0.1, along_m=-3.0, across_m=3.0
        )  # WEST drives west: 3 m east, 3 m south
        states.append(replace(report, state=replace(report.state, covariance=P)))
    tracks = [[WEST.track(k, 1)] for k in TICKS]
    run = write_run(
        tmp_path / "run", tracks, truth=WEST.truth(TICKS), smoothed={10: states}
    )
    nees = lagged_of(run)[0.1].position_nees
    assert (nees.count, nees.mean) == (2, pytest.approx(18.0))
