"""GOSPA against Stone Soup, CLEAR, IDF1 and HOTA against TrackEval, and both on scenes that can be counted by hand."""

import math
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from evaluation_runs import ROUND, WEST, write_run
from evaluation_scenes import Positions, random_scenes

from fgtrack.core.errors import CallError
from fgtrack.core.types import TrackReport
from fgtrack.evaluation.matching import match, scenes
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.near_pairs import Scenes
from fgtrack.evaluation.scores.multi_object import (
    MultiObjectMetrics,
    gospa,
    multi_object_metrics,
)
from fgtrack.evaluation.scores.ospa import ospa
from fgtrack.evaluation.scores.registry import METRICS
from fgtrack.evaluation.settings import EvaluationConfig
from fgtrack.evaluation.tables.compare import compare
from fgtrack.runs import Run

C_M, GATE_M = 5.0, 4.0

#: Many, some and hardly any pairs to choose from.
SCENES = [(seed, side_m) for seed in range(3) for side_m in (3.0, 15.0, 200.0)]


def multi_object(
    run: Run, options: EvaluationConfig | None = None
) -> MultiObjectMetrics:
    found = evaluate(run, options=options).multi_object
    assert found is not None
    return found


# --- GOSPA


@pytest.mark.parametrize(("seed", "side_m"), SCENES)
def test_gospa_and_its_parts_are_those_of_stone_soup(seed: int, side_m: float) -> None:
    ospametric = pytest.importorskip(
        "stonesoup.metricgenerator.ospametric",
        reason="stonesoup is not installed (extra `rivals`)",
    )
    from stonesoup.measures import Euclidean
    from stonesoup.types.state import State

    objects, tracks, there = random_scenes(seed, side_m)
    generator = ospametric.GOSPAMetric(c=C_M, p=2, measure=Euclidean())
    start = datetime(2024, 1, 1)
    found = gospa(there, C_M)
    for tick in range(len(there.present)):
        if not len(objects.ids[tick]) + len(tracks.ids[tick]):
            assert found["total_m2"][tick] == 0.0
            continue
        stamp = start + timedelta(seconds=tick)
        states = [
            [State(xy[:, None], timestamp=stamp) for xy in one.xy[tick]]
            for one in (tracks, objects)
        ]
        expected = generator.compute_gospa_metric(*states)[0].value
        assert math.sqrt(found["total_m2"][tick]) == pytest.approx(
            expected["distance"], abs=1e-9
        )
        for name in ("localisation", "missed", "false"):
            assert found[f"{name}_m2"][tick] == pytest.approx(expected[name], abs=1e-9)


@pytest.fixture
def story(tmp_path: Path) -> Run:
    """Ten ticks. WEST: track 1, wrong by 0.8 m, then track 2 from tick 6; nothing at tick 5. ROUND: never. Track 3 is
    false at ticks 0 and 1. Truth of ROUND ends at tick 7, that of WEST at tick 9.
    """
    tracks: list[list[TrackReport]] = []
    for k in range(12):
        rows = [] if k == 5 else [WEST.track(k, 1 if k < 5 else 2, along_m=0.8)]
        tracks.append([*rows, WEST.track(k, 3, across_m=60.0)] if k < 2 else rows)
    return write_run(
        tmp_path / "story",
        tracks,
        truth=[*WEST.truth(range(10)), *ROUND.truth(range(8))],
    )


def test_gospa_of_a_run_is_what_can_be_counted(story: Run) -> None:
    found = multi_object(story).gospa
    # 9 pairs 0.8 m apart, 8 times ROUND and once WEST missed, 2 rows false; each of these costs 5^2 / 2
    assert (found["c_m"], found["ticks"]) == (5.0, 10)
    assert found["localisation_m2"] == pytest.approx(0.9 * 0.64)
    assert found["missed_m2"] == pytest.approx(9 * 12.5 / 10)
    assert found["false_m2"] == pytest.approx(2 * 12.5 / 10)
    missed_one, with_false, missed_two = (
        math.sqrt(13.14),
        math.sqrt(25.64),
        math.sqrt(25.0),
    )
    # ticks 0, 1; then 2, 3, 4, 6, 7; then 5; and 8, 9 with WEST alone
    assert found["mean_m"] == pytest.approx(
        (2 * with_false + 5 * missed_one + missed_two + 2 * 0.8) / 10
    )


def test_a_pair_at_the_cut_off_is_a_miss_and_a_false_track() -> None:
    there = Scenes.of(
        np.array([0]),
        np.array([1]),
        np.array([[2.0]]),
        np.array([[True]]),
        np.array([[True]]),
    )
    at, inside = gospa(there, 2.0), gospa(there, 2.0 + 1e-9)
    names = ("localisation_m2", "missed_m2", "false_m2", "total_m2", "in_view_m2")
    assert [at[name][0] for name in names] == [0.0, 2.0, 2.0, 4.0, 4.0]
    assert [inside[name][0] for name in names] == [4.0, 0.0, 0.0, 4.0, 4.0]


# --- CLEAR, IDF1, HOTA


def trackeval_data(
    trackeval: Any, objects: Positions, tracks: Positions
) -> dict[str, Any]:  # Any: has no types
    """What TrackEval takes, with its own similarity of positions."""
    similarity = (
        trackeval.datasets._base_dataset._BaseDataset._calculate_euclidean_similarity
    )
    data: dict[str, Any] = {"num_timesteps": len(objects.ids)}
    for name, det, one in (
        ("gt_ids", "gt_dets", objects),
        ("tracker_ids", "tracker_dets", tracks),
    ):
        every, dense = np.unique(np.concatenate(one.ids), return_inverse=True)
        data[name] = np.split(dense, np.cumsum([len(ids) for ids in one.ids])[:-1])
        data[f"num_{name}"], data[f"num_{det}"] = len(every), len(dense)
    data["similarity_scores"] = [
        similarity(a, b, zero_distance=2.0 * GATE_M)
        for a, b in zip(objects.xy, tracks.xy, strict=True)
    ]
    return data


@pytest.mark.parametrize(("seed", "side_m"), SCENES)
def test_clear_identity_and_hota_are_those_of_trackeval(
    seed: int, side_m: float
) -> None:
    trackeval = pytest.importorskip(
        "trackeval", reason="trackeval is not installed (extra `rivals`)"
    )
    objects, tracks, there = random_scenes(seed, side_m)
    data = trackeval_data(trackeval, objects, tracks)
    quiet = {"PRINT_CONFIG": False}
    found = multi_object_metrics(there, GATE_M)

    expected = trackeval.metrics.CLEAR(quiet).eval_sequence(data)
    clear = found.clear
    counts = (
        clear["pairs"],
        clear["misses"],
        clear["false_positives"],
        clear["id_switches"],
    )
    assert counts == tuple(
        expected[name] for name in ("CLR_TP", "CLR_FN", "CLR_FP", "IDSW")
    )
    assert clear["mota"] == pytest.approx(expected["MOTA"], abs=1e-6)
    if clear["pairs"]:
        assert clear["motp_m"] == pytest.approx(
            (1.0 - expected["MOTP"]) * 2.0 * GATE_M, abs=1e-6
        )

    expected = trackeval.metrics.Identity(quiet).eval_sequence(data)
    for name in ("IDF1", "IDP", "IDR"):
        assert found.identity[name.lower()] == pytest.approx(expected[name], abs=1e-6)

    expected = trackeval.metrics.HOTA().eval_sequence(data)
    for name in ("HOTA", "DetA", "AssA"):
        assert found.hota[name.lower()] == pytest.approx(
            np.mean(expected[name]), abs=1e-6
        )


def test_a_pair_at_the_gate_counts_and_one_beyond_it_does_not() -> None:
    for distance_m, pairs in ((GATE_M, 1), (GATE_M + 1e-6, 0)):
        there = Scenes.of(
            np.array([0]),
            np.array([1]),
            np.array([[distance_m]]),
            np.array([[True]]),
            np.array([[True]]),
        )
        found = multi_object_metrics(there, GATE_M)
        assert (found.clear["pairs"], found.identity["idf1"]) == (pairs, pairs)


# --- OSPA


@pytest.mark.parametrize(("seed", "side_m"), SCENES)
def test_ospa_is_the_best_of_all_assignments(seed: int, side_m: float) -> None:
    objects, tracks, there = random_scenes(seed, side_m)
    squares_m2 = []
    for object_m, track_m in zip(objects.xy, tracks.xy, strict=True):
        few, many = sorted((object_m, track_m), key=len)
        squares = [
            sum(
                min(np.sum((few[k] - many[j]) ** 2), C_M**2)
                for k, j in enumerate(order)
            )
            for order in permutations(range(len(many)), len(few))
        ]
        left_over_m2 = C_M**2 * (len(many) - len(few))
        squares_m2.append((min(squares) + left_over_m2) / max(len(many), 1))
    found = ospa(there, C_M)
    assert found["mean_m"] == pytest.approx(np.sqrt(squares_m2).mean(), rel=1e-12)
    assert found["rms_m"] == pytest.approx(np.sqrt(np.mean(squares_m2)), rel=1e-12)


def test_ospa_stands_beside_the_other_metrics(story: Run) -> None:
    found = multi_object(story).others["ospa"]
    assert 0.0 < found["mean_m"] <= found["rms_m"] < 5.0
    table = compare(story)["multi_object"]
    assert table["ospa_rms_m"].tolist() == [found["rms_m"]]


# --- metrics of plug-ins


def plug_in(monkeypatch: pytest.MonkeyPatch, metric: object) -> None:
    package = SimpleNamespace(name="odd", version="1.0")
    entry = SimpleNamespace(
        dist=package, load=lambda: metric, group="fgtrack.metrics", value="x:y"
    )
    monkeypatch.setitem(METRICS._entries, "own", entry)


def test_a_plug_in_adds_a_metric(monkeypatch: pytest.MonkeyPatch, story: Run) -> None:
    plug_in(monkeypatch, lambda scenes, gate_m: {"ticks": len(scenes.present)})
    assert multi_object(story).others["own"] == {"ticks": 10.0}


@pytest.mark.parametrize(
    ("result", "message"),
    [
        (5.0, "'own': must return numbers by name, returned a float"),
        ({"x": "far"}, "'own': must return numbers by name, returned 'far' for 'x'"),
        (None, "'own': must return numbers by name, returned a NoneType"),
    ],
    ids=["number", "text", "nothing"],
)
def test_a_metric_that_returns_anything_else_is_named(
    monkeypatch: pytest.MonkeyPatch, story: Run, result: object, message: str
) -> None:
    plug_in(monkeypatch, lambda scenes, gate_m: result)
    with pytest.raises(CallError, match=message):
        evaluate(story)


def test_a_metric_that_raises_is_named(
    monkeypatch: pytest.MonkeyPatch, story: Run
) -> None:
    plug_in(monkeypatch, lambda scenes, gate_m: 1 / 0)
    with pytest.raises(CallError, match=r"'own': plug-in x:y of odd 1\.0 cannot be co"):
        evaluate(story)


# --- what is judged


def test_ticks_without_recorded_truth_are_not_judged(story: Run) -> None:
    matching = match(story)
    assert matching is not None
    there = scenes(story, matching)
    assert (story.tables["timing"].num_rows, len(there.present)) == (12, 10)
    assert there.present.sum(axis=0).tolist() == [10, 8]
    assert np.isinf(there.distances_m[there.tick_index >= 8, 1]).all()


def test_an_object_that_has_left_has_no_pair_though_a_row_has_an_earlier_stamp(
    tmp_path: Path,
) -> None:
    truth = [*WEST.truth(range(3)), *ROUND.truth(range(5))]
    run = write_run(tmp_path / "run", [[], [], [], [WEST.track(2, 1)], []], truth=truth)
    matching = match(run)
    assert matching is not None
    assert (matching.near.rows.tolist(), matching.near.objects.tolist()) == ([0], [0])
    assert matching.near.distances_m[0] == pytest.approx(0.0, abs=1e-9)
    clear = multi_object(run).clear
    assert (clear["pairs"], clear["misses"], clear["false_positives"]) == (0, 8, 1)


def test_the_configuration_of_the_run_says_how_it_is_judged(story: Run) -> None:
    without = replace(story, config_text="evaluation: {multi_object: false}")
    assert evaluate(without).multi_object is None
    assert str(evaluate(without).truth) == str(
        evaluate(story).truth
    )  # NaN equals no NaN
    options = "evaluation: {gate_m: 3, multi_object: true}"
    one = evaluate(replace(story, config_text=options))
    assert one.options == EvaluationConfig(3.0)
    assert one.multi_object is not None
    assert one.multi_object.gospa["c_m"] == 3.0
    assert evaluate(story).options == EvaluationConfig()
