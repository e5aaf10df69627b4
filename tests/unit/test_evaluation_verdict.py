"""The sentences that a comparison begins with."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from evaluation_runs import WEST, write_run

from fgtrack.evaluation.comparison import Comparison, Entry
from fgtrack.evaluation.intervals import Estimate
from fgtrack.evaluation.metrics import Metrics, evaluate
from fgtrack.evaluation.scores.innovations import Consistency
from fgtrack.evaluation.scores.statistics import ChiSquareMean, Moments
from fgtrack.evaluation.tables.verdict import verdict

FITS = Consistency(
    position_nees=ChiSquareMean(1000, 2.1, 2.0),
    nis={"radar": ChiSquareMean(500, 4.2, 4.0), "camera": ChiSquareMean(5, 40.0, 1.0)},
    autocorrelation={},
    position_nees_interval=Estimate(2.1, 1.8, 2.4, 20),
)
TOO_SMALL = replace(
    FITS,
    position_nees=ChiSquareMean(1000, 13.4, 2.0),
    position_nees_interval=Estimate(13.4, 9.0, 17.8, 20),
    nis={"radar": ChiSquareMean(500, 26.5, 4.0)},
)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Metrics:
    """Metrics of a run with truth, to put numbers into."""
    tracks = [[WEST.track(k, 1)] for k in range(4)]
    return evaluate(
        write_run(
            tmp_path_factory.mktemp("run") / "run", tracks, truth=WEST.truth(range(4))
        )
    )


def metrics_of(plain: Metrics, **consistency: Consistency) -> dict[str, Metrics]:
    return {
        name: replace(plain, consistency=found) for name, found in consistency.items()
    }


def standing_of(worse: Estimate | None) -> str:
    if worse is None:
        return "best"
    if worse.is_significant:
        return "worse"
    return "tie" if max(abs(worse.low), abs(worse.high)) <= 1e-6 else "unresolved"


def compared(**differences: Estimate | None) -> Comparison:
    entries = [
        Entry(
            name,
            0.4,
            worse,
            standing_of(worse),
        )
        for name, worse in differences.items()
    ]
    near = {entry.standing for entry in entries[1:]} - {"worse"}
    first = "best" if not near else "unresolved" if "unresolved" in near else "tie"
    entries[0] = replace(entries[0], standing=first)
    return Comparison(tuple(differences), 10, 10, {"position_rmse_m": tuple(entries)})


def first(plain: Metrics, found: Comparison) -> str:
    return verdict(dict.fromkeys(found.runs, plain), [found])[0]


def test_a_difference_that_is_not_resolved_and_a_worse_run_are_told_with_their_intervals(
    plain: Metrics,
) -> None:
    found = compared(
        a=None, b=Estimate(0.0001, -0.0004, 0.0005, 9), c=Estimate(0.18, 0.15, 0.21, 9)
    )
    assert first(plain, found) == (
        "The difference between a and b at the newest stamp is not resolved (position RMSE 0.400 m, b is worse by "
        "0.10 mm, 95 % interval -0.40 to 0.50); c is 0.18 m worse (0.15 to 0.21)."
    )


def test_of_several_differences_that_are_not_resolved_the_largest_is_told(
    plain: Metrics,
) -> None:
    found = compared(
        a=None, b=Estimate(0.01, -0.01, 0.03, 9), c=Estimate(0.02, -0.03, 0.07, 9)
    )
    assert first(plain, found) == (
        "The differences between a, b and c at the newest stamp are not resolved (position RMSE 0.400 m, the largest "
        "is 0.020 m, 95 % interval -0.030 to 0.070)."
    )


def test_runs_that_differ_by_rounding_alone_tie(plain: Metrics) -> None:
    rounding, chance = (
        Estimate(1e-10, -1e-10, 3e-10, 9),
        Estimate(1e-10, -1e-3, 1e-3, 9),
    )
    assert (
        first(plain, compared(a=None, b=rounding))
        == "a and b tie at the newest stamp (position RMSE 0.400 m)."
    )
    assert "not resolved" in first(plain, compared(a=None, b=rounding, c=chance))


def test_a_run_too_short_for_an_interval_is_not_called_a_tie(plain: Metrics) -> None:
    unknown = Estimate(0.05, float("nan"), float("nan"), 0)
    assert first(plain, compared(a=None, b=unknown)) == (
        "The difference between a and b at the newest stamp is not resolved (position RMSE 0.400 m, b is worse by "
        "0.050 m, the run is too short for an interval)."
    )


def test_a_best_run_and_the_worse_ones_are_named(plain: Metrics) -> None:
    worse = {name: Estimate(0.1, 0.05, 0.15, 9) for name in "bc"}
    assert first(plain, compared(a=None, **worse)) == (
        "a is best at the newest stamp (position RMSE 0.400 m); b is 0.10 m worse (0.050 to 0.15), "
        "c is 0.10 m worse (0.050 to 0.15)."
    )


def test_noise_that_does_not_fit_is_named_with_its_cure(plain: Metrics) -> None:
    found = compared(a=None, b=Estimate(0.2, 0.1, 0.3, 9))
    (_, noise) = verdict(metrics_of(plain, a=TOO_SMALL, b=TOO_SMALL), [found])
    assert noise == (
        "The configured noise is too small (judged by a): NEES of the position 13.4 "
        "(expected 2, 95 % interval 9.0 to 18), NIS of radar 26.5 (expected 4). "
        "`fgtrack advise --tune` fits the noise, or reports the problem to solve first; "
        "this may change the order of the runs."
    )
    large = replace(FITS, nis={"radar": ChiSquareMean(500, 1.0, 4.0)})
    both = replace(TOO_SMALL, nis=large.nis)
    assert (
        "too large (judged by a): NIS of radar"
        in verdict(metrics_of(plain, a=large), [])[0]
    )
    assert (
        "partly too small, partly too large"
        in verdict(metrics_of(plain, a=both), [])[0]
    )


def test_noise_that_fits_is_reported_of_the_best_run(plain: Metrics) -> None:
    found = compared(b=None, a=Estimate(0.2, 0.1, 0.3, 9))
    (_, fits) = verdict(metrics_of(plain, a=TOO_SMALL, b=FITS), [found])
    assert fits == (
        "The noise is consistent (judged by b): NEES of the position 2.10 (expected 2, 95 % interval 1.8 to 2.4), "
        "NIS of radar 4.20 (expected 4)."
    )


def test_a_large_nees_that_may_be_chance_is_no_reason_to_tune_and_none_to_say_that_noise_fits(
    plain: Metrics,
) -> None:
    chance = replace(
        FITS,
        position_nees=ChiSquareMean(99, 5.0, 2.0),
        position_nees_interval=Estimate(5.0, 1.0, 9.0, 3),
    )
    assert verdict(metrics_of(plain, a=chance), []) == (
        "The run is too short to assess the noise (judged by a): "
        "NEES of the position 5.00 (expected 2, 95 % interval 1.0 to 9.0).",
    )


def test_runs_that_cannot_be_paired_are_told_in_one_line(plain: Metrics) -> None:
    (line, *noise) = verdict(metrics_of(plain, a=FITS, b=FITS), [])
    assert "The runs differ in recording, truth or evaluation settings" in line
    assert len(noise) == 2
    without: Mapping[str, Metrics] = {name: replace(plain, truth=None) for name in "ab"}
    assert verdict(without, [])[0] == "Without truth there are no errors to compare."


def test_what_waiting_brings_is_told_of_the_first_and_the_last_lag(
    plain: Metrics,
) -> None:
    (present,) = plain.lagged
    some = {"position_m": Moments(9, 0.0, 1.0)}
    lags = [
        replace(
            present,
            lag_s=lag_s,
            errors=some,
            position_reduction=Estimate(share, share - 0.1, share + 0.1, 9),
        )
        for lag_s, share in ((0.1, 0.2), (0.3, 0.5), (0.9, 0.7))
    ]
    window = replace(lags[-1], lag_s="window")
    lines = verdict({"a": replace(plain, lagged=(present, *lags, window))}, [])
    assert (
        lines[-1]
        == "Waiting lowers the position RMSE of a: 0.1 s by 20 % (10 to 30), 0.9 s by 70 % (60 to 80)."
    )
    assert verdict({"a": replace(plain, lagged=(present, lags[0]))}, [])[-1].endswith(
        "a: 0.1 s by 20 % (10 to 30)."
    )


def test_a_run_without_truth_and_innovations_has_no_verdict(tmp_path: Path) -> None:
    assert verdict({"a": evaluate(write_run(tmp_path / "run", [[]]))}, []) == ()
