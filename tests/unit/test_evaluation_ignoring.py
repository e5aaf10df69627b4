"""Tracks of ignored objects and in ignored regions are neither right nor false."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from evaluation_runs import ROUND, START_NS, TICK_NS, WEST, Car, write_run

from fgtrack.core.types import TruthState
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.metrics import evaluate
from fgtrack.runs import Run

TICKS = range(10)
VAN = Car(21, 300.0, 300.0, 0.0, 10.0)


def region(tick: int, x_m: float, y_m: float, half_m: float = 10.0) -> TruthState:
    stamp_ns = START_NS + tick * TICK_NS
    outline_m = tuple(
        value
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
        for value in (x_m + a * half_m, y_m + b * half_m)
    )
    return TruthState(
        stamp_ns, stamp_ns, -2, x_m, y_m, ignored=True, outline_m=outline_m
    )


def false_positives(run: Run) -> int:
    found = evaluate(run).multi_object
    assert found is not None
    return int(found.clear["false_positives"])


def test_a_track_of_an_ignored_object_is_not_false_and_none_is_not_a_miss(
    tmp_path: Path,
) -> None:
    tracks = [[WEST.track(tick, 1), VAN.track(tick, 2)] for tick in TICKS]
    truth = WEST.truth(TICKS)
    van = [replace(state, ignored=True) for state in VAN.truth(TICKS)]
    assert false_positives(write_run(tmp_path / "without", tracks, truth=truth)) == 10
    judged = evaluate(
        write_run(tmp_path / "with", tracks, truth=[*truth, *van])
    ).multi_object
    assert judged is not None
    assert (
        judged.clear["false_positives"],
        judged.clear["misses"],
        judged.clear["mota"],
    ) == (0, 0, 1.0)
    assert judged.gospa["false_m2"] == judged.gospa["missed_m2"] == 0.0
    alone = [[WEST.track(tick, 1)] for tick in TICKS]
    judged = evaluate(
        write_run(tmp_path / "alone", alone, truth=[*truth, *van])
    ).multi_object
    assert judged is not None
    assert (judged.clear["misses"], judged.clear["mota"]) == (0, 1.0)


def test_a_true_object_beside_an_ignored_one_keeps_its_track(tmp_path: Path) -> None:
    """Two metres apart, a track at each: one pair, none false, and the other way round one miss."""
    beside = Car(21, WEST.x_m, WEST.y_m + 2.0, WEST.yaw_rad, WEST.speed_mps)
    truth = [
        *WEST.truth(TICKS),
        *(replace(state, ignored=True) for state in beside.truth(TICKS)),
    ]
    both = [[WEST.track(tick, 1), beside.track(tick, 2)] for tick in TICKS]
    found = match(write_run(tmp_path / "both", both, truth=truth))
    assert found is not None
    assert np.unique(found.tracks["track_id"]).tolist() == [1]
    assert found.paired.all()


def test_a_track_in_a_region_is_not_false_unless_it_leaves_it(tmp_path: Path) -> None:
    """The region is there for the first half of the run only, and never takes the track of a true object away."""
    tracks = [[WEST.track(tick, 1), ROUND.track(tick, 2)] for tick in TICKS]
    regions = [
        region(tick, *car.state(0.0)[:2], 15.0)
        for tick in range(5)
        for car in (ROUND, WEST)
    ]
    run = write_run(tmp_path / "run", tracks, truth=[*WEST.truth(TICKS), *regions])
    assert false_positives(run) == 5
    found = match(run)
    assert found is not None
    assert (found.track_ids == 1).all()
