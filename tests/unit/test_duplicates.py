"""Two tracks of one object: which one ends, and when."""

import numpy as np
import pytest
from support.tracking import START_NS, ms

from fgtrack.tracking.duplicates import DuplicateRules, Duplicates
from fgtrack.tracking.lifecycle import Life

APART = [(0.0, 0.0), (1.4, 0.0), (5.0, 0.0)]


def lives(*num_measured: int) -> dict[int, Life]:
    return {3 * k: Life(5, START_NS, num_measured=count) for k, count in enumerate(num_measured)}


def ended(
    duplicates: Duplicates, at_ms: float, places: list[tuple[float, float]], counts: tuple[int, ...]
) -> list[int]:
    ids = tuple(3 * k for k in range(len(places)))
    return duplicates.ended(START_NS + ms(at_ms), ids, np.array(places).reshape(-1, 2), lives(*counts))


@pytest.mark.parametrize(("counts", "gone"), [((9, 4, 1), [3]), ((4, 9, 1), [0]), ((4, 4, 1), [3])])
def test_the_track_with_fewer_detections_ends_and_of_two_with_as_many_the_younger(counts, gone) -> None:
    duplicates = Duplicates(1.5, 0.1)
    assert ended(duplicates, 0.0, APART, counts) == []
    assert ended(duplicates, 99.0, APART, counts) == []
    assert ended(duplicates, 100.0, APART, counts) == gone


def test_tracks_that_pass_each_other_both_live() -> None:
    duplicates = Duplicates(1.5, 0.1)
    for at_ms, apart_m in ((0.0, 1.4), (60.0, 1.6), (120.0, 1.4), (180.0, 1.0), (219.0, 0.0)):
        assert ended(duplicates, at_ms, [(0.0, 0.0), (0.0, apart_m)], (5, 5)) == []
    assert ended(duplicates, 220.0, [(0.0, 0.0), (0.0, 0.0)], (5, 5)) == [3]


def test_of_three_tracks_of_one_object_one_stays() -> None:
    duplicates = Duplicates(1.5, 0.0)
    places = [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0)]
    assert ended(duplicates, 0.0, places, (5, 9, 7)) == [0, 6]


def test_one_track_or_none_has_no_duplicate() -> None:
    duplicates = Duplicates(1.5, 0.0)
    assert ended(duplicates, 0.0, [(0.0, 0.0)], (1,)) == []
    assert ended(duplicates, 1.0, [], ()) == []


@pytest.mark.parametrize("wrong", [{"distance_m": 0.0}, {"distance_m": -1.0}, {"after_s": -0.1}])
def test_rules_that_make_no_sense_are_named(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        DuplicateRules(**wrong)
