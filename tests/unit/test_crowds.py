"""Lists with far more detections than objects: the same outcome as by looking at all pairs, in bounded memory."""

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from support.tracking import batch, bearing, candidate, candidates_of, states

from fgtrack.core.types import BoolArray, Detection, FloatArray
from fgtrack.models.measurement import SensorPose
from fgtrack.models.motion import CTRV
from fgtrack.models.road import Road
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.association import (
    Assignment,
    GatedEuclidean,
    GatedMahalanobis,
    Pairs,
    assigned,
    near,
    weighed,
)
from fgtrack.tracking.detections import NoMerge
from fgtrack.tracking.preprocess import Candidate, Preprocess

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


def pairs_of(cost: FloatArray) -> Pairs:
    rows, columns = np.nonzero(np.isfinite(cost))
    return Pairs(rows, columns, cost[rows, columns])


def densely_assigned(cost: FloatArray, inside: BoolArray) -> Assignment:
    rows, columns = linear_sum_assignment(np.where(inside, cost, 1e9))
    pairs = [
        (i, j)
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
        if inside[i, j]
    ]
    new, missed = (
        {*range(size)} - {pair[axis] for pair in pairs}
        for axis, size in enumerate(cost.shape)
    )
    return Assignment(pairs, sorted(new), sorted(missed))


def outcome(cost: FloatArray, pairs: list[tuple[int, int]]) -> tuple[int, float]:
    return len(pairs), sum(cost[pair] for pair in pairs)


@pytest.mark.parametrize("equal", [False, True])
@pytest.mark.parametrize("seed", range(10))
def test_an_assignment_of_pairs_is_that_of_the_matrix(equal: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = rng.integers(1, 12, size=2)
    cost = (
        rng.integers(-2, 3, size=shape).astype(float)
        if equal
        else rng.uniform(-9.0, 9.0, size=shape)
    )
    cost[rng.random(cost.shape) > rng.uniform(0.05, 0.9)] = np.inf
    result, dense = (
        assigned(pairs_of(cost), *cost.shape),
        densely_assigned(cost, np.isfinite(cost)),
    )
    assert outcome(cost, result.pairs) == pytest.approx(
        outcome(cost, dense.pairs), abs=1e-5
    )
    assert equal or result == dense
    assert (
        len({i for i, _ in result.pairs})
        == len({j for _, j in result.pairs})
        == len(result.pairs)
    )


def mixed(rng: np.random.Generator, count: int, side_m: float) -> list[Candidate]:
    """Positions and some bearings."""
    found = [
        candidate(x, y, float(rng.choice([0.04, 0.25])))
        for x, y in rng.uniform(0.0, side_m, size=(count, 2))
    ]
    eye = SensorPose(-5.0, -5.0, 0.3)
    return [
        bearing(float(rng.uniform(-0.5, 1.0)), eye) if rng.random() < 0.1 else each
        for each in found
    ]


@pytest.mark.parametrize(("bearings", "seed"), [(False, 0), (True, 1)])
def test_an_association_is_that_of_all_pairs(bearings: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    candidates = candidates_of(
        [
            each
            for each in mixed(rng, 60, 40.0)
            if bearings or each.position_m is not None
        ]
    )
    tracks = states([(x, y) for x, y in rng.uniform(0.0, 40.0, size=(30, 2))])
    tracks.covariances[:] *= rng.uniform(0.1, 30.0, size=(30, 1, 1))
    pairs, shape = near(candidates, tracks.means, np.inf), (len(candidates), 30)
    limits = np.array(
        [0.0, 10.8275661707, 13.8155105580]
    )  # chi-square quantiles of 0.999
    cost, inside, _ = weighed(
        pairs, candidates, tracks, None, lambda k: limits[: k + 1]
    )
    inside &= pairs.values <= 9.0
    rule = GatedMahalanobis(gate_probability=0.999, max_distance_m=9.0)
    assert rule(candidates, tracks) == densely_assigned(
        cost.reshape(shape), inside.reshape(shape)
    )


@pytest.mark.parametrize(
    "association",
    [
        pytest.param(GatedEuclidean(gate_m=5.0), marks=pytest.mark.slow),
        GatedMahalanobis(),
    ],
)
def test_detections_and_tracks_all_in_one_place_are_not_all_compared(
    association: GatedEuclidean | GatedMahalanobis,
) -> None:
    """3,000 of each: one matrix of distances has 72 MB."""
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 0.3, size=(3_000, 2))
    candidates = Preprocess(Road(), NoMerge(), CTRV(), (0.0, 0.0))(
        batch(*(Detection(x_m=x, y_m=y) for x, y in points.tolist()), frame="map"),
        SensorModel({"x_m": 0.3, "y_m": 0.3}),
        None,
    )[0]
    tracks = states([(x, y) for x, y in rng.normal(0.0, 0.3, size=(3_000, 2)).tolist()])
    found: list[Assignment] = []
    peak = peak_bytes(lambda: found.append(association(candidates, tracks)))
    assert peak < 125 * MB, f"{peak / MB:.0f} MB"
    assert len(found[0].pairs) > 2_500


@pytest.mark.parametrize("reach_m", [3.0, 50.0])
def test_the_near_pairs_are_those_of_all_distances(
    monkeypatch: pytest.MonkeyPatch, reach_m: float
) -> None:
    rng = np.random.default_rng(2)
    points, tracks = (
        rng.uniform(0.0, 40.0, size=(60, 2)),
        rng.uniform(0.0, 40.0, size=(50, 2)),
    )
    limits_m = rng.uniform(0.5, 1.0, size=50) * reach_m
    monkeypatch.setattr("fgtrack.tracking.association.MOST_NEAR", 20)
    pairs = near(
        candidates_of([candidate(*point) for point in points]),
        states(tracks.tolist()).means,
        limits_m,
    )
    distances = np.hypot(points[:, :1] - tracks[:, 0], points[:, 1:] - tracks[:, 1])
    for row, own in enumerate(distances):
        inside = np.flatnonzero(own <= limits_m)
        expected = np.sort(inside[np.argsort(own[inside], kind="stable")[:20]])
        np.testing.assert_array_equal(pairs.columns[pairs.rows == row], expected)
    np.testing.assert_allclose(pairs.values, distances[pairs.rows, pairs.columns])
