"""The benchmark of late scans: scenes, the reference tracker with its hypotheses, and the score."""

import gzip
import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from support.scripts import EXPERIMENTS, load

sys.path.insert(0, str(EXPERIMENTS / "oos_mtt"))
oos_mtt = load("oos_mtt")
scenes = sys.modules["scenes"]
hypotheses = sys.modules["hypotheses"]

TEXT = """SCAN 1 0.5 1
Z 10 20
Z 30 40
SCAN 2 2.5 2
SCAN 3 1.5 2
Z 11 21
T 7 1 0.5 10.5 1 20.5 0
T 7 2 2.5 12.5 1 20.5 0
"""


def test_a_scene_is_read_with_its_late_scan(tmp_path: Path) -> None:
    path = tmp_path / "scene.txt.gz"
    path.write_bytes(gzip.compress(TEXT.encode()))
    scene = scenes.read_scene(path)
    assert [scan.is_late for scan in scene.scans] == [False, False, True]
    assert [len(scan.points_m) for scan in scene.scans] == [2, 0, 1]
    assert scene.times_s.tolist() == [0.5, 2.5]
    assert {k: xy.tolist() for k, xy in scene.truth[0].items()} == {
        0: [10.5, 20.5],
        1: [12.5, 20.5],
    }
    assert [message.receipt_ns for message in scene.messages()] == [
        500_000_000,
        2_500_000_000,
        2_500_000_000,
    ]


def test_the_truth_itself_scores_nothing_and_its_absence_half_the_cut_off() -> None:
    scene = scenes.draw_scene(np.random.default_rng(3), 40)
    assert scenes.squared_per_scan(scene, scene.truth)["total_m2"] == 0.0
    num_states = sum(map(len, scene.truth))
    missed = scenes.squared_per_scan(scene, [])
    assert missed["missed_m2"] == pytest.approx(50.0 * num_states / len(scene.times_s))


def test_murty_ranks_all_assignments() -> None:
    cost = np.random.default_rng(1).uniform(0.0, 9.0, (3, 5))
    expected = sorted(
        sum(cost[row, column] for row, column in enumerate(columns))
        for columns in itertools.permutations(range(5), 3)
    )
    found = hypotheses.murty(cost, len(expected) + 1)
    assert [value for value, _ in found] == pytest.approx(expected)
    assert len({tuple(columns) for _, columns in found}) == len(expected)


def test_hypotheses_lower_the_error_of_a_tracker_that_decides_at_once() -> None:
    totals = np.zeros(2)
    for seed in range(3):
        scene = scenes.draw_scene(np.random.default_rng(seed), 60)
        for column, number in enumerate((1, 10)):
            found = hypotheses.trajectories(scene, number)
            totals[column] += scenes.squared_per_scan(scene, found)["total_m2"]
    assert totals[1] < totals[0]


@pytest.mark.slow
def test_late_scans_help_a_smoother(tmp_path: Path) -> None:
    scene = scenes.draw_scene(np.random.default_rng(1), 60)
    scores = dict(oos_mtt.judged("drawn", scene, tmp_path))
    assert scores["smoother-banded"]["total_m2"] < scores["drop"]["total_m2"]
    assert scores["smoother"]["total_m2"] == pytest.approx(
        scores["smoother-banded"]["total_m2"], rel=1e-6
    )
    written = tmp_path / "drawn/smoother/trajectories.csv"
    assert written.read_text().startswith("track_id,scan,x_m,y_m\n")
