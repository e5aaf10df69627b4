"""T-GOSPA against the authors' value, the complete linear program, and scenes that can be counted by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from evaluation_scenes import random_scenes
from scipy.optimize import linprog
from support.messages import shared

from fgtrack.evaluation.near_pairs import NearPairs, Scenes
from fgtrack.evaluation.scores.t_gospa import t_gospa

C_M = 5.0
SWITCH_M = 1.5


def on_a_line(objects_m: list[list[float]], tracks_m: list[list[float]]) -> Scenes:
    """Scenes of objects and tracks on a line, a list of positions by tick each; NaN for absent."""
    objects = np.array(objects_m, dtype=float).T
    tracks = np.array(tracks_m, dtype=float).T
    ticks, columns = np.nonzero(np.isfinite(tracks))
    distances_m = np.abs(objects[ticks] - tracks[ticks, columns][:, None])
    present = np.isfinite(objects)
    return Scenes.of(
        ticks,
        columns,
        np.where(present[ticks], distances_m, np.inf),
        present,
        present,
    )


def complete_program(scenes: Scenes, c_m: float, switch_m: float) -> float:
    """T-GOSPA squared by the linear program with all pairs at all ticks, and the unassigned as a pair with nothing."""
    num_ticks, num_objects = scenes.present.shape
    ids = np.unique(scenes.track_ids)
    shape = (num_ticks, num_objects + 1, len(ids) + 1)
    cost = np.zeros(shape)
    squares = np.full((num_ticks, num_objects, len(ids)), np.nan)
    tracked = np.zeros((num_ticks, len(ids)), dtype=bool)
    for row, tick in enumerate(scenes.tick_index):
        column = np.searchsorted(ids, scenes.track_ids[row])
        tracked[tick, column] = True
        squares[tick, :, column] = np.minimum(scenes.distances_m[row], c_m) ** 2
    half = c_m**2 / 2.0
    cost[:, :-1, -1] = half * scenes.present
    cost[:, -1, :-1] = half * tracked
    one_absent = scenes.present[:, :, None] ^ tracked[:, None, :]
    both = scenes.present[:, :, None] & tracked[:, None, :]
    cost[:, :-1, :-1] = np.where(both, np.nan_to_num(squares), half * one_absent)
    share = np.arange(cost.size).reshape(shape)
    real = share[:, :-1, :-1]
    num_changes = real[1:].size
    num_variables = cost.size + num_changes
    equal = []
    for tick in range(num_ticks):
        for i in range(num_objects):
            equal.append(np.isin(np.arange(num_variables), share[tick, i]))
        for j in range(len(ids)):
            equal.append(np.isin(np.arange(num_variables), share[tick, :, j]))
    below = []
    for k, (before, after) in enumerate(
        zip(real[:-1].ravel(), real[1:].ravel(), strict=True)
    ):
        for sign in (1.0, -1.0):
            row = np.zeros(num_variables)
            row[before], row[after], row[cost.size + k] = sign, -sign, -1.0
            below.append(row)
    found = linprog(
        np.concatenate([cost.ravel(), np.full(num_changes, switch_m**2 / 2.0)]),
        A_ub=np.array(below) if below else None,
        b_ub=np.zeros(len(below)) if below else None,
        A_eq=np.array(equal, dtype=float),
        b_eq=np.ones(len(equal)),
    )
    return float(found.fun)


def test_the_value_of_the_authors_is_met() -> None:
    lines = shared("data/oos_mtt/metric_case.txt").read_text().splitlines()
    sets: list[list[np.ndarray]] = [[], []]
    for line in lines:
        words = line.split()
        which, _, first, length = map(int, words[:4])
        xy = np.array(words[4:], dtype=float).reshape(20, 2)
        scan = np.arange(1, 21)
        alive = (scan >= first) & (scan < first + length)
        sets[which].append(np.where(alive[:, None], xy, np.nan))
    truth, estimate = (np.stack(one, axis=1) for one in sets)
    ticks, columns = np.nonzero(np.isfinite(estimate[:, :, 0]))
    apart = np.linalg.norm(truth[ticks] - estimate[ticks, columns][:, None], axis=-1)
    present = np.isfinite(truth[:, :, 0])
    scenes = Scenes.of(
        ticks, columns, np.nan_to_num(apart, nan=np.inf), present, present
    )
    found = t_gospa(scenes, 10.0, 1.0)
    assert found["rms_m"] * math.sqrt(20) == pytest.approx(42.425860387417, abs=1e-9)


@pytest.mark.parametrize("side_m", [3.0, 8.0, 15.0, 200.0])
@pytest.mark.parametrize("seed", range(6))
def test_the_reduced_program_has_the_optimum_of_the_complete_program(
    seed: int, side_m: float
) -> None:
    _, _, scenes = random_scenes(seed, side_m)
    num_ticks = min(len(scenes.present), 12)
    kept = scenes.tick_index < num_ticks
    scenes = Scenes.of(
        scenes.tick_index[kept],
        scenes.track_ids[kept],
        scenes.distances_m[kept],
        scenes.present[:num_ticks],
        scenes.in_view[:num_ticks],
    )
    found = t_gospa(scenes, C_M, SWITCH_M)
    expected_m2 = complete_program(scenes, C_M, SWITCH_M) / num_ticks
    assert found["rms_m"] ** 2 == pytest.approx(expected_m2, abs=1e-9)


def test_a_change_of_track_costs_the_square_of_the_switch() -> None:
    nan = math.nan
    scenes = on_a_line([[0.0] * 4], [[1.0, 1.0, nan, nan], [nan, nan, 1.0, 1.0]])
    found = t_gospa(scenes, C_M, SWITCH_M)
    assert found["localisation_m2"] == pytest.approx(1.0)
    assert found["missed_m2"] == found["false_m2"] == pytest.approx(0.0)
    assert found["switches_m2"] == pytest.approx(SWITCH_M**2 / 4)


def test_two_tracks_that_exchange_their_objects_cost_two_switches() -> None:
    scenes = on_a_line(
        [[0.0] * 6, [20.0] * 6],
        [[0.0, 0.0, 0.0, 20.0, 20.0, 20.0], [20.0, 20.0, 20.0, 0.0, 0.0, 0.0]],
    )
    found = t_gospa(scenes, C_M, SWITCH_M)
    assert found["switches_m2"] == pytest.approx(2 * SWITCH_M**2 / 6)
    assert found["missed_m2"] == pytest.approx(0.0)


def test_a_dear_switch_is_avoided_by_a_missed_object() -> None:
    nan = math.nan
    scenes = on_a_line([[0.0] * 3], [[0.0, nan, nan], [nan, 0.0, 0.0]])
    found = t_gospa(scenes, C_M, 10.0)
    assert found["switches_m2"] == pytest.approx(0.0)
    assert found["missed_m2"] == pytest.approx(C_M**2 / 2 / 3)
    assert found["false_m2"] == pytest.approx(C_M**2 / 2 / 3)


def test_an_interruption_costs_the_missed_object_alone() -> None:
    scenes = on_a_line([[0.0] * 3], [[0.0, math.nan, 0.0]])
    found = t_gospa(scenes, C_M, SWITCH_M)
    assert found["switches_m2"] == 0.0
    assert found["missed_m2"] == pytest.approx(C_M**2 / 2 / 3)


def test_without_tracks_every_object_is_missed() -> None:
    scenes = on_a_line([[0.0] * 3], [[math.nan] * 3])
    found = t_gospa(scenes, C_M)
    assert found["missed_m2"] == pytest.approx(C_M**2 / 2)
    assert found["rms_m"] == pytest.approx(C_M / math.sqrt(2.0))


def test_without_ticks_the_values_are_unknown() -> None:
    empty = np.zeros((0, 2))
    none = np.zeros(0, dtype=np.int64)
    scenes = Scenes.of(none, none, empty, empty.astype(bool), empty.astype(bool))
    assert all(map(math.isnan, t_gospa(scenes, C_M).values()))


def cut_into(num_ticks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut every longer run into windows of `num_ticks`."""
    for name in ("MOST_TICKS", "WINDOW_TICKS"):
        monkeypatch.setattr(f"fgtrack.evaluation.scores.t_gospa.{name}", num_ticks)


@pytest.mark.parametrize("seed", range(8))
def test_a_cut_into_windows_lowers_the_sum_by_at_most_a_switch_for_each_object(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = random_scenes(seed, side_m=8.0)[2]
    num_ticks, num_objects = scenes.present.shape
    complete = t_gospa(scenes, C_M, SWITCH_M)
    cut_into(4, monkeypatch)
    cut = t_gospa(scenes, C_M, SWITCH_M)
    num_cuts = math.ceil(num_ticks / 4) - 1
    assert (complete["windows"], cut["windows"]) == (1, num_cuts + 1)
    lower_m2 = num_ticks * (complete["rms_m"] ** 2 - cut["rms_m"] ** 2)
    assert -1e-9 <= lower_m2 <= num_cuts * num_objects * SWITCH_M**2 + 1e-9


def test_windows_cut_the_cost_of_a_switch_between_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Another track takes the object over exactly where the first window ends."""
    off = math.nan
    objects_m = [[0.0] * 6]
    tracks_m = [[0.0] * 3 + [off] * 3, [off] * 3 + [0.0] * 3]
    scenes = on_a_line(objects_m, tracks_m)
    assert t_gospa(scenes, C_M, SWITCH_M)["switches_m2"] == pytest.approx(
        SWITCH_M**2 / 6
    )
    cut_into(3, monkeypatch)
    assert t_gospa(scenes, C_M, SWITCH_M)["rms_m"] == 0.0


def test_a_cut_off_beyond_the_known_pairs_is_refused() -> None:
    scenes = on_a_line([[0.0]], [[3.0]])
    near = NearPairs.of(scenes.distances_m, limit_m=4.0)
    with pytest.raises(ValueError, match="match the run with a larger gate_m"):
        t_gospa(replace(scenes, near=near), C_M)
