"""Sets of detections of one object, and the extent that they show."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.tracking import START_NS, bearing, candidate, candidates_of, ms, states

import fgtrack
from fgtrack.core.types import Detection, DetectionList, FloatArray
from fgtrack.models.measurement import SensorPose
from fgtrack.pipeline.config import Config
from fgtrack.tracking.association import Assignment, Association, GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.extent import ExtentRules, Extents
from fgtrack.tracking.preprocess import Candidate, Candidates

HULL = ExtentRules(std_m=5.0)
TRACK = 10
WIDE = GatedEuclidean(gate_m=50.0)


def joined(
    extents: Extents,
    items: Sequence[Candidate],
    tracks_m: Sequence[tuple[float, float]],
    stamp_ms: float = 0.0,
    association: Association = WIDE,
) -> tuple[Candidates, Assignment]:
    own, candidates = states(tracks_m), candidates_of(items)
    assignment = association(candidates, own)
    return extents.joined(candidates, assignment, own, START_NS + ms(stamp_ms))


def of(extents: Extents, track_id: int = TRACK) -> FloatArray:
    return extents.of([track_id])[0]


def test_both_ends_of_a_hull_are_one_detection_of_its_track() -> None:
    candidates, assignment = joined(Extents(HULL), [candidate(8.0, 0.0), candidate(-6.0, 2.0)], [(0.0, 0.0)])
    assert assignment == Assignment([(0, 0)], [], [])
    assert (candidates.leaders, candidates.merged) == ([1], {1: (0,)})
    assert candidates[0].position_m == pytest.approx([1.0, 1.0])
    assert candidates[0].values == pytest.approx({"x_m": 1.0, "y_m": 1.0})


def test_each_of_two_tracks_takes_what_is_nearer() -> None:
    items = [candidate(x, 0.0) for x in (-1.0, 1.0, 9.0, 13.0)]
    candidates, assignment = joined(Extents(ExtentRules(std_m=2.0)), items, [(0.0, 0.0), (10.0, 0.0)])
    positions = [candidates[position].position_m for position, _ in assignment.pairs]
    assert np.array(positions) == pytest.approx(np.array([[0.0, 0.0], [11.0, 0.0]]))
    assert (assignment.new, assignment.missed) == ([], [])


def test_detections_without_a_track_are_clustered() -> None:
    items = [candidate(x, 0.0) for x in (100.0, 300.0, 112.0, 124.0)]
    candidates, assignment = joined(Extents(HULL), items, [(0.0, 0.0)])
    assert (assignment.pairs, assignment.new, assignment.missed) == ([], [0, 1], [0])
    assert (candidates.leaders, candidates.merged) == ([0, 1], {0: (2, 3)})
    assert candidates[0].position_m == pytest.approx([112.0, 0.0])


def test_what_an_association_claims_for_a_track_joins_it_or_is_refused() -> None:
    items, claiming = [candidate(x, 0.0) for x in (0.0, 9.0, 19.0)], GatedMahalanobis(claim_m=20.0)
    candidates, assignment = joined(Extents(ExtentRules(std_m=3.0)), items, [(0.0, 0.0)], association=claiming)
    assert assignment == Assignment([(0, 0)], [], [], (1,))
    assert (candidates.leaders, candidates.merged) == ([0, 2], {0: (1,)})


def test_a_bearing_joins_nothing() -> None:
    items = [candidate(1.0, 0.0), bearing(0.0, SensorPose(-50.0, 30.0, 0.0)), candidate(2.0, 0.0)]
    candidates, assignment = joined(Extents(HULL), items, [(0.0, 0.0)])
    assert (candidates.leaders, assignment.new) == ([0, 1], [1])


def test_a_boat_that_was_always_small_leaves_a_detection_beside_it_to_another() -> None:
    extents = Extents(HULL)
    beside = [candidate(0.1, 0.0), candidate(0.0, 12.0)]
    assert joined(extents, beside, [(0.0, 0.0)])[1].new == []
    rng = np.random.default_rng(0)
    for k in range(40):
        joined(extents, [candidate(*rng.normal(0.0, 0.3, 2))], [(0.0, 0.0)], 500.0 * k)
    assert math.sqrt(of(extents)[0, 0]) < 2.5
    assert joined(extents, beside, [(0.0, 0.0)], 20_000.0)[1].new == [1]


@pytest.mark.parametrize("count", [1, 4])
def test_the_extent_is_the_covariance_of_the_detections(count: int) -> None:
    """4,000 detections, of which 400 are remembered: 5 % of a standard deviation is 1.4 of its own errors."""
    extents, truth = Extents(ExtentRules(std_m=3.0, memory_s=float(400 // count), gate_probability=1.0 - 1e-12)), []
    rng, turn = np.random.default_rng(1), np.array([[0.8, -0.6], [0.6, 0.8]])
    D = turn @ np.diag([6.0, 1.5]) ** 2 @ turn.T
    for k in range(4000 // count):
        offsets_m = rng.multivariate_normal(np.zeros(2), D + 0.09 * np.eye(2), count)
        joined(extents, [candidate(*offset) for offset in offsets_m], [(0.0, 0.0)], 1000.0 * k)
        truth.append(of(extents))
    assert np.mean(truth[len(truth) // 2 :], axis=0) == pytest.approx(D, rel=0.25, abs=1.5)


@given(order=st.permutations(range(5)))
def test_the_order_of_arrival_does_not_matter(order: list[int]) -> None:
    """With a prior of so much weight that all lists are weighted with the same extent."""
    rules = ExtentRules(std_m=5.0, weight=1e12, memory_s=2.0)
    items = [[candidate(float(k), 2.0 * k), candidate(-3.0, 1.0)] for k in range(5)]
    sums = []
    for arrival in (range(5), order):
        extents = Extents(rules)
        for k in arrival:
            joined(extents, items[k], [(0.0, 0.0)], 700.0 * k)
        sums.append(1e12 * (of(extents) - 25.0 * np.eye(2)))
    assert sums[1] == pytest.approx(sums[0], rel=1e-2, abs=0.1)


def test_an_ended_track_leaves_no_extent() -> None:
    extents = Extents(HULL)
    joined(extents, [candidate(6.0, 0.0), candidate(-6.0, 0.0)], [(0.0, 0.0)])
    assert of(extents) != pytest.approx(25.0 * np.eye(2))
    extents.forget(TRACK)
    extents.forget(TRACK)
    assert of(extents) == pytest.approx(25.0 * np.eye(2))


def scene(gap_m: float) -> list[DetectionList]:
    """A hull of 18 m that shows one end, the middle or both ends, and a boat that comes as near to it as `gap_m`."""
    rng, lists = np.random.default_rng(3), []
    for k in range(80):
        ends = ([0.0], [-9.0, 9.0], [9.0], [-9.0])[k % 4]
        points = [(2.0 * k + end, 0.0) for end in ends] + [(2.0 * k, -gap_m - max(0.0, 30.0 - k))]
        objects = [Detection(x_m=x_m + rng.normal(0.0, 0.3), y_m=y_m + rng.normal(0.0, 0.3)) for x_m, y_m in points]
        stamp_ns = START_NS + ms(500.0 * k)
        lists.append(DetectionList("lidar", stamp_ns, stamp_ns, objects, "map"))
    return lists


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_a_hull_and_a_boat_beside_it_are_two_tracks(estimator: str) -> None:
    """Merging before association makes at most one; without either the ends of the hull are tracks of their own."""
    settings = {
        "estimator": estimator,
        "motion": {"kind": "cv", "std_per_s": {"velocity": 1.0}},
        "sensors.lidar.std": {"x_m": 3.0, "y_m": 3.0},
        "clock.node_hz": None,
    }
    counts = {}
    for name, changes in {
        "extent": {"extent.std_m": 5.0},
        "merge": {"merge": {"kind": "connected", "distance_m": 20.0}},
        "neither": {},
    }.items():
        run = fgtrack.replay(iter(scene(8.0)), Config().replace(settings | changes))
        last = run.tracks[run.tracks["tick"] == run.tracks["tick"].max()]
        counts[name] = int((last["status"] != "tentative").sum())
        assert len(run.updates) == sum(len(each.objects) for each in scene(8.0))
    assert counts["merge"] < counts["extent"] == 2 < counts["neither"]
