"""Rows of tracks in arrays: no two tracks share one, whatever comes and goes."""

import numpy as np
import pytest

from fgtrack.tracking.rows import TrackRows


@pytest.mark.parametrize("seed", range(5))
def test_no_two_tracks_share_a_row_and_no_row_is_left_out(seed: int) -> None:
    rng, rows, most = np.random.default_rng(seed), TrackRows(), 0
    alive: dict[int, int] = {}
    for track_id in range(200):
        following = rows.following
        assert following not in alive.values()
        alive[track_id] = rows.begin(track_id)
        assert alive[track_id] == following
        most = max(most, len(alive))
        while alive and rng.random() < 0.45:
            gone = int(rng.choice(list(alive)))
            assert rows.end(gone) == alive.pop(gone)
            assert rows.end(gone) is None
        ids = list(alive)
        assert rows.of(ids).tolist() == rows.every.tolist() == list(alive.values())
        assert rows.of(ids[1:]).tolist() == list(alive.values())[1:]
        assert rows.of([]).tolist() == []
    assert max(rows.every) < most


def test_no_rows_are_those_of_no_tracks_after_others_were_asked_for() -> None:
    rows = TrackRows()
    rows.begin(4)
    assert rows.of([4]).tolist() == [0]
    rows.begin(5)
    assert rows.of([]).tolist() == []


def test_a_track_whose_beginning_was_interrupted_frees_its_row_once() -> None:
    rows = TrackRows()
    for track_id in range(3):
        rows.begin(track_id)
    rows.end(1)
    rows.by_id[3] = rows.following  # the interrupt came before the row was taken
    rows.end(3)
    assert [rows.begin(track_id) for track_id in (4, 5)] == [1, 3]
