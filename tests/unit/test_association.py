import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2
from support.tracking import START_NS, bearing, candidate, candidates_of, ms, states

from fgtrack.config.settings import Config
from fgtrack.core.types import BoolArray, Detection, DetectionList, FloatArray, IntArray
from fgtrack.estimation.base import StatesAt
from fgtrack.karle2023.tracker_parts import UngatedEuclidean
from fgtrack.models.measurement import SensorPose
from fgtrack.models.sensors import SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.association import (
    Assignment,
    Association,
    GatedEuclidean,
    GatedMahalanobis,
    claimed,
    near,
)
from fgtrack.tracking.preprocess import Candidates
from fgtrack.tracking.soft_association import (
    LEAST_INFORMATION,
    equivalent,
    joint_probabilities,
    marginals,
)

ALL = [
    GatedEuclidean(),
    GatedEuclidean(max_nis=20.0),
    GatedMahalanobis(),
    UngatedEuclidean(),
]


def test_a_far_candidate_does_not_tear_a_good_pair_but_the_published_order_does() -> (
    None
):
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
    assert association(candidates_of([candidate(5.0, 0.0, 0.5)]), tracks).pairs == [
        (0, 0)
    ]
    assert (
        association(
            candidates_of([candidate(np.nextafter(5.0, 6.0), 0.0, 0.5)]), tracks
        ).pairs
        == []
    )


@pytest.mark.parametrize("association", ALL)
def test_without_candidates_or_tracks_there_are_only_births_and_misses(
    association: Association,
) -> None:
    assert association(
        candidates_of([]), states([(0.0, 0.0), (1.0, 0.0)])
    ) == Assignment([], [], [0, 1])
    assert association(
        candidates_of([candidate(0.0, 0.0), candidate(9.0, 0.0)]), states([])
    ) == Assignment([], [0, 1], [])
    assert association(candidates_of([]), states([])) == Assignment([], [], [])


@pytest.mark.parametrize("association", ALL)
@given(seed=st.integers(0, 2**32 - 1))
def test_everything_is_paired_or_left_over_exactly_once(
    association: Association, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    items = [
        candidate(x, y) for x, y in rng.uniform(0.0, 12.0, size=(rng.integers(0, 6), 2))
    ]
    tracks = states(
        [(x, y) for x, y in rng.uniform(0.0, 12.0, size=(rng.integers(0, 6), 2))]
    )
    pairs, new, missed, refused, _ = association(candidates_of(items), tracks)
    assert sorted([*(i for i, _ in pairs), *new, *refused]) == list(range(len(items)))
    assert sorted([j for _, j in pairs] + missed) == list(range(len(tracks.track_ids)))
    assert pairs == sorted(pairs)
    assert missed == sorted(missed)


def test_what_is_near_but_not_believed_goes_nowhere_and_leaves_the_track_to_others() -> (
    None
):
    """A variance of 0.16 and 0.09 m2: 3 m off is 36."""
    ghost, other, far = candidate(3.0, 0.0), candidate(-1.0, 0.0), candidate(0.0, 9.0)
    tracks = states([(0.0, 0.0)], variance_m2=0.16)
    assert GatedEuclidean(max_nis=36.1)(candidates_of([ghost]), tracks) == Assignment(
        [(0, 0)], [], []
    )
    assert GatedEuclidean(max_nis=35.9)(
        candidates_of([ghost, far]), tracks
    ) == Assignment([], [1], [0], (0,))
    assert GatedEuclidean(max_nis=35.9)(
        candidates_of([ghost, other]), tracks
    ) == Assignment([(1, 0)], [], [], (0,))


@pytest.mark.parametrize("probability", [0.9, 0.99])
def test_the_mahalanobis_gate_is_a_chi_square_quantile(probability: float) -> None:
    limit_m = math.sqrt((0.16 + 0.09) * float(chi2.ppf(probability, 2)))
    associate = GatedMahalanobis(gate_probability=probability)
    tracks = states([(0.0, 0.0)], variance_m2=0.16)
    assert associate(candidates_of([candidate(limit_m - 1e-6, 0.0)]), tracks).pairs == [
        (0, 0)
    ]
    assert (
        associate(candidates_of([candidate(0.0, limit_m + 1e-6)]), tracks).pairs == []
    )


def test_a_vague_track_does_not_win_by_being_vague() -> None:
    sharp, vague = states([(0.0, 0.0), (0.2, 0.0)]), 400.0 * np.eye(5)
    covariances = np.array([sharp.covariances[0], vague])
    tracks = type(sharp)(sharp.track_ids, sharp.means, covariances)
    assert GatedMahalanobis()(candidates_of([candidate(0.5, 0.0)]), tracks).pairs == [
        (0, 0)
    ]


def test_the_distance_of_a_bearing_is_from_the_track_to_the_line_of_sight_ahead() -> (
    None
):
    pose = SensorPose(1.0, 2.0, math.pi / 2)  # looks north; bearing -pi/2 is east
    tracks = states([(11.0, 2.0), (11.0, 5.0), (-4.0, 2.0), (1.0, 2.0)])
    distances = near(
        candidates_of([bearing(-math.pi / 2, pose), candidate(11.0, 2.0)]),
        tracks.means,
        math.inf,
    ).values.reshape(2, 4)
    assert distances[0] == pytest.approx([0.0, 3.0, 5.0, 0.0], abs=1e-12)
    assert distances[1] == pytest.approx([0.0, 3.0, 15.0, 10.0])


@pytest.mark.parametrize("association", ALL)
def test_a_bearing_takes_the_track_in_its_line_of_sight(
    association: Association,
) -> None:
    pose = SensorPose(10.0, -20.0, math.pi / 2)
    tracks = states([(7.1, 10.0), (10.1, 10.0)])
    assert association(candidates_of([bearing(0.0, pose)]), tracks).pairs == [(0, 1)]


def test_the_uncertainty_of_a_bearing_is_that_seen_from_the_sensor() -> None:
    """A standard deviation of 1 m is 0.1 rad at 10 m, so 0.15 rad is inside; at 1 km it would be outside."""
    tracks = states([(1010.0, 1.5)], variance_m2=1.0)
    assert GatedMahalanobis()(
        candidates_of([bearing(0.0, SensorPose(1000.0, 0.0, 0.0))]), tracks
    ).pairs == [(0, 0)]


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
        (lambda: GatedMahalanobis(joint_from=0), "joint_from"),
    ],
)
def test_a_gate_that_makes_no_sense_is_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_a_candidate_near_a_track_that_is_not_its_own_starts_none() -> None:
    """The other end of a hull: beyond the gate, or its track has a better one."""
    tracks = states([(0.0, 0.0), (100.0, 0.0)], variance_m2=0.5)
    seen = [
        candidate(0.5, 0.0, 0.5),
        candidate(15.0, 0.0, 0.5),
        candidate(60.0, 0.0, 0.5),
        candidate(0.0, 3.0, 0.5),
    ]
    free = GatedMahalanobis()(candidates_of(seen), tracks)
    assert (free.pairs, free.new, free.refused) == ([(0, 0)], [1, 2, 3], ())
    near = claimed(free, candidates_of(seen), tracks, 20.0, None)
    assert (near.pairs, near.new, near.missed, near.refused) == (
        [(0, 0)],
        [2],
        [1],
        (1, 3),
    )
    assert claimed(free, candidates_of(seen), states([]), 20.0, None).new == [1, 2, 3]


def test_a_track_claims_no_candidate_of_another_class() -> None:
    tracks, seen = (
        states([(0.0, 0.0)]),
        candidates_of([candidate(12.0, 0.0), candidate(0.0, 12.0)]),
    )

    def of_another_class(rows: IntArray, columns: IntArray) -> BoolArray:
        return np.asarray(rows == 1)

    found = claimed(Assignment([], [0, 1], [0]), seen, tracks, 20.0, of_another_class)
    assert (found.new, found.refused) == ([1], (0,))


def enumerated(weights: FloatArray) -> FloatArray:
    """The marginal probabilities of pairs, by all joint events."""
    m, n = weights.shape
    total, sums = 0.0, np.zeros_like(weights)
    for event in product(range(-1, n), repeat=m):
        used = [i for i in event if i >= 0]
        if len(set(used)) == len(used):
            probability = math.prod(
                weights[j, i] for j, i in enumerate(event) if i >= 0
            )
            total += probability
            for j, i in enumerate(event):
                if i >= 0:
                    sums[j, i] += probability
    return sums / total


def test_probabilities_of_pairs_are_those_of_all_joint_events() -> None:
    """Exact on a chain of tracks; within some hundredths where tracks compete for two detections in a circle."""
    chain = np.array([[5.0, 0.3, 0.0], [0.0, 2.0, 8.0], [0.0, 0.0, 1.5]])
    np.testing.assert_allclose(marginals(chain), enumerated(chain), atol=1e-9)
    rng = np.random.default_rng(1)
    for _ in range(20):
        weights = np.exp(rng.normal(0.0, 2.0, (3, 4)))
        np.testing.assert_allclose(marginals(weights), enumerated(weights), atol=0.06)


def fused(
    x: FloatArray, P: FloatArray, z: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The Kalman update by one position."""
    K = P[:, :2] @ np.linalg.inv(P[:2, :2] + R)
    return x + K @ (z - x[:2]), P - K @ P[:2]


def jointly(
    points: list[tuple[float, float]], tracks: StatesAt
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Equivalent positions of the first candidates, one for each track, their covariances, and the probabilities."""
    rule, sensor = (
        GatedMahalanobis(),
        SensorModel(std={"x_m": 0.3, "y_m": 0.3}, clutter_per_m2=1e-2),
    )
    single = candidates_of([candidate(x, y) for x, y in points])
    group = single.groups[0]
    own = group.stack
    z, R = np.array(points), np.repeat(own.R, len(points), axis=0)
    stacked = group._replace(
        rows=np.arange(len(points)), stack=replace(own, z=z, R=R), spread=R
    )
    candidates = Candidates(single.leaders, {}, single.lines, [stacked])
    joint = joint_probabilities(
        rule.gated(candidates, tracks), candidates, tracks, sensor
    )
    of = np.arange(len(tracks.track_ids))
    seen = stacked.seen_at(of, tracks.means, tracks.covariances, of)
    result = equivalent(seen, of, stacked, joint, tracks)
    b = np.zeros((len(of), len(points)))
    b[joint.columns, joint.rows] = joint.values
    return result.z, result.R, b


def test_the_equivalent_measurement_updates_as_the_mixture_of_all_does() -> None:
    """Moments of the mixture of the updates by each detection and of no update."""
    tracks = states([(0.0, 0.0)], variance_m2=0.5)
    points = [(0.4, 0.1), (-0.3, 0.6)]
    z, R, b = jointly(points, tracks)
    x, P = tracks.means[0], tracks.covariances[0]
    parts = [(1.0 - b[0].sum(), x, P)]
    parts += [
        (w, *fused(x, P, np.array(p), 0.09 * np.eye(2)))
        for w, p in zip(b[0], points, strict=True)
    ]
    mean = sum(w * m for w, m, _ in parts)
    covariance = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in parts)
    found = fused(x, P, z[0], R[0])
    np.testing.assert_allclose(found[0], mean, atol=1e-12)
    np.testing.assert_allclose(found[1], covariance, atol=1e-12)


def test_detections_far_apart_keep_the_mean_and_nearly_the_covariance() -> None:
    tracks = states([(0.0, 0.0)], variance_m2=4.0)
    z, R, b = jointly([(4.0, 0.0), (-3.9, 0.0)], tracks)
    x, P = tracks.means[0], tracks.covariances[0]
    mean, covariance = fused(x, P, z[0], R[0])
    assert mean[0] == pytest.approx(4.0 / 4.09 * (b[0] @ [4.0, -3.9]))
    assert covariance[0, 0] == pytest.approx(4.0 - LEAST_INFORMATION * 16.0 / 4.09)
    assert np.linalg.eigvalsh(R[0] - 0.09 * np.eye(2))[0] > 0.0


def test_a_detection_is_shared_by_the_tracks_that_compete_for_it() -> None:
    _, _, b_alone = jointly([(0.5, 0.0)], states([(0.0, 0.0)], variance_m2=0.3))
    points = [(0.5, 0.0), (0.6, 0.0)]
    near, _, b_near = jointly(points, states([(0.0, 0.0), (1.0, 0.0)], variance_m2=0.3))
    assert b_near[0, 0] < b_alone[0, 0]
    assert b_near.sum(axis=0).max() <= 1.0 + 1e-9
    assert near[0, 0] < near[1, 0]


def test_a_track_without_a_probability_keeps_its_detection() -> None:
    tracks = states([(0.0, 0.0)])
    items = candidates_of([candidate(0.2, 0.0)])
    group, of = items.groups[0], np.array([0])
    seen = group.seen_at(of, tracks.means, tracks.covariances, of)
    nothing = GatedMahalanobis().gated(items, states([(9.0, 9.0)]))
    result = equivalent(seen, of, group, nothing, tracks)
    np.testing.assert_array_equal(result.z, seen.z)
    np.testing.assert_array_equal(result.R, seen.R)


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_a_track_with_enough_detections_is_updated_by_all_in_its_gate(
    estimator: str,
) -> None:
    """Clutter 0.4 m to the left pulls it there; its own detection, which is nearer, counts alone before that."""

    def left_m(joint_from: int | None) -> float:
        association = GatedMahalanobis(joint_from=joint_from)
        sensor = SensorModel(std={"x_m": 0.3, "y_m": 0.3})
        config = Config(
            sensors={"lidar": sensor}, association=association, estimator=estimator
        )
        tracker = build_tracker(config)
        for k in range(3):
            points = [(20.0, 5.0), (20.0, 5.4)] if k == 2 else [(20.0, 5.0)]
            stamp_ns = START_NS + ms(100 * k)
            objects = [Detection(x_m=x, y_m=y) for x, y in points]
            tracker.receive(DetectionList("lidar", stamp_ns, stamp_ns, objects, "map"))
            report = tracker.tick(stamp_ns)
        assert sorted(each.disposition.value for each in report.updates) == [
            "birth",
            "in_sequence",
        ]
        return report.tracks[0].y_m

    assert left_m(3) == left_m(None)
    assert left_m(2) > left_m(None) + 0.02
