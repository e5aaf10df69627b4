import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2
from support.tracking import bearing, candidate, candidates_of, states

from fgtrack.core.types import BoolArray, IntArray
from fgtrack.models.measurement import SensorPose
from fgtrack.tracking.association import Assignment, Association, GatedEuclidean, GatedMahalanobis, near
from fgtrack.tracking.published import UngatedEuclidean

ALL = [GatedEuclidean(), GatedEuclidean(max_nis=20.0), GatedMahalanobis(), UngatedEuclidean()]


def test_a_far_candidate_does_not_tear_a_good_pair_but_the_published_order_does() -> None:
    """The sum over both pairs is least where the near candidate gives its track to the far one."""
    near, far = candidate(1.0, 0.0), candidate(-8.0, 0.0)
    tracks = states([(0.0, 0.0), (5.5, 0.0)])
    clean = GatedEuclidean()(candidates_of([near, far]), tracks)
    assert clean.pairs == [(0, 0)]
    assert (clean.new, clean.missed) == ([1], [1])
    published = UngatedEuclidean()(candidates_of([near, far]), tracks)
    assert published.pairs == [(0, 1)]  # its second choice, at 4.5 m
    assert (published.new, published.missed) == ([1], [0])


@pytest.mark.parametrize(
    "association",
    [
        GatedEuclidean(gate_m=5.0),
        GatedEuclidean(gate_m=9.0, max_nis=25.0),
        GatedMahalanobis(max_distance_m=5.0, gate_probability=1.0 - 1e-9),
        UngatedEuclidean(gate_m=5.0),
    ],
)
def test_the_gate_itself_is_inside(association: Association) -> None:
    tracks = states([(0.0, 0.0)], variance_m2=0.5)
    assert association(candidates_of([candidate(5.0, 0.0, 0.5)]), tracks).pairs == [(0, 0)]
    assert association(candidates_of([candidate(np.nextafter(5.0, 6.0), 0.0, 0.5)]), tracks).pairs == []


@pytest.mark.parametrize("association", ALL)
def test_without_candidates_or_tracks_there_are_only_births_and_misses(association: Association) -> None:
    assert association(candidates_of([]), states([(0.0, 0.0), (1.0, 0.0)])) == Assignment([], [], [0, 1])
    assert association(candidates_of([candidate(0.0, 0.0), candidate(9.0, 0.0)]), states([])) == Assignment(
        [], [0, 1], []
    )
    assert association(candidates_of([]), states([])) == Assignment([], [], [])


@pytest.mark.parametrize("association", ALL)
@given(seed=st.integers(0, 2**32 - 1))
def test_everything_is_paired_or_left_over_exactly_once(association: Association, seed: int) -> None:
    rng = np.random.default_rng(seed)
    items = [candidate(x, y) for x, y in rng.uniform(0.0, 12.0, size=(rng.integers(0, 6), 2))]
    tracks = states([(x, y) for x, y in rng.uniform(0.0, 12.0, size=(rng.integers(0, 6), 2))])
    pairs, new, missed, refused = association(candidates_of(items), tracks)
    assert sorted([*(i for i, _ in pairs), *new, *refused]) == list(range(len(items)))
    assert sorted([j for _, j in pairs] + missed) == list(range(len(tracks.track_ids)))
    assert pairs == sorted(pairs)
    assert missed == sorted(missed)


def test_what_is_near_but_not_believed_goes_nowhere_and_leaves_the_track_to_others() -> None:
    """A variance of 0.16 and 0.09 m2: 3 m off is 36."""
    ghost, other, far = candidate(3.0, 0.0), candidate(-1.0, 0.0), candidate(0.0, 9.0)
    tracks = states([(0.0, 0.0)], variance_m2=0.16)
    assert GatedEuclidean(max_nis=36.1)(candidates_of([ghost]), tracks) == Assignment([(0, 0)], [], [])
    assert GatedEuclidean(max_nis=35.9)(candidates_of([ghost, far]), tracks) == Assignment([], [1], [0], (0,))
    assert GatedEuclidean(max_nis=35.9)(candidates_of([ghost, other]), tracks) == Assignment([(1, 0)], [], [], (0,))


@pytest.mark.parametrize("probability", [0.9, 0.99])
def test_the_mahalanobis_gate_is_a_chi_square_quantile(probability: float) -> None:
    limit_m = math.sqrt((0.16 + 0.09) * float(chi2.ppf(probability, 2)))
    associate = GatedMahalanobis(gate_probability=probability)
    tracks = states([(0.0, 0.0)], variance_m2=0.16)
    assert associate(candidates_of([candidate(limit_m - 1e-6, 0.0)]), tracks).pairs == [(0, 0)]
    assert associate(candidates_of([candidate(0.0, limit_m + 1e-6)]), tracks).pairs == []


def test_a_vague_track_does_not_win_by_being_vague() -> None:
    sharp, vague = states([(0.0, 0.0), (0.2, 0.0)]), 400.0 * np.eye(5)
    covariances = np.array([sharp.covariances[0], vague])
    tracks = type(sharp)(sharp.track_ids, sharp.means, covariances)
    assert GatedMahalanobis()(candidates_of([candidate(0.5, 0.0)]), tracks).pairs == [(0, 0)]


def test_the_distance_of_a_bearing_is_from_the_track_to_the_line_of_sight_ahead() -> None:
    pose = SensorPose(1.0, 2.0, math.pi / 2)  # looks north; bearing -pi/2 is east
    tracks = states([(11.0, 2.0), (11.0, 5.0), (-4.0, 2.0), (1.0, 2.0)])
    distances = near(
        candidates_of([bearing(-math.pi / 2, pose), candidate(11.0, 2.0)]), tracks.means, math.inf
    ).values.reshape(2, 4)
    assert distances[0] == pytest.approx([0.0, 3.0, 5.0, 0.0], abs=1e-12)
    assert distances[1] == pytest.approx([0.0, 3.0, 15.0, 10.0])


@pytest.mark.parametrize("association", ALL)
def test_a_bearing_takes_the_track_in_its_line_of_sight(association: Association) -> None:
    pose = SensorPose(10.0, -20.0, math.pi / 2)
    tracks = states([(7.1, 10.0), (10.1, 10.0)])
    assert association(candidates_of([bearing(0.0, pose)]), tracks).pairs == [(0, 1)]


def test_the_uncertainty_of_a_bearing_is_that_seen_from_the_sensor() -> None:
    """A standard deviation of 1 m is 0.1 rad at 10 m, so 0.15 rad is inside; at 1 km it would be outside."""
    tracks = states([(1010.0, 1.5)], variance_m2=1.0)
    assert GatedMahalanobis()(candidates_of([bearing(0.0, SensorPose(1000.0, 0.0, 0.0))]), tracks).pairs == [(0, 0)]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GatedEuclidean(gate_m=0.0), "gate_m"),
        (lambda: GatedEuclidean(gate_m=math.nan), "gate_m"),
        (lambda: GatedEuclidean(max_nis=0.0), "max_nis"),
        (lambda: GatedMahalanobis(gate_probability=0.0), "gate_probability"),
        (lambda: GatedMahalanobis(gate_probability=1.0), "gate_probability"),
        (lambda: GatedMahalanobis(max_distance_m=0.0), "max_distance_m"),
        (lambda: GatedMahalanobis(claim_m=-1.0), "claim_m"),
    ],
)
def test_a_gate_that_makes_no_sense_is_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_candidate_near_a_track_that_is_not_its_own_starts_none() -> None:
    """The other end of a hull: beyond the gate, or its track has a better one."""
    tracks = states([(0.0, 0.0), (100.0, 0.0)], variance_m2=0.5)
    seen = [candidate(0.5, 0.0, 0.5), candidate(15.0, 0.0, 0.5), candidate(60.0, 0.0, 0.5), candidate(0.0, 3.0, 0.5)]
    free = GatedMahalanobis()(candidates_of(seen), tracks)
    assert (free.pairs, free.new, free.refused) == ([(0, 0)], [1, 2, 3], ())
    claimed = GatedMahalanobis(claim_m=20.0)(candidates_of(seen), tracks)
    assert (claimed.pairs, claimed.new, claimed.missed, claimed.refused) == ([(0, 0)], [2], [1], (1, 3))
    assert GatedMahalanobis(claim_m=20.0)(candidates_of(seen[1:2]), states([])).new == [0]


def test_a_track_claims_no_candidate_of_another_class() -> None:
    tracks, seen = states([(0.0, 0.0)]), candidates_of([candidate(12.0, 0.0), candidate(0.0, 12.0)])

    def of_another_class(rows: IntArray, columns: IntArray) -> BoolArray:
        return np.asarray(rows == 1)

    found = GatedMahalanobis(claim_m=20.0)(seen, tracks, of_another_class)
    assert (found.new, found.refused) == ([1], (0,))
