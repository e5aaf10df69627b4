"""Runs of one recording against each other: which are paired, at which samples, and who is better."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import ROUND, WEST, update, write_run

from fgtrack.core.types import FloatArray
from fgtrack.evaluation.comparison import Comparison, comparisons, ranked
from fgtrack.evaluation.intervals import Estimate
from fgtrack.evaluation.runs import EvaluatedRun
from fgtrack.evaluation.tables.compare import compare
from fgtrack.runs import Run

TICKS = 200
NOISE_M = np.random.default_rng(1).normal(0.0, 0.3, TICKS)


def a_run(
    folder: Path, across_m: FloatArray, *, first: int = 0, config_text: str = ""
) -> Run:
    """A car tracked from tick `first` on with the errors `across_m`; another one that is missed."""
    tracks = [
        [WEST.track(k, 1, across_m=float(across_m[k]))] if k >= first else []
        for k in range(TICKS)
    ]
    updates = {k: [update(tick=k)] for k in range(first, TICKS, 5)}
    truth = [*WEST.truth(range(TICKS)), *ROUND.truth(range(TICKS))]
    return write_run(
        folder, tracks, truth=truth, updates=updates, config_text=config_text
    )


def judged(runs: Sequence[Run]) -> list[EvaluatedRun]:
    return [EvaluatedRun(str(number), run) for number, run in enumerate(runs)]


def comparison_of(runs: Sequence[Run]) -> Comparison:
    (found,) = comparisons(judged(runs))
    return found


def rms(values: FloatArray) -> float:
    return math.sqrt(float(np.square(values).mean()))


@pytest.fixture(scope="module")
def trio(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Errors doubled, plain, and plain but for what changes its sign from tick to tick."""
    folder = tmp_path_factory.mktemp("trio")
    flips = 0.001 * (-1.0) ** np.arange(TICKS)
    return [
        a_run(folder / str(k), across)
        for k, across in enumerate((2.0 * NOISE_M, NOISE_M, NOISE_M + flips))
    ]


@pytest.mark.parametrize(("worse_m", "standing"), [(1e-9, "tie"), (1e-5, "worse")])
def test_a_difference_of_rounding_is_a_tie_however_certain(
    worse_m: float, standing: str
) -> None:
    certain = Estimate(worse_m, 0.9 * worse_m, 1.1 * worse_m, 40)
    best, other = ranked(
        ["a", "b"],
        [0.3, 0.3 + worse_m],
        [0.3, 0.3 + worse_m],
        lambda one, other: certain,
    )
    assert (best.standing, other.standing) == (
        "tie" if standing == "tie" else "best",
        standing,
    )


def test_a_worse_mean_within_the_interval_is_not_resolved_and_no_tie() -> None:
    wide = Estimate(0.02, -0.01, 0.05, 40)
    found = ranked(["a", "aged"], [0.30, 0.32], [0.30, 0.32], lambda one, other: wide)
    assert [entry.standing for entry in found] == ["unresolved", "unresolved"]
    unknown = Estimate(0.02, math.nan, math.nan, 1)
    found = ranked(
        ["a", "aged"], [0.30, 0.32], [0.30, 0.32], lambda one, other: unknown
    )
    assert [entry.standing for entry in found] == ["unresolved", "unresolved"]


def test_the_best_run_and_those_that_tie_with_it_and_how_much_worse_the_others_are(
    trio: list[Run],
) -> None:
    found = comparison_of(trio).quantities["position_rmse_m"]
    assert [(entry.name, entry.standing) for entry in found] in (
        [("1", "unresolved"), ("2", "unresolved"), ("0", "worse")],
        [("2", "unresolved"), ("1", "unresolved"), ("0", "worse")],
    )
    values = {entry.name: entry.value for entry in found}
    assert values["1"] == pytest.approx(rms(NOISE_M), rel=1e-9)
    worse = found[2].worse_by
    assert worse is not None
    assert worse.mean == pytest.approx(values["0"] - found[0].value)
    assert worse.low < rms(NOISE_M) < worse.high
    assert found[0].worse_by is None
    assert {entry.name for entry in found if entry.standing == "unresolved"} == {
        "1",
        "2",
    }


def test_gospa_is_that_of_the_metrics(trio: list[Run]) -> None:
    found = comparison_of(trio).quantities["gospa_in_view_rms_m"]
    expected = {
        one.label: one.metrics.multi_object.gospa["in_view_rms_m"]
        for one in judged(trio)
        if one.metrics.multi_object
    }
    assert {entry.name: entry.value for entry in found} == pytest.approx(expected)
    assert found[-1].name == "0"


def test_gospa_is_left_out_where_the_scores_of_all_tracks_are_not_asked_for(
    tmp_path: Path,
) -> None:
    plain = "evaluation: {multi_object: false}"
    runs = [a_run(tmp_path / name, NOISE_M, config_text=plain) for name in "ab"]
    assert set(comparison_of(runs).quantities) == {
        *("position_rmse_m", "speed_rmse_mps", "yaw_rmse_rad", "position_nees")
    }


def test_of_the_nees_the_nearest_to_two_is_best(tmp_path: Path) -> None:
    """The covariance of a track is the identity, so its NEES is its squared error."""
    noise = np.random.default_rng(2).normal(0.0, 0.2, TICKS)
    near, cautious = (
        a_run(tmp_path / "a", math.sqrt(1.8) + noise),
        a_run(tmp_path / "b", 0.2 + noise),
    )
    found = comparison_of([cautious, near]).quantities
    assert [entry.name for entry in found["position_nees"]] == ["1", "0"]
    assert found["position_nees"][0].standing == "best"
    best, other = found["position_nees"]
    assert best.value == pytest.approx(1.8, rel=0.1)
    assert other.worse_by is not None
    assert other.worse_by.mean == pytest.approx(
        abs(other.value - 2.0) - abs(best.value - 2.0)
    )
    assert [entry.name for entry in found["position_rmse_m"]] == ["0", "1"]


def test_only_samples_that_all_runs_have_are_compared(tmp_path: Path) -> None:
    """The second run begins late; before that the first one is far off."""
    early = np.where(np.arange(TICKS) < 50, 4.0, NOISE_M)
    runs = [a_run(tmp_path / "a", early), a_run(tmp_path / "b", NOISE_M, first=50)]
    # the detections of the first 50 ticks are in one run alone
    runs[1] = runs[1].with_tables(updates=runs[0].tables["updates"])
    found = comparison_of(runs)
    assert (found.samples, found.most_samples) == (150, 200)
    entries = found.quantities["position_rmse_m"]
    assert [entry.value for entry in entries] == pytest.approx([rms(NOISE_M[50:])] * 2)
    assert {entry.standing for entry in entries} == {"tie"}
    assert "150 samples in common, of up to 200" in str(compare(runs))


def test_nothing_in_common_is_said(tmp_path: Path) -> None:
    tracks = [[WEST.track(k, 1)] if k < 100 else [] for k in range(TICKS)]
    truth = [*WEST.truth(range(TICKS)), *ROUND.truth(range(TICKS))]
    first = write_run(tmp_path / "first", tracks, truth=truth)
    found = compare([first, a_run(tmp_path / "last", NOISE_M, first=100)])
    assert "never track the same object at the same stamp" in found.verdict[0]
    assert set(found["differences"]["quantity"].tolist()) == {"gospa_in_view_rms_m"}


def test_runs_of_other_recordings_or_judged_otherwise_are_not_paired(
    tmp_path: Path, trio: list[Run]
) -> None:
    one = EvaluatedRun("one", trio[0])
    other_truth = write_run(
        tmp_path / "truth", [[WEST.track(0, 1)]], truth=WEST.truth(range(9))
    )
    other_gate = a_run(
        tmp_path / "gate", NOISE_M, config_text="evaluation: {gate_m: 3.0}"
    )
    more_detections = trio[1].with_tables(
        updates=write_run(tmp_path / "more", updates={0: [update(), update()]}).tables[
            "updates"
        ]
    )
    for other in (other_truth, other_gate, more_detections):
        assert comparisons([one, EvaluatedRun("other", other)]) == []


def test_each_recording_has_a_comparison_of_its_own(
    tmp_path: Path, trio: list[Run]
) -> None:
    tracks = [[ROUND.track(k, 1, across_m=0.1 * (k % 3))] for k in range(50)]
    pair = [
        write_run(tmp_path / name, tracks, truth=ROUND.truth(range(50)))
        for name in "ab"
    ]
    without = write_run(tmp_path / "without", tracks)
    found = comparisons(judged([trio[0], pair[0], without, trio[1], pair[1]]))
    assert [one.runs for one in found] == [("0", "3"), ("1", "4")]


def test_the_table_has_all_numbers_and_marks_best_unresolved_and_worse(
    trio: list[Run],
) -> None:
    table = compare(trio)["differences"]
    mine = table[table["quantity"] == "position_rmse_m"].reset_index()
    assert mine["standing"].tolist() == ["unresolved", "unresolved", "worse"]
    assert np.isnan(mine["worse_by"][0])
    assert mine["low"][2] < mine["worse_by"][2] < mine["high"][2]
    assert mine["blocks"][2] > 20
    cells = [
        row[2] for row in compare(trio[:2]).tables["differences"].rows(bold="<{}>")
    ]
    assert [cell[-3:] for cell in cells[:2]] == [" +>", "6  "]
