"""Runs judged when they were ready, by timings made by hand."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import ROUND, WEST, write_run

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.tables import Tables
from fgtrack.evaluation.tables.compare import compare
from fgtrack.evaluation.tables.streaming import (
    ASKED,
    PREDICTED,
    READY,
    streaming_errors,
)
from fgtrack.runs import Run

MS = 1_000_000
TICKS = range(60)
AT_50_HZ = "clock: {node_hz: 50.0}\n"


def made(
    path: Path, times_ms: Sequence[int], config: str = AT_50_HZ, **errors: float
) -> Run:
    """A run of a car that drives straight on at 20 m/s; every tick takes its time, the last ones are repeated."""
    tracks = [[WEST.track(tick, 1, **errors)] for tick in TICKS]
    truth = WEST.truth(range(-1, len(TICKS) + 40))
    took_ns = [times_ms[min(tick, len(times_ms) - 1)] * MS for tick in TICKS]
    return write_run(path, tracks, truth=truth, config_text=config, process_ns=took_ns)


def errors_of(run: Run) -> Mapping[str, FloatArray]:
    matching = match(run)
    assert matching is not None
    return streaming_errors(run, matching).values


def rmse(tables: Tables, judged: str) -> dict[str, float]:
    table = tables["streaming"]
    mine = table["judged"] == judged
    return dict(
        zip(
            table["run"][mine].tolist(),
            table["position_rmse_m"][mine].tolist(),
            strict=True,
        )
    )


def test_what_took_30_ms_is_judged_30_ms_later(tmp_path: Path) -> None:
    found = errors_of(made(tmp_path / "run", [30, 0]))
    assert found[ASKED] == pytest.approx(0.0, abs=1e-6)
    assert found[READY][:3].tolist() == pytest.approx(
        [20.0 * 0.03, 20.0 * 0.01, 0.0], abs=1e-6
    )


def test_a_user_who_predicts_pays_for_what_its_speed_does_not_tell(
    tmp_path: Path,
) -> None:
    straight = errors_of(made(tmp_path / "run", [10], speed_mps=3.0))
    assert straight[READY] == pytest.approx(0.2, abs=1e-6)
    assert straight[PREDICTED] == pytest.approx(0.03, abs=1e-6)
    truth = ROUND.truth(range(-1, 100))
    tracks = [[ROUND.track(tick, 1)] for tick in TICKS]
    run = write_run(
        tmp_path / "round", tracks, truth=truth, process_ns=[19 * MS] * len(TICKS)
    )
    turning = errors_of(run)
    expected_m = 0.5 * 30.0 * 0.5 * 0.019**2  # half of v omega t^2
    assert turning[PREDICTED] == pytest.approx(expected_m, rel=0.05)


def test_a_track_without_yaw_and_speed_stays_where_it_was_published(
    tmp_path: Path,
) -> None:
    run = made(tmp_path / "run", [10], yaw_rad=np.nan, speed_mps=np.nan)
    found = errors_of(run)
    np.testing.assert_array_equal(found[PREDICTED], found[READY])


def timed(path: Path, took_ms: Sequence[int]) -> Run:
    """A run without errors whose truth ends with its last tick."""
    tracks = [[WEST.track(tick, 1)] for tick in TICKS]
    process_ns = [took * MS for took in took_ms]
    return write_run(
        path,
        tracks,
        truth=WEST.truth(TICKS),
        config_text=AT_50_HZ,
        process_ns=process_ns,
    )


def test_what_is_ready_after_the_truth_has_ended_is_not_judged_of_any_run(
    tmp_path: Path,
) -> None:
    fast = timed(tmp_path / "fast", [1] * 59 + [0])
    slow = timed(
        tmp_path / "slow", [0] * 50 + [100] + [1] * 9
    )  # ready 100, 81, 62 ... ms after they are due
    tables = compare(fast, slow, streaming=True)
    later_s = np.array(
        [0.0] * 50 + [0.1, 0.081, 0.062, 0.043, 0.024, 0.005] + [0.001] * 3
    )
    assert rmse(tables, READY)["slow (smoother)"] == pytest.approx(
        20.0 * np.sqrt(np.mean(later_s**2)), rel=1e-6
    )
    assert rmse(tables, READY)["fast (smoother)"] == pytest.approx(0.02, rel=1e-6)
    assert rmse(tables, ASKED) == pytest.approx(
        {"fast (smoother)": 0.0, "slow (smoother)": 0.0}, abs=1e-6
    )


def test_a_run_that_falls_behind_for_good_is_not_ranked(tmp_path: Path) -> None:
    fast, slow = (
        timed(tmp_path / "fast", [1] * 59 + [0]),
        timed(tmp_path / "slow", [30] * 60),
    )
    tables = compare(fast, slow, streaming=True)
    assert rmse(tables, READY) == pytest.approx(
        {"fast (smoother)": 0.02 * np.sqrt(59 / 60)}, rel=1e-6
    )
    assert tables.verdict[-1] == (
        "slow (smoother) cannot keep up (load 153%): it is not ranked, as its delay grows with the run."
    )


def test_a_slow_method_loses_what_it_wins_by_being_exact(tmp_path: Path) -> None:
    exact = made(tmp_path / "exact", [15], across_m=0.1)
    rough = made(tmp_path / "rough", [1], across_m=0.2)
    tables = compare(exact, rough, streaming=True)
    assert "exact (smoother) is best at the newest stamp" in tables.verdict[0]
    assert (
        "rough (smoother) is best evaluated when the states are ready"
        in tables.verdict[-2]
    )
    assert (
        "exact (smoother) is best evaluated when ready, with states predicted"
        in tables.verdict[-1]
    )
    assert rmse(tables, READY) == pytest.approx(
        {
            "rough (smoother)": np.hypot(0.2, 0.02),
            "exact (smoother)": np.hypot(0.1, 0.3),
        },
        rel=1e-6,
    )
    load = tables["load"]
    assert load["ready_after_p50_s"].tolist() == pytest.approx([0.015, 0.001])


def test_without_truth_there_is_the_load_alone(tmp_path: Path) -> None:
    tables = compare(
        write_run(tmp_path / "run", [[WEST.track(0, 1)]], process_ns=[MS]),
        streaming=True,
    )
    assert (len(tables["streaming"]), len(tables["load"])) == (0, 1)


@pytest.mark.parametrize(
    ("config", "late"),
    [(AT_50_HZ, [3, 60]), ("clock: {node_hz: null}\n", [None, None])],
)
def test_late_ticks_and_load_come_from_the_times_and_the_node_period(
    config: str, late: list[int | None], tmp_path: Path
) -> None:
    (row,) = (
        compare(made(tmp_path / "run", [50, 10, 10, 0], config), streaming=True)
        .tables["load"]
        .plain()
    )
    assert [row["deadline_misses"], row["ticks"]] == late
    assert (row["load"], row["ready_after_max_s"]) == pytest.approx(
        (0.07 / (59 * 0.02), 0.05)
    )
