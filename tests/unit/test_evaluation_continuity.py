"""Time to confirm an object, tick by tick (20 ms each)."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
from evaluation_runs import ROUND, WEST, update, write_run

from fgtrack.core.types import Disposition, UpdateRecord
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.scores.continuity import times_to_confirm
from fgtrack.runs import Run

GATE_M = 5.0


def confirm_of(run: Run) -> list[float]:
    matching = match(run)
    assert matching is not None
    return times_to_confirm(run, matching, GATE_M).tolist()


def test_the_time_to_confirm_is_from_the_first_stamp_to_the_tick_of_the_first_confirmed_row(
    tmp_path: Path,
) -> None:
    """WEST is sensed at tick 2 and 4, received and fused at 5, 6, 8; the third measurement confirms it at tick 8."""
    measured = {5: 1, 6: 2, 7: 2, 8: 3, 9: 4}
    tracks = [
        [WEST.track(k, 1, num_measured=measured[k])] if k in measured else []
        for k in range(10)
    ]
    updates = {
        5: [update(tick=2, delay_ns=50_000_000, disposition=Disposition.BIRTH)],
        6: [update(tick=4, disposition=Disposition.IN_SEQUENCE)],
        8: [update(tick=3, disposition=Disposition.OUT_OF_SEQUENCE)],
    }
    run = write_run(
        tmp_path / "run",
        tracks,
        truth=[*WEST.truth(range(10)), *ROUND.truth(range(10))],
        updates=updates,
    )
    west, round_ = confirm_of(run)
    assert west == pytest.approx((8 - 2) * 0.02)
    assert math.isnan(round_)


def test_a_track_that_died_unconfirmed_counts_as_the_first_detection(
    tmp_path: Path,
) -> None:
    tracks = [
        [WEST.track(k, 1, num_measured=1)]
        if k < 2
        else [WEST.track(k, 2, num_measured=k - 3)]
        for k in range(9)
    ]
    updates = {k: [update(tick=k, track_id=1 if k < 2 else 2)] for k in (0, 4, 5, 6)}
    assert confirm_of(
        write_run(tmp_path / "run", tracks, truth=WEST.truth(range(9)), updates=updates)
    ) == [0.12]


@pytest.mark.parametrize(
    "stranger",
    [
        update(tick=0, track_id=7),  # lies 60 m away
        update(tick=0, track_id=8),  # never published
        update(tick=0, track_id=None, disposition=Disposition.GATED),
        update(tick=0, track_id=1, disposition=Disposition.TOO_OLD),
        update(tick=0, track_id=1, disposition=Disposition.MERGED),
    ],
)
def test_what_was_not_fused_into_a_track_of_the_object_is_not_its_first_detection(
    tmp_path: Path, stranger: UpdateRecord
) -> None:
    """The object's own detection is sensed at tick 2, its track is confirmed at tick 4."""
    tracks = [
        [WEST.track(k, 1, num_measured=k - 1), WEST.track(k, 7, across_m=60.0)]
        for k in range(6)
    ]
    updates = {1: [stranger], 3: [update(tick=2)]}
    run = write_run(
        tmp_path / "run", tracks, truth=WEST.truth(range(6)), updates=updates
    )
    assert confirm_of(run) == [pytest.approx(2 * 0.02)]


def test_a_detection_belongs_to_the_nearest_object(tmp_path: Path) -> None:
    """The twin drives 4 m beside: both tracks lie inside the gate of both objects."""
    twin = replace(WEST, object_id=9, y_m=4.0)
    tracks = [
        [car.track(k, i, num_measured=k - 2) for car, i in ((WEST, 1), (twin, 2))]
        for k in range(6)
    ]
    updates = {3: [update(tick=1, track_id=2)], 4: [update(tick=3, track_id=1)]}
    run = write_run(
        tmp_path / "run",
        tracks,
        truth=[*WEST.truth(range(6)), *twin.truth(range(6))],
        updates=updates,
    )
    assert confirm_of(run) == [pytest.approx(2 * 0.02), pytest.approx(4 * 0.02)]
