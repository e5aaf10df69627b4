"""NEES and NIS with their bands, over one run and over many, and the whiteness of innovations."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import WEST, update, write_run
from scipy.stats import chi2

from fgtrack.core.types import Disposition, UpdateRecord
from fgtrack.evaluation.matching import position_squares
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.scores.innovations import FEWEST, Autocorrelation
from fgtrack.evaluation.scores.statistics import ChiSquareMean
from fgtrack.runs import COVARIANCE_COLUMNS, Columns, Run


def table_of(covariances: np.ndarray, errors: np.ndarray) -> Columns:
    rows, columns = np.triu_indices(5)
    entries = dict(
        zip(COVARIANCE_COLUMNS, covariances[:, rows, columns].T, strict=True)
    )
    return Columns({**entries, "x_m": errors[:, 0], "y_m": errors[:, 1]})


# --- normalised squares


def test_a_normalised_square_weighs_the_errors_with_their_covariance() -> None:
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(50, 5, 5))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    errors = rng.normal(size=(50, 2))
    expected = [
        e @ np.linalg.solve(P[:2, :2], e)
        for e, P in zip(errors, covariances, strict=True)
    ]
    assert position_squares(
        table_of(covariances, errors), np.zeros((50, 2))
    ) == pytest.approx(expected, rel=1e-8)


def test_without_a_positive_definite_covariance_there_is_no_square() -> None:
    indefinite = np.eye(5)
    indefinite[0, 1] = indefinite[1, 0] = 2.0
    huge = np.eye(5)
    huge[0, :2], huge[1, 0] = (
        (1e-300, 1e60),
        1e60,
    )  # out of these comes more than a number holds
    covariances = np.array(
        [np.eye(5), indefinite, np.zeros((5, 5)), -np.eye(5), huge, np.eye(5)]
    )
    errors = np.ones((6, 2))
    errors[5, 1] = np.nan
    squares = position_squares(table_of(covariances, errors), np.zeros((6, 5)))
    assert np.isnan(squares).tolist() == [False, True, True, True, True, True]


# --- one run


def test_nees_of_the_position_has_its_known_value(tmp_path: Path) -> None:
    """The covariance is the identity."""
    errors = {"along_m": 3.0, "across_m": 4.0}
    tracks = [
        [WEST.track(k, 1, **errors), WEST.track(k, 2, across_m=60.0)] for k in range(5)
    ]
    run = write_run(tmp_path / "run", tracks, truth=WEST.truth(range(5)))
    found = evaluate(replace(run, config_text="evaluation: {gate_m: 6}")).consistency
    nees = found.position_nees
    assert (nees.count, nees.mean, nees.dof) == (5, pytest.approx(25.0), 2.0)


def test_nis_has_the_degrees_of_freedom_of_what_was_measured(tmp_path: Path) -> None:
    updates = {
        0: [update(disposition=Disposition.BIRTH)],
        1: [
            update(nis=1.0, x_m=1.0, y_m=0.0),
            update(nis=4.0, x_m=3.0, y_m=0.0, yaw_rad=0.2, index=1),
            update("radar", nis=2.0, speed_mps=-2.0),
        ],
    }
    found = evaluate(write_run(tmp_path / "run", updates=updates)).consistency
    means = {sensor: (of.count, of.mean, of.dof) for sensor, of in found.nis.items()}
    assert means == {"lidar": (2, 2.5, 2.5), "radar": (1, 2.0, 1.0)}
    assert found.position_nees.count == 0


def test_the_band_is_that_of_a_sum_of_independent_squares() -> None:
    found = ChiSquareMean.of(np.full(40, 2.0), np.repeat([2, 3], 20))
    assert (found.mean, found.dof) == (2.0, 2.5)
    assert (found.band_low, found.band_high) == pytest.approx(
        tuple(chi2.ppf([0.025, 0.975], 100) / 40)
    )


# --- whiteness


def correlated_errors(num_runs: int, num_stamps: int, memory: float) -> np.ndarray:
    """Errors of variance 1 with the autocorrelation `memory` from one stamp to the next."""
    rng = np.random.default_rng(5)
    errors = rng.normal(size=(num_runs, num_stamps, 2))
    for k in range(1, num_stamps):
        errors[:, k] = (
            memory * errors[:, k - 1] + math.sqrt(1.0 - memory**2) * errors[:, k]
        )
    return errors


def innovations_run(
    folder: Path, series: dict[int, np.ndarray], names: tuple[str, ...] = ("x_m", "y_m")
) -> Run:
    """Updates of the tracks of `series`, one of each at a tick; an innovation each, shape (n, components)."""
    updates: dict[int, list[UpdateRecord]] = {}
    for track_id, values in series.items():
        for tick, nu in enumerate(values):
            known = dict(zip(names, nu.tolist(), strict=True))
            updates.setdefault(tick, []).append(
                update(tick=tick, track_id=track_id, **known)
            )
    return write_run(folder, updates=updates)


def whiteness(run: Run) -> Autocorrelation:
    found = evaluate(run).consistency.autocorrelation["lidar"]
    assert found is not None
    return found


def test_an_alternating_innovation_has_the_autocorrelation_that_can_be_counted(
    tmp_path: Path,
) -> None:
    n = 30
    series = (-1.0) ** np.arange(n)[:, None]
    found = whiteness(innovations_run(tmp_path / "run", {1: series}, ("speed_mps",)))
    assert (found.lag1, found.lag1_band) == pytest.approx(
        (-(n - 1) / n, 1.96 * math.sqrt(n - 1) / n), rel=1e-4
    )


def test_tracks_do_not_run_into_each_other(tmp_path: Path) -> None:
    """Each alternates, but between the two there is no correlation; a third one is too short."""
    flips = (-1.0) ** np.arange(40)[:, None] * np.ones(2)
    run = innovations_run(
        tmp_path / "run", {1: flips, 2: 3.0 * flips[:30], 3: flips[: FEWEST - 1]}
    )
    assert whiteness(run).lag1 == pytest.approx(
        -(39 * 2 + 29 * 18) / (40 * 2 + 30 * 18)
    )


def test_correlated_and_biased_innovations_leave_their_bands(tmp_path: Path) -> None:
    found = whiteness(
        innovations_run(
            tmp_path / "correlated", dict(enumerate(correlated_errors(5, 400, 0.5)))
        )
    )
    assert found.lag1 == pytest.approx(0.5, abs=0.06)
    assert found.lag1 > 3.0 * found.lag1_band
    biased = whiteness(
        innovations_run(
            tmp_path / "biased", {0: 1.0 + correlated_errors(1, 400, 0.0)[0]}
        )
    )
    assert biased.lag1 == pytest.approx(0.5, abs=0.1)
