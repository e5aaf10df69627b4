"""Scans of a sensor for the tests of hypotheses."""

from fgtrack.core.types import Detection, DetectionList, EgoState
from fgtrack.meaning.scans import scans_of


def test_an_empty_list_has_a_scan_without_positions() -> None:
    messages = [EgoState(10**9 * k, 10**9 * k, 0.0, 0.0, 0.0, 0.0) for k in range(4)]
    objects = ((Detection(x_m=1.0, y_m=2.0, speed_mps=3.0),), (), ())
    lists = [
        DetectionList("radar", 10**9 * k, 10**9 * k, one)
        for k, one in enumerate(objects)
    ]
    scans = scans_of([*messages, *lists], "radar", lambda item: (item.speed_mps,))
    assert scans is not None
    assert [one.shape for one in scans.positions_m] == [(1, 2), (0, 2), (0, 2)]
    assert [one.shape for one in scans.values] == [(1, 1), (0, 1), (0, 1)]
