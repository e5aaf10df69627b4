"""Ranked assignments equal those of a search over all assignments."""

from itertools import product

import numpy as np
import pytest

from fgtrack.core.types import IntArray
from fgtrack.tracking.decisions.ranking import (
    LARGEST_LOSS,
    Gains,
    Ranked,
    best_assignments,
)

Pair = tuple[int, int, float]


def gains_of(pairs: list[Pair], num_tracks: int, num_candidates: int) -> Gains:
    """Return the gains of pairs of tracks and candidates."""
    pairs = sorted(pairs)
    tracks, candidates, values = (
        np.array([each[k] for each in pairs]) for k in range(3)
    )
    first = np.searchsorted(tracks, np.arange(num_tracks + 1))
    return Gains(first, candidates.astype(int), values.astype(float), num_candidates)


def ranked(pairs: list[Pair], most: int) -> tuple[Gains, Ranked]:
    """Return the best assignments of pairs of five tracks and five candidates."""
    gains = gains_of(pairs, 5, 5)
    return gains, best_assignments(gains, [(0.0, np.arange(5))], most)


def taken_pairs(gains: Gains, pairs: IntArray) -> frozenset[tuple[int, int]]:
    return frozenset(
        (track, int(gains.candidates[pair]))
        for track, pair in enumerate(pairs.tolist())
        if pair >= 0
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
    gains, found = ranked(pairs, most=6)
    assert len(found.gains) == min(6, len(expected))
    for total, own, (gain, taken) in zip(
        found.gains.tolist(), found.pairs, expected, strict=False
    ):
        assert total == pytest.approx(gain)
        assert taken_pairs(gains, own) == taken


def test_without_pairs_all_tracks_are_missed() -> None:
    found = best_assignments(gains_of([], 2, 3), [(0.0, np.arange(2))], 3)
    assert found.gains.tolist() == [0.0]
    assert found.pairs.tolist() == [[-1, -1]]


@pytest.mark.parametrize("seed", range(10))
def test_the_best_assignments_of_several_problems_are_ranked_together(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    problems, every, expected = [], [], []
    for number in range(3):
        gain = float(rng.normal())
        tracks = range(3 * number, 3 * number + 3)
        pairs = [(i, j, float(rng.normal(1.0, 4.0))) for i in tracks for j in range(3)]
        every += pairs
        problems.append((gain, np.array(tracks)))
        expected += [
            (gain + own, number, taken) for own, taken in every_assignment(pairs)
        ]
    expected = sorted(expected, key=lambda each: -each[0])[:5]
    least = expected[0][0] - LARGEST_LOSS
    gains = gains_of(every, 9, 3)
    found = best_assignments(gains, problems, 5)
    assert [
        (pytest.approx(total), problem, taken_pairs(gains, pairs))
        for total, problem, pairs in zip(
            found.gains.tolist(), found.problems.tolist(), found.pairs, strict=True
        )
    ] == [each for each in expected if each[0] > least]


def test_problems_may_share_tracks() -> None:
    gains = gains_of([(0, 0, 2.0), (1, 0, 1.2), (1, 1, 1.0)], 2, 2)
    problems = [(0.0, np.array([0])), (0.5, np.array([0, 1]))]
    found = best_assignments(gains, problems, 3)
    assert found.gains.tolist() == pytest.approx([3.5, 2.5, 2.0])
    assert found.problems.tolist() == [1, 1, 0]
    assert found.pairs.tolist() == [[0, 2], [0, -1], [0, -2]]
