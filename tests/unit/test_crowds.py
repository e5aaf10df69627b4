"""Lists with far more detections than objects: the same outcome as by looking at all pairs, in bounded memory."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from support.tracking import bearing, candidate, states

from fgtrack.core.types import FloatArray
from fgtrack.models.measurement import SensorPose
from fgtrack.tracking import assignment, gating, merge
from fgtrack.tracking.assignment import assigned, assigned_densely
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.gating import Pairs, alike, euclidean_distances, innovations, near
from fgtrack.tracking.merge import ConnectedMerge
from fgtrack.tracking.preprocess import Candidate

MB = 1e6


def peak_bytes(call: Callable[[], object]) -> int:
    """Most memory that `call` has in use at a time, beyond what was in use before."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        call()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


@pytest.fixture
def small_portions(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever is done otherwise for large problems is done for small ones."""
    monkeypatch.setattr(gating, "MOST_PAIRS", 7)
    monkeypatch.setattr(gating, "_FEW_DISTANCES", 0)
    monkeypatch.setattr(assignment, "MOST_PAIRS", 7)
    monkeypatch.setattr(assignment, "_FEW_COSTS", 0)


# --- assignment


def pairs_of(cost: FloatArray) -> Pairs:
    rows, columns = np.nonzero(np.isfinite(cost))
    return Pairs(rows, columns, cost[rows, columns])


def outcome(cost: FloatArray, pairs: list[tuple[int, int]]) -> tuple[int, float]:
    return len(pairs), sum(cost[pair] for pair in pairs)


@pytest.mark.parametrize("taken_apart", [False, True])
@given(seed=st.integers(0, 2**32 - 1))
def test_parts_solved_by_themselves_are_the_solution_of_the_whole(taken_apart: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0.0, 5.0, size=rng.integers(1, 12, size=2))
    cost[rng.random(cost.shape) > rng.uniform(0.05, 0.9)] = np.inf
    with pytest.MonkeyPatch.context() as patch:
        if taken_apart:
            patch.setattr(assignment, "_FEW_COSTS", 0)
        found = assigned(pairs_of(cost), *cost.shape)
    assert found == assigned_densely(cost, np.isfinite(cost))
    rows, columns = linear_sum_assignment(np.where(np.isfinite(cost), cost, 1e9))
    best = [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if np.isfinite(cost[i, j])]
    assert found.pairs == best


@given(seed=st.integers(0, 2**32 - 1))
def test_among_equal_costs_as_many_pairs_at_the_same_cost_are_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.integers(0, 3, size=rng.integers(1, 10, size=2)).astype(float)
    cost[rng.random(cost.shape) > rng.uniform(0.1, 0.9)] = np.inf
    found = assigned(pairs_of(cost), *cost.shape)
    dense = assigned_densely(cost, np.isfinite(cost))
    assert outcome(cost, found.pairs) == outcome(cost, dense.pairs)
    assert len({i for i, _ in found.pairs}) == len({j for _, j in found.pairs}) == len(found.pairs)


@pytest.mark.usefixtures("small_portions")
@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("seed", range(40))
def test_what_is_left_out_of_a_large_part_changes_nothing(
    seed: int, counted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More candidates than rivals for each track, some of one cost: the dearer ones cannot be needed."""
    monkeypatch.setattr(assignment, "_MOST_LINKS", assignment._MOST_LINKS if counted else 0)
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0.0, 5.0, size=(40, rng.integers(1, 5)))
    if seed % 2:
        cost = np.round(cost)
    cost[rng.random(cost.shape) > 0.5] = np.inf
    found, dense = assigned(pairs_of(cost), *cost.shape), assigned_densely(cost, np.isfinite(cost))
    assert outcome(cost, found.pairs) == pytest.approx(outcome(cost, dense.pairs), abs=1e-6)
    if not seed % 2:
        assert found == dense


@pytest.mark.usefixtures("small_portions")
def test_where_too_many_share_too_many_the_cheapest_go_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assignment, "_MOST_COSTS", 8)
    cost = np.array([[1.0, 2.0, np.inf], [3.0, 9.0, 4.0], [0.5, 7.0, 8.0]])
    found = assigned(pairs_of(cost), 3, 3)
    assert found.pairs == [(0, 1), (1, 2), (2, 0)]
    assert not found.new
    assert not found.missed
    rng = np.random.default_rng(1)
    cost = rng.uniform(0.0, 5.0, size=(30, 20))
    found = assigned(pairs_of(cost), 30, 20)
    best = outcome(cost, assigned_densely(cost, np.isfinite(cost)).pairs)
    assert best[1] <= outcome(cost, found.pairs)[1] < 4.0 * best[1]
    assert len(found.pairs) == len({j for _, j in found.pairs}) == best[0] == 20
    assert found.new == sorted(set(range(30)) - {i for i, _ in found.pairs})


# --- gates


def mixed(rng: np.random.Generator, count: int, side_m: float) -> list[Candidate]:
    """Positions and some bearings."""
    found = [candidate(x, y, float(rng.choice([0.04, 0.25]))) for x, y in rng.uniform(0.0, side_m, size=(count, 2))]
    eye = SensorPose(-5.0, -5.0, 0.3)
    return [bearing(float(rng.uniform(-0.5, 1.0)), eye) if rng.random() < 0.1 else each for each in found]


@pytest.mark.parametrize(
    "association",
    [
        GatedEuclidean(gate_m=3.0),
        GatedEuclidean(gate_m=4.0, max_nis=30.0),
        GatedMahalanobis(gate_probability=0.999, max_distance_m=9.0),
    ],
)
@pytest.mark.parametrize("bearings", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_an_association_by_portions_is_that_of_all_pairs(
    association: GatedEuclidean | GatedMahalanobis, bearings: bool, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(seed)
    candidates = mixed(rng, 60, 40.0)
    candidates = [each for each in candidates if bearings or each.position_m is not None]
    tracks = states([(x, y) for x, y in rng.uniform(0.0, 40.0, size=(30, 2))])
    tracks.covariances[:] *= rng.uniform(0.1, 30.0, size=(30, 1, 1))
    whole = association(candidates, tracks)
    monkeypatch.setattr(gating, "MOST_PAIRS", 7)
    monkeypatch.setattr(gating, "_FEW_DISTANCES", 0)
    assert association(candidates, tracks) == whole
    if isinstance(association, GatedMahalanobis):
        everywhere = np.nonzero(np.ones((len(candidates), 30), dtype=bool))
        distances = euclidean_distances(candidates, tracks.means)
        pairs = Pairs(*everywhere, distances[everywhere])
        nis, S_all = innovations(pairs, alike(candidates), len(candidates), tracks)
        cost, inside = nis.copy(), np.zeros(len(nis), dtype=bool)
        for chosen, S in S_all:
            cost[chosen] += np.linalg.slogdet(S)[1]
            limit = {1: 10.8275661707, 2: 13.8155105580}[S.shape[-1]]  # chi-square quantiles of 0.999
            inside[chosen] = (nis[chosen] <= limit) & (pairs.values[chosen] <= 9.0)
        dense = assigned_densely(cost.reshape(distances.shape), inside.reshape(distances.shape))
        assert whole == dense


@pytest.mark.usefixtures("small_portions")
def test_a_portion_has_few_pairs_unless_one_candidate_has_many() -> None:
    rng = np.random.default_rng(1)
    candidates, tracks = mixed(rng, 50, 20.0), states([(x, y) for x, y in rng.uniform(0.0, 20.0, size=(12, 2))])
    parts = list(near(candidates, tracks.means, 6.0))
    assert max(len(part.rows) for part in parts if len(set(part.rows.tolist())) > 1) <= 7
    rows, columns = np.nonzero(euclidean_distances(candidates, tracks.means) <= 6.0)
    whole = Pairs.joined(parts)
    np.testing.assert_array_equal(whole.rows, rows)
    np.testing.assert_array_equal(whole.columns, columns)


@pytest.mark.parametrize("bearings", [False, True])
def test_a_candidate_among_too_many_tracks_sees_the_nearest(bearings: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gating, "MOST_NEAR", 5)
    monkeypatch.setattr(gating, "_FEW_DISTANCES", 0)
    rng = np.random.default_rng(2)
    candidates = [each for each in mixed(rng, 40, 6.0) if bearings or each.position_m is not None]
    tracks = states([(x, y) for x, y in rng.uniform(0.0, 6.0, size=(30, 2))])
    distances = euclidean_distances(candidates, tracks.means)
    found = Pairs.joined(list(near(candidates, tracks.means, 2.0)))
    most = 0
    for row, of_row in enumerate(distances):
        nearest = np.sort(of_row[of_row <= 2.0])[:5]
        most = max(most, np.count_nonzero(of_row <= 2.0))
        np.testing.assert_array_equal(np.sort(found.values[found.rows == row]), nearest)
    assert most > 5


@pytest.mark.parametrize("association", [GatedEuclidean(gate_m=5.0), GatedMahalanobis()])
def test_detections_and_tracks_all_in_one_place_are_not_all_compared(
    association: GatedEuclidean | GatedMahalanobis,
) -> None:
    """3,000 of each: their pairs, and the distances of one kind alone, have 72 MB each."""
    rng = np.random.default_rng(0)
    candidates = [candidate(x, y) for x, y in rng.normal(0.0, 0.3, size=(3_000, 2)).tolist()]
    tracks = states([(x, y) for x, y in rng.normal(0.0, 0.3, size=(3_000, 2)).tolist()])
    found: list[assignment.Assignment] = []
    peak = peak_bytes(lambda: found.append(association(candidates, tracks)))
    assert peak < 90 * MB, f"{peak / MB:.0f} MB"
    assert len(found[0].pairs) > 2_700


@pytest.mark.parametrize(
    "association", [GatedEuclidean(gate_m=5.0), GatedEuclidean(gate_m=5.0, max_nis=400.0), GatedMahalanobis()]
)
@pytest.mark.parametrize("side_m", [2000.0, 100.0])
def test_memory_grows_with_the_detections_and_not_with_detections_times_tracks(
    association: GatedEuclidean | GatedMahalanobis, side_m: float
) -> None:
    """20,000 detections and 500 tracks: a matrix of one number for each pair has 80 MB."""
    rng = np.random.default_rng(0)
    candidates = [candidate(x, y) for x, y in rng.uniform(0.0, side_m, size=(20_000, 2)).tolist()]
    tracks = states([(x, y) for x, y in rng.uniform(0.0, side_m, size=(500, 2)).tolist()])
    peak = peak_bytes(lambda: association(candidates, tracks))
    assert peak < 40 * MB, f"{peak / MB:.0f} MB"


# --- merge


def groups_by_hand(points_m: FloatArray, distance_m: float) -> set[frozenset[int]]:
    left, groups = set(range(len(points_m))), set()
    while left:
        frontier = [left.pop()]
        group = set(frontier)
        while frontier:
            here = frontier.pop()
            close = {i for i in left if np.sum((points_m[i] - points_m[here]) ** 2) <= distance_m**2}
            group |= close
            left -= close
            frontier += close
        groups.add(frozenset(group))
    return groups


@pytest.mark.parametrize("crowded", [False, True])
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 60), lattice=st.booleans())
def test_groups_are_those_of_a_search_by_hand_in_a_crowd_as_well(
    crowded: bool, seed: int, count: int, lattice: bool
) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, size=(count, 2)) * rng.uniform(2.0, 60.0) + rng.choice([0.0, 1e6])
    if lattice:
        points = 2.5 * np.round(points / 2.5)  # many steps of just the distance, and equal points
    with pytest.MonkeyPatch.context() as patch:
        if crowded:
            patch.setattr(merge, "_FEW", 0)
            patch.setattr(merge, "_MANY_PAIRS", -1)
        groups = ConnectedMerge(distance_m=5.0).groups(points)
    assert {frozenset(members) for members in groups.values()} == groups_by_hand(points, 5.0)
    assert list(groups) == sorted(groups)
    assert all(leader == members[0] and sorted(members) == list(members) for leader, members in groups.items())


@pytest.mark.parametrize("spread_m", [10.0, 60.0])
def test_a_crowd_is_merged_in_memory_that_grows_with_its_points(spread_m: float) -> None:
    """20,000 points within 10 m have 200 million pairs, 3.2 GB of two numbers each."""
    points = np.random.default_rng(0).uniform(0.0, spread_m, size=(20_000, 2))
    peak = peak_bytes(lambda: ConnectedMerge(5.1).groups(points))
    assert peak < 40 * MB, f"{peak / MB:.0f} MB"
