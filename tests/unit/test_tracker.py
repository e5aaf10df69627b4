from dataclasses import replace

import pytest
from support.paper import paper
from support.tracking import START_NS, ms

from fgtrack.config.settings import Config
from fgtrack.core.errors import DataError
from fgtrack.core.types import (
    Detection,
    DetectionList,
    Disposition,
    EgoState,
    TickReport,
    TrackStatus,
)
from fgtrack.estimation.registry import ESTIMATORS
from fgtrack.models.oval import make_oval
from fgtrack.models.sensors import Correlation, SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.association import GatedEuclidean, GatedMahalanobis
from fgtrack.tracking.lives.counters import LifecycleRules
from fgtrack.tracking.lives.existence import ExistenceRules
from fgtrack.tracking.tracker import MultiObjectTracker

CLAIMING = LifecycleRules(suppress_births_near_newer_tracks=True)
POINTS = SensorModel(std={"x_m": 0.3, "y_m": 0.3})


def tracker(**sensors: SensorModel) -> MultiObjectTracker:
    return build_tracker(replace(paper(), sensors=sensors or {"lidar": POINTS}))


def seen(
    *places: tuple[float, float],
    at_ms: float = 0.0,
    late_ms: float = 0.0,
    sensor: str = "lidar",
    frame: str = "map",
) -> DetectionList:
    receipt_ns = START_NS + ms(at_ms)
    items = tuple(Detection(x_m=x_m, y_m=y_m) for x_m, y_m in places)
    return DetectionList(sensor, receipt_ns - ms(late_ms), receipt_ns, items, frame)


def tick(
    tracker: MultiObjectTracker, at_ms: float, *messages: DetectionList | EgoState
) -> TickReport:
    for message in messages:
        tracker.receive(message)
    return tracker.tick(START_NS + ms(at_ms))


def ids(report: TickReport) -> list[int]:
    return [track.track_id for track in report.tracks]


def dispositions(report: TickReport) -> list[str]:
    return [record.disposition.value for record in report.updates]


@pytest.mark.parametrize(
    ("estimator", "stamp_from"),
    [*((name, "object") for name in ESTIMATORS), ("ekf-replay", "message")],
)
def test_a_track_is_missed_by_a_message_as_a_whole_and_not_by_each_stamp_in_it(
    estimator: str, stamp_from
) -> None:
    sensor = replace(POINTS, stamp_from=stamp_from)
    one = build_tracker(
        replace(paper(), sensors={"lidar": sensor}, estimator=estimator)
    )
    for k in range(10):
        stamp_ns = START_NS + k * ms(50)
        items = tuple(
            Detection(x_m=20.0 * i, y_m=1.0, stamp_ns=stamp_ns - ms(3 * i))
            for i in range(4)
        )
        one.receive(DetectionList("lidar", stamp_ns, stamp_ns, items, "map"))
        report = one.tick(stamp_ns)
    assert sorted(ids(report)) == [0, 1, 2, 3]
    assert all(track.status is TrackStatus.CONFIRMED for track in report.tracks)
    assert all(track.num_measured == 10 for track in report.tracks)
    only_one = DetectionList(
        "lidar", stamp_ns + ms(50), stamp_ns + ms(50), items[:1], "map"
    )
    one.receive(only_one)
    report = one.tick(stamp_ns + ms(50))
    assert sorted(track.status for track in report.tracks) == ["coasting"] * 3 + [
        "confirmed"
    ]


def test_batches_of_one_tick_are_processed_in_order_of_their_stamps() -> None:
    one = tracker(a=POINTS, b=POINTS)
    report = tick(
        one,
        100.0,
        seen((1.0, 1.0), at_ms=90.0, late_ms=10.0, sensor="a"),
        seen((1.0, 1.0), at_ms=95.0, late_ms=80.0, sensor="b"),
    )
    assert [(record.sensor, record.disposition.value) for record in report.updates] == [
        ("b", "birth"),
        ("a", "in_sequence"),
    ]


def test_a_detection_that_no_noise_explains_is_gated_and_starts_no_track() -> None:
    one = build_tracker(
        replace(
            paper(),
            sensors={"lidar": POINTS},
            association=GatedEuclidean(gate_m=20.0, max_nis=50.0),
        )
    )
    tick(one, 0.0, seen((10.0, 0.0)))
    report = tick(one, 50.0, seen((28.0, 0.0), (40.0, 0.0), at_ms=50.0))
    assert sorted(dispositions(report)) == ["birth", "gated"]
    assert ids(report) == [0, 1]
    for k in (2, 3):
        report = tick(one, 50.0 * k, seen((28.0, 0.0), (40.0, 0.0), at_ms=50.0 * k))
    assert ids(report) == [1]  # and the track that it was near was not seen


@pytest.mark.parametrize("estimator", list(ESTIMATORS))
def test_detections_that_the_first_one_has_overtaken_start_no_second_track(
    estimator: str,
) -> None:
    one = build_tracker(
        replace(
            paper(),
            sensors={"lidar": POINTS, "radar": POINTS},
            estimator=estimator,
            lifecycle=CLAIMING,
        )
    )
    tick(one, 100.0, seen((10.0, 0.0), at_ms=100.0, sensor="radar"))
    late = seen((10.5, 0.0), (30.0, 0.0), at_ms=110.0, late_ms=50.0)
    report = tick(one, 120.0, late)
    assert [
        (record.index, record.disposition.value, record.track_id)
        for record in report.updates
    ] == [
        (0, "too_old", 0),
        (1, "birth", 1),
    ]


def test_what_is_near_a_younger_track_but_not_believed_is_gated() -> None:
    one = build_tracker(
        replace(
            paper(),
            sensors={"lidar": POINTS, "radar": POINTS},
            association=GatedEuclidean(gate_m=20.0, max_nis=50.0),
            lifecycle=CLAIMING,
        )
    )
    tick(one, 100.0, seen((10.0, 0.0), at_ms=100.0, sensor="radar"))
    report = tick(one, 120.0, seen((28.0, 0.0), at_ms=110.0, late_ms=50.0))
    assert dispositions(report) == ["gated"]


def test_a_track_that_begins_ahead_of_the_clock_claims_nothing() -> None:
    one = build_tracker(
        replace(
            paper(),
            sensors={"lidar": POINTS},
            estimator="ekf-replay",
            lifecycle=CLAIMING,
        )
    )
    tick(one, 100.0, seen((10.0, 0.0), at_ms=100.0, late_ms=-200.0))
    report = tick(one, 120.0, seen((10.5, 0.0), at_ms=110.0, late_ms=10.0))
    assert dispositions(report) == ["birth"]


def test_a_confirmed_track_claims_what_is_near_and_a_tentative_one_does_not() -> None:
    """Two of three measurements: an object 8 m aside starts a track; after the third nothing does."""
    claiming = GatedMahalanobis(max_distance_m=3.0, claim_m=10.0)
    one = build_tracker(
        Config(
            sensors={"lidar": POINTS}, association=claiming, lifecycle=LifecycleRules()
        )
    )
    tick(one, 0.0, seen((9.0, 0.0), at_ms=0.0))
    assert dispositions(
        tick(one, 100.0, seen((9.1, 0.0), (9.0, 8.0), at_ms=100.0))
    ) == ["in_sequence", "birth"]
    tick(one, 200.0, seen((9.2, 0.0), at_ms=200.0))
    aside = seen((9.3, 0.0), (9.0, -8.0), (9.0, -12.0), at_ms=300.0)
    assert dispositions(tick(one, 300.0, aside)) == ["in_sequence", "gated", "birth"]


@pytest.mark.parametrize(
    ("probability", "disposition"), [(0.0, "gated"), (0.1, "in_sequence")]
)
def test_a_refused_detection_updates_a_track_without_one_where_errors_jump(
    probability: float, disposition
) -> None:
    """Errors of 3 m of which 0.3 m is new: 6 m aside is outside the gate, and inside that of the whole error."""
    hull = SensorModel(
        {"x_m": 3.0, "y_m": 3.0}, correlation=Correlation(0.99, 100.0, probability)
    )
    claiming = GatedMahalanobis(max_distance_m=10.0, claim_m=10.0)
    one = build_tracker(
        Config(
            sensors={"lidar": hull}, association=claiming, lifecycle=ExistenceRules()
        )
    )
    for k in range(20):
        tick(one, 100.0 * k, seen((9.0, 0.0), at_ms=100.0 * k))
    [record] = tick(one, 2000.0, seen((9.0, 6.0), at_ms=2000.0)).updates
    assert record.disposition.value == disposition
    assert probability == 0.0 or (record.nis is not None and record.nis < 9.0)


def test_where_a_track_was_before_it_began_follows_its_motion() -> None:
    """20 m/s along x, first seen at 0.1 s at x = 50: 0.5 s before it was at 40."""
    road_runner = SensorModel(
        std={"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1, "speed_mps": 0.2}
    )
    one = build_tracker(
        replace(
            paper(), sensors={"lidar": POINTS, "v2v": road_runner}, lifecycle=CLAIMING
        )
    )
    stamp_ns = START_NS + ms(600)
    first = Detection(x_m=50.0, y_m=0.0, yaw_rad=0.0, speed_mps=20.0)
    tick(one, 600.0, DetectionList("v2v", stamp_ns, stamp_ns, (first,), "map"))
    report = tick(
        one, 620.0, seen((40.0, 0.0), (47.0, 0.0), at_ms=610.0, late_ms=510.0)
    )
    assert dispositions(report) == ["too_old", "birth"]


def test_a_list_that_saw_nothing_ages_the_tracks_until_they_end() -> None:
    one = tracker()
    assert ids(tick(one, 0.0, seen((10.0, 0.0)))) == [0]
    for k in (1, 2):
        [track] = tick(one, 50.0 * k, seen(at_ms=50.0 * k)).tracks
        assert track.track_id == 0
    assert ids(tick(one, 150.0, seen(at_ms=150.0))) == []
    assert ids(tick(one, 200.0, seen((10.0, 0.0), at_ms=200.0))) == [
        1
    ]  # ids are not used again


def test_time_alone_ends_a_track() -> None:
    one = tracker()
    tick(one, 0.0, seen((10.0, 0.0)))
    assert ids(tick(one, 2000.0)) == [0]
    assert ids(tick(one, 2000.1)) == []


def test_without_an_ego_pose_only_map_detections_can_be_placed() -> None:
    one = tracker()
    report = tick(
        one,
        0.0,
        seen((10.0, 0.0), frame="ego"),
        seen((30.0, 0.0), frame="map", late_ms=1.0),
    )
    assert sorted(dispositions(report)) == ["birth", "failed"]
    ego = EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, 0.0)
    assert "failed" not in dispositions(
        tick(one, 50.0, ego, seen((10.0, 0.0), at_ms=50.0, frame="ego"))
    )


def test_a_late_detection_is_placed_by_where_the_ego_was_at_its_stamp() -> None:
    """The ego has gone 5 m since, at 50 m/s, and the new object 4 m, at the speed that it starts with."""
    ego = [
        EgoState(START_NS + ms(t), START_NS + ms(t), 0.05 * t, 0.0, 0.0, 50.0)
        for t in range(0, 201, 10)
    ]
    found = []
    for late_ms in (0.0, 100.0):
        report = tick(
            tracker(),
            200.0,
            *ego,
            seen((20.0, 3.0), at_ms=200.0, late_ms=late_ms, frame="ego"),
        )
        found.append(report.tracks[0].state.mean)
    assert found[1] - found[0] == pytest.approx(
        [-5.0 + 0.1 * found[0][3], 0.0, 0.0, 0.0, 0.0], abs=1e-6
    )


@pytest.mark.parametrize(
    ("late", "expected"), [("fuse", "beyond_window"), ("drop", "too_old")]
)
def test_a_smoother_fuses_behind_its_window_as_far_as_its_ring(
    late: str, expected: str
) -> None:
    settings = [
        f"smoother={{lag_s: 0.3, ring_s: 0.3, late: {late}}}",
        "sensors={lidar: {std: {x_m: 0.3, y_m: 0.3}}}",
    ]
    one = build_tracker(replace(paper(*settings), estimator="smoother"))
    for k in range(21):
        tick(one, 50.0 * k, seen((10.0, 0.0), at_ms=50.0 * k))
    late_ms = (250.0, 450.0, 650.0)
    report = tick(
        one, 1001.0, *(seen((10.0, 0.0), at_ms=1001.0, late_ms=ms_) for ms_ in late_ms)
    )
    assert sorted(dispositions(report)) == sorted(
        ["out_of_sequence", expected, "too_old"]
    )


def test_what_is_older_than_the_storage_is_too_old() -> None:
    one = tracker()
    report = tick(
        one,
        0.0,
        seen((10.0, 0.0), (50.0, 0.0), late_ms=3600.0),
        seen((10.0, 0.0), late_ms=3400.0),
    )
    assert dispositions(report) == ["too_old", "too_old", "birth"]


def test_a_sensor_that_starts_no_tracks_leaves_its_detections_gated() -> None:
    one = tracker(lidar=POINTS, camera=replace(POINTS, births=False))
    assert dispositions(tick(one, 0.0, seen((10.0, 0.0), sensor="camera"))) == ["gated"]
    tick(one, 50.0, seen((10.0, 0.0), at_ms=50.0))
    report = tick(one, 100.0, seen((10.0, 0.0), at_ms=100.0, sensor="camera"))
    assert dispositions(report) == ["in_sequence"]
    assert report.updates[0].track_id == 0


def test_the_members_of_a_merged_group_share_the_track_and_one_carries_the_outcome() -> (
    None
):
    report = tick(
        tracker(), 0.0, seen((10.0, 0.0), (12.0, 0.0), (60.0, 0.0), (14.0, 0.0))
    )
    outcome = {
        record.index: (record.disposition, record.track_id) for record in report.updates
    }
    assert outcome == {
        0: (Disposition.BIRTH, 0),
        1: (Disposition.MERGED, 0),
        3: (Disposition.MERGED, 0),
        2: (Disposition.BIRTH, 1),
    }


def test_refused_ego_messages_are_counted_by_reason() -> None:
    one = tracker()
    good = EgoState(START_NS, START_NS, 0.0, 0.0, 0.0, 0.0)
    for message in (
        good,
        good,
        replace(good, stamp_ns=START_NS + 1, x_m=float("nan")),
        good,
    ):
        one.receive(message)
    assert dict(one.refused_ego) == {"repeated stamp": 2, "not finite": 1}
    for k in (1, 2, 3):
        one.receive(
            replace(good, stamp_ns=START_NS + ms(10.0 * k), x_m=100.0 * (k > 1))
        )
    assert one.ego_jumps == 1


def test_an_unknown_sensor_is_an_error_that_says_what_to_do() -> None:
    with pytest.raises(
        DataError, match=r"'sonar' has no model .*lidar.*ignore_sensors"
    ):
        tracker().receive(seen((1.0, 1.0), sensor="sonar"))


def test_an_innovation_is_named_by_what_was_measured() -> None:
    one = tracker()
    tick(one, 0.0, seen((10.0, 0.0)))
    [record] = tick(one, 10.0, seen((10.0, 0.5), at_ms=10.0)).updates
    assert record.innovation == pytest.approx({"x_m": 0.0, "y_m": 0.5}, abs=1e-9)
    assert record.nis > 0.0


@pytest.mark.parametrize("published", [False, True])
def test_a_heading_from_the_map_is_no_innovation_except_in_the_published_configuration(
    published: bool,
) -> None:
    """NIS and innovation have the same degrees of freedom; the estimates do not differ."""
    config = paper(
        "map.track=oval", *(["lifecycle.kind=published"] if published else [])
    )
    one = build_tracker(config)
    x_m, y_m = make_oval().table[100, :2].tolist()
    for at_ms in (0.0, 50.0):
        stamp_ns = START_NS + ms(at_ms)
        one.receive(EgoState(stamp_ns, stamp_ns, x_m - 30.0, y_m, 0.0, 20.0))
        item = Detection(x_m=x_m + 0.02 * at_ms, y_m=y_m)
        report = tick(
            one,
            at_ms,
            DetectionList("lidar_cluster", stamp_ns, stamp_ns, [item], "map"),
        )
    [update] = report.updates
    assert update.nis is not None
    assert set(update.innovation) == {"x_m", "y_m"} | (
        {"yaw_rad"} if published else set()
    )


def test_a_second_position_is_as_surprising_in_any_direction() -> None:
    """Without a heading the prior of the estimator, linearised along an arbitrary yaw, spreads along that alone."""
    nis = []
    for x_m, y_m in ((1.0, 0.0), (0.0, 1.0)):
        one = build_tracker(
            replace(Config(), sensors={"lidar": POINTS}, estimator="ekf-replay")
        )
        reports = [
            tick(one, 100.0 * k, seen((k * x_m, k * y_m), at_ms=100.0 * k))
            for k in range(1, 3)
        ]
        nis.append(reports[1].updates[0].nis)
    assert nis[0] == pytest.approx(nis[1], rel=1e-4)


@pytest.mark.parametrize("estimator", list(ESTIMATORS))
def test_a_list_fuses_the_detection_of_a_track_that_it_ends_and_those_of_all_others(
    estimator: str,
) -> None:
    clear, cluttered = (
        replace(POINTS, clutter_per_m2=density) for density in (1e-4, 0.1)
    )
    rules = ExistenceRules(birth_probability=0.1)
    config = replace(
        Config(),
        sensors={"lidar": clear, "radar": cluttered},
        estimator=estimator,
        lifecycle=rules,
    )
    one = build_tracker(config)
    for k in range(10):
        tick(
            one,
            100.0 * k,
            seen((20.0 + k, 0.0), (20.0 + k, 60.0), (20.0 + k, -60.0), at_ms=100.0 * k),
        )
    tick(
        one,
        1000.0,
        seen((30.0, 0.0), (30.0, 60.0), (200.0, 200.0), at_ms=1000.0, sensor="radar"),
    )
    report = tick(
        one, 1100.0, seen((200.0, 200.0), (31.3, 0.0), at_ms=1100.0, sensor="radar")
    )
    assert [
        (row.index, row.disposition.value, row.track_id) for row in report.updates
    ] == [
        (0, "in_sequence", 3),
        (1, "in_sequence", 0),
    ]
    assert ids(report) == [
        0,
        1,
        2,
    ]  # clutter explains the second detection of track 3 better
    assert report.tracks[0].num_measured == 12
    assert not +one.failures.counts
