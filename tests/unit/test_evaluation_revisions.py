"""What was taken back, and what is lost by wrong decisions: metrics of fabricated runs."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from evaluation_runs import START_NS, TICK_NS, WEST, update, write_run

from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    FinalTrack,
    Revision,
    TrackReport,
    UpdateRecord,
)
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.scores.revisions import RevisionMetrics
from fgtrack.evaluation.tables.compare import compare

NUM_TICKS = 100
OTHER = 2


def revision(
    tick: int, stamp_tick: int, old: int | None, new: int | None, delay_ns: int = 0
) -> Revision:
    """Return a change of the track of the detection of the LiDAR at `stamp_tick`."""
    stamp_ns = START_NS + stamp_tick * TICK_NS
    return Revision(tick, "lidar", stamp_ns, stamp_ns + delay_ns, 0, old, new)


def seen(tick: int, across_m: float = 0.0) -> DetectionList:
    """Return a LiDAR list with a detection of WEST, `across_m` left of its path."""
    x_m, y_m, _, _ = WEST.state(tick * TICK_NS / 1e9)
    stamp_ns = START_NS + tick * TICK_NS
    own = Detection(x_m=x_m, y_m=y_m - across_m)
    return DetectionList("lidar", stamp_ns, stamp_ns, (own,), frame="map")


def tracked() -> list[list[TrackReport]]:
    return [[WEST.track(k, 1)] for k in range(NUM_TICKS)]


def revised(path: Path, changes: Sequence[Revision]) -> RevisionMetrics:
    """Return the metrics of a run of five detections whose tracks change."""
    tracks: dict[int, int | None] = {0: 1, 10: 1, 20: None, 30: 1, 40: 1}
    updates: dict[int, list[UpdateRecord]] = {
        k: [update(tick=k, track_id=track)] for k, track in tracks.items()
    }
    run = write_run(path, tracked(), updates=updates, revisions=changes)
    return evaluate(run).revisions


def test_each_detection_counts_once_however_often_its_track_changes(
    tmp_path: Path,
) -> None:
    found = revised(
        tmp_path,
        [
            revision(15, 10, 1, OTHER),
            revision(25, 20, None, 1),
            revision(35, 10, OTHER, 3),
            revision(45, 30, 1, OTHER),
            revision(50, 30, OTHER, 1),
            revision(60, 40, 1, None),
        ],
    )
    assert (found.changes, found.revised_detections, found.detections) == (6, 4, 5)
    assert (found.other_track, found.new_track, found.no_track) == (1, 1, 1)
    assert found.revised_share == pytest.approx(0.8)


def test_a_decision_is_final_at_its_last_change(tmp_path: Path) -> None:
    found = revised(
        tmp_path,
        [
            revision(15, 10, 1, OTHER),
            revision(35, 10, OTHER, 3),
            revision(21, 20, 1, 2),
        ],
    )
    assert found.time_to_final_s.count == 2
    assert found.time_to_final_s.max == pytest.approx(25 * TICK_NS / 1e9)
    assert found.time_to_final_s.p50 == pytest.approx(13 * TICK_NS / 1e9)


def test_a_change_of_an_unknown_detection_counts_for_no_detection(
    tmp_path: Path,
) -> None:
    found = revised(tmp_path, [revision(15, 11, 1, OTHER)])
    assert found.changes == 0


def test_a_repeated_list_has_no_revisions(tmp_path: Path) -> None:
    copy = update(disposition=Disposition.DUPLICATE, track_id=None)
    run = write_run(
        tmp_path,
        tracked(),
        updates={0: [update(track_id=1), copy]},
        revisions=[revision(3, 0, 1, OTHER)],
    )
    found = evaluate(run).revisions
    assert (found.other_track, found.new_track) == (1, 0)


def test_a_run_without_revisions_has_none(tmp_path: Path) -> None:
    found = revised(tmp_path, [])
    assert (found.changes, found.revised_share, found.withdrawn_states) == (0, 0.0, 0)


@pytest.mark.parametrize(("across_m", "moved"), [(2.4, 0), (2.5, 1)])
def test_a_state_has_moved_if_its_later_position_is_outside_of_its_ellipse(
    tmp_path: Path, across_m: float, moved: int
) -> None:
    # The square of the 95 % ellipse of a unit covariance is 5.99, so its radius is 2.45 m.
    later = [
        WEST.later(20, 1),
        WEST.later(50, 1, across_m=across_m),
        WEST.later(51, 1, across_m=-across_m / 2),
        WEST.later(60, 1),
    ]
    run = write_run(tmp_path, tracked(), smoothed={99: later})
    found = evaluate(run).revisions
    assert found.compared_states == 41, "the states between the first and the last one"
    assert found.moved_states == moved


def test_lagged_states_stand_for_final_ones_that_a_filter_lacks(tmp_path: Path) -> None:
    lags_s = (0.1, 0.4)
    smoothed = {
        k: [
            WEST.later(k - lag_s * 50, 1, lag_s, across_m=3.0 if lag_s > 0.3 else 0.0)
            for lag_s in lags_s
        ]
        for k in range(50, 60)
    }
    run = write_run(tmp_path, tracked(), smoothed=smoothed)
    found = evaluate(run).revisions
    assert (found.compared_states, found.moved_states) == (10, 10)


@pytest.mark.parametrize(
    ("final", "withdrawn"),
    [
        (FinalTrack(1, START_NS, START_NS, True, 1.0), 0),
        (FinalTrack(1, START_NS + 7 * TICK_NS, START_NS, True, 1.0), 7),
        (FinalTrack(1, START_NS, START_NS, False, 0.1), NUM_TICKS),
        (FinalTrack(OTHER, START_NS, START_NS, True, 1.0), NUM_TICKS),
    ],
)
def test_states_of_a_track_that_does_not_exist_in_the_end_are_withdrawn(
    tmp_path: Path, final: FinalTrack, withdrawn: int
) -> None:
    run = write_run(tmp_path, tracked(), final_tracks=[final])
    assert evaluate(run).revisions.withdrawn_states == withdrawn


def judged_run(path: Path, across_m: float) -> tuple[int, ...]:
    """Return the counts at arrival and in the end of a run with one wrong detection, which is taken back."""
    lists = [seen(k, 9.0 if k == 50 else 0.0) for k in range(0, NUM_TICKS, 10)]
    updates = {k: [update(tick=k, track_id=1)] for k in range(0, NUM_TICKS, 10)}
    tracks = [
        [WEST.track(k, 1, across_m=across_m if 50 <= k < 60 else 0.5)]
        for k in range(NUM_TICKS)
    ]
    run = write_run(
        path,
        tracks,
        truth=WEST.truth(range(NUM_TICKS)),
        updates=updates,
        detections=lists,
        revisions=[revision(60, 50, 1, None)],
    )
    found = evaluate(run).decisions
    assert found is not None
    assert found.present.estimation_m2 == pytest.approx(0.25)
    assert found.present.association_m2 == pytest.approx(0.1 * (across_m**2 - 0.25))
    assert found.present.hit_share == pytest.approx(0.1)
    first, last = found.at_arrival, found.in_the_end
    return first.right, first.clutter, last.right, last.clutter


def test_a_wrong_detection_is_clutter_until_it_is_taken_back(tmp_path: Path) -> None:
    assert judged_run(tmp_path, 2.0) == (9, 1, 9, 0)


def test_a_track_belongs_to_the_object_of_most_of_its_detections(
    tmp_path: Path,
) -> None:
    lists = [seen(k) for k in range(0, NUM_TICKS, 10)]
    updates = {
        k: [update(tick=k, track_id=1 if k < 70 else OTHER if k < 90 else None)]
        for k in range(0, NUM_TICKS, 10)
    }
    updates[0] = [update(track_id=OTHER)]
    truth = [*WEST.truth(range(NUM_TICKS))]
    run = write_run(tmp_path, tracked(), truth=truth, updates=updates, detections=lists)
    found = evaluate(run).decisions
    assert found is not None
    assert found.at_arrival.right == 9, "both tracks belong to the same object"
    assert found.at_arrival.without_track == 1
    assert found.at_arrival.wrong_share == pytest.approx(0.1)
    assert np.isnan(found.final.estimation_m2), "there are no final states"


def test_decisions_need_truth_and_the_values_of_detections(tmp_path: Path) -> None:
    run = write_run(tmp_path, tracked(), updates={0: [update()]})
    assert evaluate(run).decisions is None


def test_tables_show_what_was_taken_back(tmp_path: Path) -> None:
    run = write_run(
        tmp_path,
        tracked(),
        truth=WEST.truth(range(NUM_TICKS)),
        updates={k: [update(tick=k, track_id=1)] for k in (0, 10)},
        detections=[seen(0), seen(10)],
        revisions=[revision(15, 10, 1, OTHER)],
    )
    tables = compare(run)
    [row] = tables.tables["revisions"].records
    assert (row["changes"], row["other_track"], row["revised_share"]) == (1, 1, 0.5)
    assert "Revisions" in str(tables)
    [row] = tables.tables["decisions"].records
    assert row["right_at_arrival"] == 2
    assert "Decisions and estimates" in str(tables.in_full())
