import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import ROUND, START_NS, TICK_NS, WEST, write_run
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import linear_sum_assignment

from fgtrack.core.errors import DataError
from fgtrack.core.types import TruthState
from fgtrack.evaluation.matching import (
    NO_OBJECT,
    match,
    nearest_objects,
    track_errors,
)
from fgtrack.evaluation.near_pairs import NearPairs
from fgtrack.evaluation.settings import EvaluationConfig, evaluation_settings
from fgtrack.evaluation.truth import TruePath, true_paths
from fgtrack.runs import NO_TRACK

S_NS = 1_000_000_000


def path_of(
    *states: tuple[float, float, float, float], period_ns: int = S_NS
) -> TruePath:
    return TruePath(1, START_NS + period_ns * np.arange(len(states)), np.array(states))


def test_truth_between_two_stamps_is_a_curve_that_a_turning_car_drives() -> None:
    states = [ROUND.state(t) for t in (0.0, 0.2, 0.4)]
    between = path_of(*states, period_ns=S_NS // 5).at(
        np.array([START_NS + S_NS // 10])
    )[0]
    x_m, y_m, yaw_rad, speed_mps = ROUND.state(0.1)
    straight_m = math.dist((x_m, y_m), np.mean([s[:2] for s in states[:2]], axis=0))
    assert between[:2] == pytest.approx((x_m, y_m), abs=1e-4)
    assert straight_m > 0.05
    assert between[2:] == pytest.approx((yaw_rad, speed_mps))


def test_truth_at_its_own_stamps_is_the_recorded_state_to_the_bit() -> None:
    states = [
        (0.1, 0.7, 0.3, 9.1),
        (1e3 / 3, 2.0, math.nan, 9.3),
        (7.7, 3.1, -3.1, math.nan),
    ]
    path = path_of(*states)
    np.testing.assert_array_equal(path.at(path.stamps_ns), np.array(states))


def test_there_is_no_truth_while_an_object_is_away() -> None:
    stamps_s = np.array([0.0, 0.5, 1.0, 9.0, 9.5])
    states = np.stack([stamps_s, stamps_s, 0 * stamps_s, 1 + 0 * stamps_s], axis=-1)
    path = TruePath(1, START_NS + (stamps_s * S_NS).astype(np.int64), states)
    known = np.isfinite(
        path.at(START_NS + np.array([S_NS, S_NS + 1, 5 * S_NS, 9 * S_NS]))[:, 0]
    )
    assert known.tolist() == [True, False, False, True]


def test_the_ego_and_rows_without_position_are_no_true_objects(tmp_path: Path) -> None:
    ego = dataclasses.replace(WEST, object_id=-1)
    lost = TruthState(START_NS, START_NS, 5, math.nan, 0.0)
    run = write_run(
        tmp_path / "run", truth=[*ego.truth(range(3)), *WEST.truth(range(3)), lost]
    )
    assert [path.object_id for path in true_paths(run.tables["truth"])] == [7]


def test_truth_in_any_order_is_one_path_and_its_last_word_counts(
    tmp_path: Path,
) -> None:
    rows = WEST.truth(range(4))
    wrong = dataclasses.replace(rows[2], x_m=99.0)
    run = write_run(tmp_path / "run", truth=[wrong, rows[0], rows[3], rows[1], rows[2]])
    (path,) = true_paths(run.tables["truth"])
    assert path.stamps_ns.tolist() == [row.stamp_ns for row in rows]
    assert path.states[:, 0].tolist() == [row.x_m for row in rows]


def test_errors_are_along_and_across_the_true_heading(tmp_path: Path) -> None:
    tracks = [
        [
            WEST.track(k, 1, along_m=0.3, across_m=-0.4, yaw_rad=0.1, speed_mps=2.0),
            ROUND.track(k, 2),
        ]
        for k in range(5)
    ]
    run = write_run(
        tmp_path / "run", tracks, truth=[*WEST.truth(range(5)), *ROUND.truth(range(5))]
    )
    matching = match(run)
    assert matching is not None
    errors = track_errors(matching)
    west = errors.object_index == 0
    expected = {
        "position_m": 0.5,
        "along_m": 0.3,
        "across_m": -0.4,
        "yaw_rad": 0.1,
        "speed_mps": 2.0,
    }
    for name, value in expected.items():
        assert errors.values[name][west] == pytest.approx(np.full(5, value))
        assert errors.values[name][~west] == pytest.approx(np.zeros(5), abs=1e-12)
    assert matching.track_ids.tolist() == [[1, 2]] * 5


def test_tentative_tracks_are_judged_only_if_asked(tmp_path: Path) -> None:
    tracks = [[WEST.track(k, 1, num_measured=k + 1)] for k in range(4)]
    run = write_run(tmp_path / "run", tracks, truth=WEST.truth(range(4)))
    confirmed, everything = (
        match(run),
        match(run, EvaluationConfig(confirmed_only=False)),
    )
    assert confirmed is not None
    assert everything is not None
    assert confirmed.track_ids[:, 0].tolist() == [NO_TRACK, NO_TRACK, 1, 1]
    assert everything.track_ids[:, 0].tolist() == [1, 1, 1, 1]


def test_a_track_is_compared_with_the_truth_at_its_own_stamp(tmp_path: Path) -> None:
    late = WEST.track(1, 1)
    tracks = [[], [], [late]]
    matching = match(write_run(tmp_path / "run", tracks, truth=WEST.truth(range(3))))
    assert matching is not None
    assert late.state.stamp_ns == START_NS + TICK_NS
    assert track_errors(matching).values["position_m"] == pytest.approx([0.0], abs=1e-9)


def test_rows_before_and_after_the_recording_of_truth_are_not_judged(
    tmp_path: Path,
) -> None:
    tracks = [[ROUND.track(k, 1)] for k in range(6)]
    matching = match(write_run(tmp_path / "run", tracks, truth=WEST.truth(range(2, 5))))
    assert matching is not None
    assert matching.tracks["tick"].tolist() == [2, 3, 4]


def test_a_track_with_an_infinite_state_is_paired_to_nothing(tmp_path: Path) -> None:
    tracks = [[WEST.track(0, 1, along_m=math.nan), WEST.track(0, 2)]]
    matching = match(write_run(tmp_path / "run", tracks, truth=WEST.truth(range(2))))
    assert matching is not None
    assert matching.object_index.tolist() == [NO_OBJECT, 0]


def nearest(
    distances_m: np.ndarray, ids: np.ndarray, tick_index: np.ndarray, num_ticks: int
) -> np.ndarray:
    """Object of each row, at most 10 m apart."""
    near = NearPairs.of(distances_m)
    return nearest_objects(
        near, ids, tick_index, num_ticks, distances_m.shape[1], gate_m=10.0
    )


def assigned(distances_m: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of the rows of one tick; infinite distances lie outside the gate."""
    rows = np.arange(len(distances_m))
    columns = nearest(distances_m, rows, np.zeros(len(rows), np.int64), 1).tolist()
    return [(row, column) for row, column in enumerate(columns) if column != NO_OBJECT]


distances = hnp.arrays(
    np.float64,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=5),
    elements=st.one_of(st.floats(0.0, 10.0), st.just(np.inf)),
)


@settings(deadline=None)
@given(distances)
def test_the_assignment_is_the_largest_and_then_the_cheapest(
    distances_m: np.ndarray,
) -> None:
    pairs = assigned(distances_m)
    assert len({column for _, column in pairs}) == len(pairs)
    inside = np.isfinite(distances_m)
    assert len(pairs) == inside[linear_sum_assignment(inside, maximize=True)].sum()
    cheapest = linear_sum_assignment(np.where(inside, distances_m, 1e4))
    assert sum(distances_m[pair] for pair in pairs) == pytest.approx(
        distances_m[cheapest][inside[cheapest]].sum(), abs=1e-6
    )


@settings(deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([0.1, 0.3, 0.6]))
def test_pairs_inside_the_gate_stay_and_the_rest_is_assigned(
    seed: int, density: float
) -> None:
    """Rows of the ticks stand in any order; few, some or most of the distances lie inside the gate."""
    rng = np.random.default_rng(seed)
    ticks, columns = 8, int(rng.integers(1, 4))
    tick_index = rng.permutation(np.repeat(np.arange(ticks), rng.integers(0, 4, ticks)))
    ids = np.zeros(len(tick_index), np.int64)
    for tick in range(ticks):
        ids[tick_index == tick] = rng.permutation(4)[: (tick_index == tick).sum()]
    distances_m = rng.uniform(0.0, 5.0, (len(ids), columns))
    distances_m[rng.random(distances_m.shape) > density] = np.inf
    expected, last = np.full(len(ids), NO_OBJECT), {}
    for tick in range(ticks):
        rows = np.flatnonzero(tick_index == tick)
        kept = {
            r: last[ids[r]]
            for r in rows
            if ids[r] in last and np.isfinite(distances_m[r, last[ids[r]]])
        }
        free = [r for r in rows if r not in kept]
        open_columns = [
            column for column in range(columns) if column not in kept.values()
        ]
        for row, column in (
            assigned(distances_m[np.ix_(free, open_columns)])
            if free and open_columns
            else ()
        ):
            kept[free[row]] = open_columns[column]
        for row, column in kept.items():
            expected[row] = column
        last = {ids[row]: column for row, column in kept.items()}
    assert nearest(distances_m, ids, tick_index, ticks).tolist() == expected.tolist()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "evaluation: {gate_m: -1}",
            "evaluation: Value error, gate_m: must be positive and at most 1e.09, is -1",
        ),
        ("evaluation: {", "is not YAML"),
    ],
)
def test_a_configuration_that_cannot_be_used_is_one_clear_error(
    tmp_path: Path, text: str, message: str
) -> None:
    run = write_run(tmp_path / "run", config_text=text)
    with pytest.raises(DataError, match=rf"run.config\.yaml: {message}"):
        evaluation_settings(run)
