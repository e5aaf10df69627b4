"""Where an object can be: on track or pit lane, or anywhere without a map."""

import numpy as np
import pytest

from fgtrack.core.errors import DataError
from fgtrack.karle2023.road_map import PublishedMap
from fgtrack.models.oval import make_oval, make_pit_lane
from fgtrack.models.road import Road
from fgtrack.models.track_map import COLUMNS, TrackMap


def test_without_a_map_an_object_may_be_anywhere_and_no_heading_is_known() -> None:
    view = Road().view(np.array([[0.0, 0.0], [1e6, -1e6]]))
    assert not Road().has_track
    assert [part.tolist() for part in view] == [[0.0, 0.0], [0.0, 0.0], [False, False]]


def test_an_object_is_outside_where_it_is_neither_on_the_track_nor_in_the_pit_lane() -> (
    None
):
    track, pit = make_oval(), make_pit_lane()
    lateral = np.array(
        [0.0, 24.0, 60.0, 8.0]
    )  # on the track, in the pit lane, on neither, just off the track
    points = track.position(np.full(4, 100.0), lateral)
    assert Road(track).view(points).outside.tolist() == [False, True, True, True]
    road = Road(track, pit, 0.0, 0.0, 0.0)
    assert road.view(points).outside.tolist() == [False, False, True, True]
    assert Road(track, pit, 1.0, 0.0, 0.0).view(points).outside.tolist() == [
        False,
        False,
        True,
        False,
    ]
    assert Road(track, pit, 0.0, 0.0, -5.0).view(points).outside.tolist() == [
        False,
        True,
        True,
        True,
    ]
    np.testing.assert_array_equal(
        road.view(points).yaw_rad, track.view(points, 0.0, 0.0).yaw_rad
    )


def test_a_published_look_up_needs_a_raceline_that_goes_on() -> None:
    table = make_oval().table.copy()
    table[:, COLUMNS.index("s_racetraj_m")] = 0.0
    with pytest.raises(DataError, match="s_racetraj_m must increase"):
        PublishedMap(TrackMap(table))
