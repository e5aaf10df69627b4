"""Ranked assignments equal those of a search over all assignments."""

from itertools import product

import numpy as np
import pytest

from fgtrack.tracking.decisions.ranking import (
    LARGEST_LOSS,
    Gains,
    Ranked,
    best_assignments,
)

Pair = tuple[int, int, float]


def ranked(pairs: list[Pair], most: int) -> list[Ranked]:
    """Return the best assignments of pairs of five tracks and five candidates."""
    tracks, candidates, values = (np.array(each) for each in zip(*pairs, strict=True))
    problem = Gains.of(tracks, candidates, values, 5, 5)
    return best_assignments([(0.0, problem)], most)


def taken_pairs(own: Ranked) -> frozenset[tuple[int, int]]:
    return frozenset(
        (track, candidate)
        for track, candidate in enumerate(own.candidates.tolist())
        if candidate >= 0
    )


def every_assignment(
    pairs: list[tuple[int, int, float]],
) -> list[tuple[float, frozenset[tuple[int, int]]]]:
    """Return gain and pairs of all assignments, the best one first."""
    tracks = sorted({track for track, _, _ in pairs})
    options = [
        [(None, 0.0), *((j, gain) for i, j, gain in pairs if i == track)]
        for track in tracks
    ]
    found = []
    for chosen in product(*options):
        used = [candidate for candidate, _ in chosen if candidate is not None]
        if len(used) == len(set(used)):
            taken = frozenset(
                (track, candidate)
                for track, (candidate, _) in zip(tracks, chosen, strict=True)
                if candidate is not None
            )
            found.append((sum(gain for _, gain in chosen), taken))
    return sorted(found, key=lambda each: -each[0])


@pytest.mark.parametrize("seed", range(60))
def test_the_best_assignments_are_those_of_a_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pairs = [
        (track, candidate, float(rng.normal(1.0, 4.0)))
        for track in range(5)
        for candidate in range(5)
        if rng.random() < 0.6
    ]
    expected = every_assignment(pairs)
    expected = [each for each in expected if each[0] > expected[0][0] - LARGEST_LOSS]
    found = ranked(pairs, most=6)
    assert len(found) == min(6, len(expected))
    for own, (gain, taken) in zip(found, expected, strict=False):
        assert own.gain == pytest.approx(gain)
        assert taken_pairs(own) == taken


def test_the_order_of_the_pairs_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    pairs = [(i, j, float(rng.normal())) for i in range(5) for j in range(5)]
    shuffled = [pairs[k] for k in rng.permutation(len(pairs))]
    own, other = (ranked(each, 8) for each in (pairs, shuffled))
    assert [taken_pairs(each) for each in own] == [taken_pairs(each) for each in other]


def test_without_pairs_all_tracks_are_missed() -> None:
    nothing = np.zeros(0, dtype=np.int64)
    [only] = best_assignments([(0.0, Gains.of(nothing, nothing, np.zeros(0), 2, 3))], 3)
    assert only.gain == 0.0
    assert only.candidates.tolist() == [-1, -1]


@pytest.mark.parametrize("seed", range(10))
def test_the_best_assignments_of_several_problems_are_ranked_together(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    problems, expected = [], []
    for number in range(3):
        gain = float(rng.normal())
        pairs = [
            (i, j, float(rng.normal(1.0, 4.0))) for i in range(3) for j in range(3)
        ]
        tracks, candidates, values = (
            np.array(each) for each in zip(*pairs, strict=True)
        )
        problems.append((gain, Gains.of(tracks, candidates, values, 3, 3)))
        expected += [
            (gain + own, number, taken) for own, taken in every_assignment(pairs)
        ]
    expected = sorted(expected, key=lambda each: -each[0])[:5]
    least = expected[0][0] - LARGEST_LOSS
    found = best_assignments(problems, 5)
    assert [
        (pytest.approx(each.gain), each.problem, taken_pairs(each)) for each in found
    ] == [each for each in expected if each[0] > least]
