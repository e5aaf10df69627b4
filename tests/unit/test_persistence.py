from dataclasses import replace

import numpy as np
import pytest

from fgtrack.meaning.persistence import (
    Lists,
    Persistence,
    disagreement_m,
    persistence,
)


def cars(
    detection_probability: float,
    clutter: float,
    count: int = 4,
    num_places: int = 0,
    flashes: bool = False,
) -> Persistence | None:
    """Persistence of `count` cars at up to 30 m/s in 600 lists at 10 Hz; scores 4 above those of clutter.

    Every second list shows clutter at each of `num_places` as well; `flashes` are three lists of clutter each, far off.
    """
    rng = np.random.default_rng(1)
    at_m, speed_mps = (
        rng.uniform(-300.0, 300.0, (count, 2)),
        rng.uniform(-30.0, 30.0, (count, 2)),
    )
    stamps_s, places_m = (
        0.1 * np.arange(600),
        rng.uniform(-2000.0, 2000.0, (num_places, 2)),
    )
    points_m, scores = [], []
    for k, t_s in enumerate(stamps_s.tolist()):
        true_m = at_m + speed_mps * t_s + rng.normal(0.0, 0.3, (count, 2))
        true_m = true_m[rng.random(count) < detection_probability]
        false_m = rng.uniform(-2000.0, 2000.0, (rng.poisson(clutter), 2))
        false_m = np.concatenate([false_m, places_m[rng.random(num_places) < 0.5]])
        if flashes and k % 10 < 3:
            false_m = np.concatenate([false_m, np.array([[5000.0, 100.0 * (k // 10)]])])
        points_m.append(np.concatenate([true_m, false_m]))
        scores.append(
            np.concatenate(
                [rng.normal(4.0, 1.0, len(true_m)), rng.normal(0.0, 1.0, len(false_m))]
            )
        )
    return persistence(
        Lists(stamps_s, points_m, scores, [np.hypot(*one.T) for one in points_m])
    )


@pytest.mark.parametrize("clutter", [0.0, 2.0])
@pytest.mark.parametrize("detection_probability", [0.5, 0.7, 0.85])
def test_detection_probability_and_clutter_are_recovered(
    detection_probability: float, clutter: float
) -> None:
    found = cars(detection_probability, clutter)
    assert found is not None
    assert found.detection_probability == pytest.approx(detection_probability, abs=0.07)
    assert found.clutter_per_list == pytest.approx(clutter, abs=0.35)


def test_a_score_that_objects_have_more_often_than_clutter_is_found() -> None:
    found = cars(0.9, 2.0)
    assert found is not None
    assert found.score is not None
    # For known classes 2 and 1 / 4; objects whose neighbours were missed count as clutter.
    assert 1.5 < found.score.even < 3.0
    assert 0.1 < found.score.scale < 1.1


def test_clutter_that_comes_back_is_dense_around_itself() -> None:
    spread, standing = cars(0.9, 4.0), cars(0.9, 1.0, num_places=6)
    assert spread is not None
    assert standing is not None
    # Three of four are at fixed positions, and half of these come back within 3 m.
    expected = 0.75 * 0.5 / (9.0 * np.pi)
    assert spread.near_clutter_per_m2 < 0.05 * expected
    assert standing.near_clutter_per_m2 == pytest.approx(expected, rel=0.3)


def test_objects_whose_scores_are_low_now_and_then_make_no_clutter() -> None:
    """Scores of objects and clutter overlap, and there are few false detections."""
    found = cars(0.9, 0.3)
    assert found is not None
    assert found.score is not None
    assert found.near_clutter_per_m2 < 1e-4


def test_few_detections_and_clutter_alone_show_nothing() -> None:
    assert cars(0.05, 0.0) is None
    assert cars(0.0, 1.0) is None


def test_beyond_some_range_what_comes_back_twice_does_not_go_on() -> None:
    near, far = cars(0.9, 0.0), cars(0.9, 0.0, flashes=True)
    assert near is not None
    assert far is not None
    assert near.max_range_m is None
    assert far.max_range_m is not None
    assert far.max_range_m < 3000.0


@pytest.mark.parametrize("missed", [0.0, 0.6])
@pytest.mark.parametrize(
    ("aside_m", "expected_m"), [(0.5, 0.4), (6.0, 5.1), (300.0, None)]
)
def test_sensors_disagree_by_how_far_they_see_an_object_apart(
    aside_m: float, expected_m: float | None, missed: float
) -> None:
    found = cars(0.9, 0.0)
    assert found is not None
    stamps_s, state = found.lines[:, 0], found.lines[:, 1:3]
    # A neighbour 57 m off, of which one sensor sees all, and the other misses some of both.
    own = [
        np.concatenate([state[stamps_s == one], state[stamps_s == one] + 40.0])
        for one in stamps_s
    ]
    rng = np.random.default_rng(0)
    other = [each[rng.random(len(each)) >= missed] + aside_m for each in own]
    found = replace(found, lists=found.lists._replace(stamps_s=stamps_s, points_m=own))
    measured_m = disagreement_m(found, found.lists._replace(points_m=other))
    assert measured_m == (
        None if expected_m is None else pytest.approx(1.41 * aside_m / 1.18, rel=0.1)
    )


@pytest.mark.parametrize("crowded", [False, True])
def test_the_density_of_clutter_without_scores_is_that_around_clutter(
    crowded: bool,
) -> None:
    """Ten false detections of each list, within 40 m of a point or anywhere in 2 km; three cars stand far away."""
    rng, points_m = np.random.default_rng(2), []
    for _ in range(200):
        false_m = (
            rng.uniform(-1000.0, 1000.0, 2 if crowded else (10, 2))
            + rng.uniform(-20.0, 20.0, (10, 2)) * crowded
        )
        cars_m = 5000.0 + 300.0 * np.arange(3.0)[:, None] + rng.normal(0.0, 0.1, (3, 2))
        points_m.append(np.concatenate([false_m, cars_m]))
    ranges_m = [np.hypot(*each.T) for each in points_m]
    found = persistence(
        Lists(0.5 * np.arange(200), points_m, [np.full(13, np.nan)] * 200, ranges_m)
    )
    assert found is not None
    assert found.score is None
    expected = 9.0 / (np.pi * 50.0**2) if crowded else 9.0 / 2000.0**2
    assert found.near_clutter_per_m2 == pytest.approx(expected, rel=0.25)
