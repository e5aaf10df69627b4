"""What the lists of a sensor show of scans and clutter, and what a replay takes from it."""

import math
from dataclasses import replace

import pytest

import fgtrack
from fgtrack.core.types import Detection, DetectionList
from fgtrack.pipeline.assumptions.coverage import Coverage, coverages

SECOND_NS = 10**9


def coverage(*sizes: int) -> Coverage:
    lists = []
    for number, size in enumerate(sizes):
        objects = [Detection(x_m=10.0 * number, y_m=float(k + number % 2)) for k in range(size)]
        lists.append(DetectionList("any", number, number, objects))
    return coverages(lists)["any"]


@pytest.mark.parametrize(
    ("sizes", "scans"),
    [([1] * 20, False), ([1] * 18 + [2] * 2, False), ([1] * 19 + [0], True), ([1, 2] * 10, True), ([1] * 9, True)],
)
def test_lists_of_one_object_are_no_scans_unless_one_is_empty(sizes: list[int], scans: bool) -> None:
    assert coverage(*sizes).scans == scans


def test_clutter_is_at_most_as_dense_as_all_detections() -> None:
    assert coverage(*[1] * 11).density_per_m2 == pytest.approx(1.0 / 100.0)
    assert coverage(*[1] * 9).density_per_m2 == math.inf
    line = [DetectionList("any", k, k, [Detection(range_m=float(k), bearing_rad=0.0)]) for k in range(20)]
    assert coverages(line)["any"].density_per_m2 == math.inf


def reports() -> list[DetectionList]:
    """Six aircraft that report position and velocity every 10 s, each in a list of its own, for two minutes."""
    found = []
    for k in range(72):
        number, at_s = k % 6, k * 10.0 / 6.0
        south_mps = 100.0 * (number % 2)
        x_m, y_m = 1e3 + 30e3 * number + 200.0 * at_s, 20e3 * (number % 3) - south_mps * at_s
        velocity = {"yaw_rad": -math.atan2(south_mps, 200.0), "speed_mps": math.hypot(south_mps, 200.0)}
        stamp_ns = SECOND_NS * 1000 + round(at_s * SECOND_NS)
        found.append(DetectionList("adsb", stamp_ns, stamp_ns, [Detection(x_m=x_m, y_m=y_m, **velocity)], frame="map"))
    return found


def test_objects_that_report_one_by_one_are_tracked_each_under_one_id() -> None:
    run = fgtrack.replay(reports(), set={"clock.node_hz": 1.0})
    assert run.config["sensors"]["adsb"]["scan"] is False
    assert sum(run.updates["disposition"] == "birth") == 6
    last = run.tracks["tick"] == run.tracks["tick"].max()
    assert list(run.tracks["status"][last]) == ["confirmed"] * 6


def test_a_scan_misses_what_it_lacks_whatever_the_recording_looks_like() -> None:
    empty = replace(reports()[-1], stamp_ns=SECOND_NS * 1130, receipt_ns=SECOND_NS * 1130, objects=[])
    run = fgtrack.replay([*reports(), empty], set={"clock.node_hz": 1.0})
    assert run.config["sensors"]["adsb"]["scan"] is True
    assert sum(run.updates["disposition"] == "birth") > 6
