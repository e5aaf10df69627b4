"""The adapters of other packages for `fgtrack rank`: what is known of each package is found and named."""

from dataclasses import replace
from pathlib import Path

import pytest

from fgtrack.ranking import scenarios
from fgtrack.ranking.public import rank
from fgtrack.ranking.result import EXACT, Result

METHODS = Path(__file__).parents[2] / "experiments/leaderboard/methods"
STONE_SOUP = METHODS / "stone_soup.py"
LATE = ("late-by-1", "late-by-3", "late-by-10")


def results(package: str, name: str, scenarios: tuple[str, ...]) -> list[Result]:
    pytest.importorskip(package, reason=f"{package} is not installed (extra `rivals`)")
    file = {"stonesoup": "stone_soup", "pyrecest": "pyrecest_replay"}.get(
        package, "filterpy_lag"
    )
    found = rank([f"{METHODS / file}.py:{name}"], scenarios, num_runs=2).results
    assert [each.problem for each in found] == [None] * len(scenarios)
    return list(found)


def test_stone_soup_is_exact_for_a_user_who_sorts() -> None:
    (result,) = results("stonesoup", "Sorted", ("late-by-10",))
    assert result.deviation < 1e-12
    assert result.order < EXACT
    assert (
        "the present estimate is exact; the estimate 0.3 s ago departs by up to"
        in result.sentence
    )


def test_accumulated_densities_of_stone_soup_depart_with_the_lag() -> None:
    found = results("stonesoup", "Accumulated", LATE)
    deviations = [each.deviation for each in found]
    for deviation, measured in zip(deviations, (3e-5, 0.03, 0.10), strict=True):
        assert measured / 5 < deviation < measured * 5
    assert sorted(deviations) == deviations
    assert all(each.order > 0.1 for each in found)
    assert "covariances that are not positive definite" in found[1].sentence


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of Stone Soup
def test_accumulated_densities_of_stone_soup_diverge_where_much_is_late() -> None:
    pytest.importorskip("stonesoup", reason="stonesoup is not installed")
    (result,) = rank([f"{STONE_SOUP}:Accumulated"], ["linear"], num_runs=2).results
    assert result.problem == "an answer is not finite"


def test_examples_of_stone_soup_for_late_data_are_named() -> None:
    for name, least in (("AtArrival", 2.0), ("Buffered", 1.0)):
        (result,) = results("stonesoup", name, ("late-by-10",))
        assert result.deviation > least
        assert "another order of arrival changes an estimate by" in result.sentence


def test_a_pseudo_detection_of_stone_soup_does_not_move_its_object() -> None:
    one, ten = results("stonesoup", "InverseTime", ("late-by-1", "late-by-10"))
    assert ten.deviation > 3.0 * one.deviation > 1.0


@pytest.mark.slow  # 256 particles
def test_the_particles_of_stone_soup_depart_as_a_filter_that_drops_late_detections() -> (
    None
):
    particles = results("stonesoup", "Particles", LATE)
    dropping = rank(["drop"], LATE, num_runs=2).results
    for own, other in zip(particles, dropping, strict=True):
        assert own.deviation == pytest.approx(other.deviation, abs=1.0)
    assert particles[0].deviation > 1.0


@pytest.mark.slow
def test_stone_soup_sorts_range_and_bearing() -> None:
    (result,) = results("stonesoup", "Sorted", ("range-bearing",))
    assert result.deviation < 1.0


@pytest.mark.slow  # PyRecEst takes seconds to import
def test_the_replay_of_pyrecest_departs_for_a_position_between_its_steps() -> None:
    found = results("pyrecest", "Replay", LATE)
    deviations = [each.deviation for each in found]
    assert deviations[0] > deviations[1] > deviations[2] > 0.1
    assert deviations[0] > 0.8
    assert "the present estimate departs by up to" in found[0].sentence
    assert "there is no estimate 0.3 s ago" in found[0].sentence


@pytest.mark.slow  # PyRecEst takes seconds to import
def test_the_departure_of_pyrecest_grows_with_the_way_to_the_prediction_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    slow = [each.deviation for each in results("pyrecest", "Replay", LATE)]
    monkeypatch.setattr(scenarios, "_START", replace(scenarios._START, speed_mps=24.0))
    fast = [each.deviation for each in results("pyrecest", "Replay", LATE)]
    for twice, once in zip(fast, slow, strict=True):
        assert 1.4 < twice / once < 2.6


def test_the_smoother_of_filterpy_has_no_door_for_late_data() -> None:
    (result,) = results("filterpy", "FixedLag", ("late-by-3",))
    assert "2 measurements not fused (refused 2)" in result.sentence
    assert result.deviation > 0.1
