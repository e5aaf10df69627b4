"""Status and numbers of tracks whose decisions late data may change."""

from collections.abc import Mapping, Sequence

import numpy as np
import pytest

from fgtrack import (
    Config,
    Detection,
    DetectionList,
    TrackReport,
    TruthState,
    replay,
    simulate,
)
from fgtrack.pipeline.build import build_tracker

MS = 1_000_000
PERIOD_NS = 50 * MS
LATE_NS = 150 * MS


def published(
    sensors: Mapping[str, Mapping[str, object]], lists: Sequence[DetectionList]
) -> list[tuple[TrackReport, ...]]:
    """Return the tracks at the receipt of each list."""
    config = Config.from_dict(
        {
            "estimator": "ekf-replay",
            "association": {"kind": "hypotheses"},
            "sensors": sensors,
            "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
            "clock": {"node_hz": None},
        }
    )
    tracker, found = build_tracker(config), []
    for each in sorted(lists, key=lambda one: one.receipt_ns):
        tracker.receive(each)
        found.append(tracker.tick(each.receipt_ns).tracks)
    return found


def seen(sensor: str, stamp_ns: int, delay_ns: int, x_m: float | None) -> DetectionList:
    objects = [] if x_m is None else [Detection(x_m=x_m, y_m=0.0)]
    return DetectionList(sensor, stamp_ns, stamp_ns + delay_ns, objects, frame="map")


def test_a_car_that_the_late_sensor_always_shows_stays_confirmed_while_the_other_one_misses_it() -> (
    None
):
    rng = np.random.default_rng(2)
    lists = [seen("lidar", k * PERIOD_NS, LATE_NS, 0.5 * k) for k in range(80)]
    lists += [
        seen(
            "radar",
            k * PERIOD_NS + 20 * MS,
            0,
            0.5 * k + 0.2 if rng.random() < 0.5 else None,
        )
        for k in range(80)
    ]
    sensor = {"std": {"x_m": 0.3, "y_m": 0.3}, "detection_probability": 0.95}
    found = published({"lidar": sensor, "radar": sensor}, lists)
    statuses = [[track.status for track in tracks] for tracks in found[40:]]
    assert min(each.score or 0.0 for tracks in found[40:] for each in tracks) < 0.5, (
        "the RADAR's misses never make the car improbable, so this test shows nothing"
    )
    assert all(len(own) == 1 and own[0] != "tentative" for own in statuses)


def test_a_list_that_cannot_show_a_car_does_not_make_the_car_coast() -> None:
    lists = [seen("lidar", k * PERIOD_NS, 0, 0.5 * k) for k in range(40)]
    lists += [seen("radar", k * PERIOD_NS + 20 * MS, 0, None) for k in range(40)]
    lidar = {"std": {"x_m": 0.3, "y_m": 0.3}}
    found = published({"lidar": lidar, "radar": {**lidar, "scan": False}}, lists)
    assert {each.status for tracks in found[20:] for each in tracks} == {"confirmed"}


def test_a_car_that_the_last_list_misses_coasts() -> None:
    lists = [
        seen("lidar", k * PERIOD_NS, 0, 0.5 * k if k < 39 else None) for k in range(40)
    ]
    found = published({"lidar": {"std": {"x_m": 0.3, "y_m": 0.3}}}, lists)
    assert [each.status for each in found[-1]] == ["coasting"]
    assert [each.status for each in found[-2]] == ["confirmed"]


def test_a_confirmed_car_keeps_its_number_when_a_track_of_a_late_list_takes_over_its_detections() -> (
    None
):
    config = Config.from_yaml("open_space").replace(
        {
            "estimator": "ekf-replay",
            "association": {"kind": "hypotheses"},
            "lifecycle": {"kind": "existence"},
        }
    )
    messages = list(simulate("drawn_ctrv", seed=5, duration_s=1.0))
    run = replay(messages, config)
    cars = {
        each.object_id
        for each in messages
        if isinstance(each, TruthState) and each.object_id >= 0
    }
    tracks = run.tables["tracks"]
    numbers = set(tracks["track_id"][tracks["status"] != "tentative"].tolist())
    assert run.tables["revisions"].num_rows, "no decision changes here"
    assert len(numbers) == len(cars)


def test_a_ship_that_reports_every_three_minutes_stays_confirmed_in_between() -> None:
    config = Config.from_yaml("ais").replace({"association": {"kind": "hypotheses"}})
    tracker, second_ns, statuses = build_tracker(config), 1000 * MS, []
    for k in range(541):
        stamp_ns = k * second_ns
        if k % 180 == 0:
            reports = [Detection(x_m=100.0, y_m=50.0, id="1")]
            tracker.receive(
                DetectionList("ais", stamp_ns, stamp_ns, reports, frame="map")
            )
        statuses.append([each.status for each in tracker.tick(stamp_ns).tracks])
    assert {tuple(own) for own in statuses[360:]} == {("confirmed",)}


def test_ships_side_by_side_with_identities_of_their_own_are_tracks_of_their_own() -> (
    None
):
    config = Config.from_yaml("ais").replace({"association": {"kind": "hypotheses"}})
    tracker, owners = build_tracker(config), dict[str, set[int | None]]()
    for k in range(24):
        stamp_ns, name = k * 20_000 * MS, f"{k % 4}"
        report = Detection(x_m=100.0 + 30.0 * (k % 4), y_m=50.0, id=name)
        tracker.receive(DetectionList("ais", stamp_ns, stamp_ns, [report], frame="map"))
        updates = tracker.tick(stamp_ns).updates
        owners.setdefault(name, set()).update(each.track_id for each in updates)
    assert all(len(own) == 1 for own in owners.values())
    assert len(set.union(*owners.values())) == 4


def test_a_report_far_away_with_the_identity_of_a_track_starts_no_other_track() -> None:
    config = Config.from_yaml("adsb").replace({"association": {"kind": "hypotheses"}})
    tracker, owners = build_tracker(config), set[int | None]()
    for k in range(20):
        stamp_ns, x_m = k * 1000 * MS, 1000.0 + 250.0 * k + (9000.0 if k == 15 else 0.0)
        report = Detection(x_m=x_m, y_m=50.0, id="a")
        tracker.receive(
            DetectionList("adsb", stamp_ns, stamp_ns, [report], frame="map")
        )
        owners.update(each.track_id for each in tracker.tick(stamp_ns).tracks)
    assert len(owners) == 1


def test_a_track_has_the_size_of_its_detections_without_classes_and_identities() -> (
    None
):
    lists = [
        DetectionList(
            "lidar",
            k * PERIOD_NS,
            k * PERIOD_NS,
            [Detection(x_m=9.0 + 0.5 * k, y_m=0.0, length_m=4.0 + 0.1 * (k % 3))],
            frame="map",
        )
        for k in range(9)
    ]
    [track] = published({"lidar": {"std": {"x_m": 0.3, "y_m": 0.3}}}, lists)[-1]
    assert track.object is not None
    assert track.object.length_m == pytest.approx(4.1)
