import numpy as np
import pytest

from fgtrack.pipeline.persistence import Persistence, persistence


def cars(
    detection_probability: float, clutter: float, seed: int = 1, count: int = 4, num_places: int = 0
) -> Persistence | None:
    """Persistence of `count` cars at up to 30 m/s in 600 lists at 10 Hz; scores 4 above those of clutter.

    Every second list shows clutter at each of `num_places` as well.
    """
    rng = np.random.default_rng(seed)
    at_m, speed_mps = rng.uniform(-300.0, 300.0, (count, 2)), rng.uniform(-30.0, 30.0, (count, 2))
    stamps_s, places_m = 0.1 * np.arange(600), rng.uniform(-2000.0, 2000.0, (num_places, 2))
    points_m, scores = [], []
    for t_s in stamps_s.tolist():
        true_m = at_m + speed_mps * t_s + rng.normal(0.0, 0.3, (count, 2))
        true_m = true_m[rng.random(count) < detection_probability]
        false_m = rng.uniform(-2000.0, 2000.0, (rng.poisson(clutter), 2))
        false_m = np.concatenate([false_m, places_m[rng.random(num_places) < 0.5]])
        points_m.append(np.concatenate([true_m, false_m]))
        scores.append(np.concatenate([rng.normal(4.0, 1.0, len(true_m)), rng.normal(0.0, 1.0, len(false_m))]))
    return persistence(stamps_s, points_m, scores)


@pytest.mark.parametrize("clutter", [0.0, 2.0])
@pytest.mark.parametrize("detection_probability", [0.5, 0.7, 0.85])
def test_detection_probability_and_clutter_are_recovered(detection_probability: float, clutter: float) -> None:
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
    assert spread.near_clutter_per_m2 is not None
    assert standing.near_clutter_per_m2 is not None
    # Three of four are at places, and half of these come back within 3 m.
    expected = 0.75 * 0.5 / (9.0 * np.pi)
    assert spread.near_clutter_per_m2 < 0.15 * expected
    assert 0.5 * expected < standing.near_clutter_per_m2 < 1.2 * expected


def test_few_detections_and_clutter_alone_show_nothing() -> None:
    assert cars(0.05, 0.0) is None
    assert cars(0.0, 1.0) is None
