"""The existence probability of a track, and the lifecycle that it decides."""

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from support.tracking import START_NS, candidate, candidates_of, match, ms, status

from fgtrack.config.reading import read_config
from fgtrack.config.settings import Config
from fgtrack.config.yaml_file import load
from fgtrack.core.errors import CallError
from fgtrack.core.types import Detection, DetectionList, TrackStatus
from fgtrack.estimation.base import StatesAt
from fgtrack.models.sensors import Score, SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.tracking.association import Pairs
from fgtrack.tracking.ego.trajectory import EgoPose
from fgtrack.tracking.lives.counters import Scan
from fgtrack.tracking.lives.existence import (
    ExistenceLifecycle,
    ExistenceRules,
    explained,
)

SENSORS = {
    "lidar": SensorModel(
        std={"x_m": 0.3, "y_m": 0.3}, detection_probability=0.8, clutter_per_m2=1e-3
    ),
    "ahead": SensorModel(
        std={"x_m": 0.3, "y_m": 0.3}, view_range_m=50.0, field_of_view_rad=1.0
    ),
    "scored": SensorModel(
        std={"x_m": 0.3, "y_m": 0.3}, score=Score(even=3.0, scale=0.5)
    ),
}
STILL = ExistenceRules(lifetime_s=1e9)
HERE = candidate(10.0, 0.0)
BEHIND = np.array([-10.0, 0.0, 0.0, 0.0, 0.0])
MEAN, P = np.array([10.0, 0.0, 0.0, 0.0, 0.0]), 0.01 * np.eye(5)


def lifecycle(rules: ExistenceRules = STILL) -> ExistenceLifecycle:
    return ExistenceLifecycle(rules, SENSORS, (0.0, 0.0))


def scan(sensor: str = "lidar", at_ms: float = 0.0, **more) -> Scan:
    return Scan(sensor, START_NS + ms(at_ms), START_NS + ms(at_ms), **more)


def ego(x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0) -> EgoPose:
    return EgoPose(x_m, y_m, yaw_rad, 0.0, 0.0)


def probability(life: ExistenceLifecycle, at_ms: float = 0.0) -> float:
    life.expired(START_NS + ms(at_ms))
    return probability_now(life)


def probability_now(life: ExistenceLifecycle) -> float:
    _, [found] = life.reported([0])
    return found


def test_a_miss_and_a_match_change_the_probability_as_integrated_data_association_says() -> (
    None
):
    life = lifecycle()
    life.born(0, scan(), HERE)
    r, P_D, v = 0.2, 0.8, 1.0
    for at_ms, x_m in ((10.0, None), (20.0, 10.3)):
        v = STILL.visible_share + (v - STILL.visible_share) * math.exp(
            -0.01 / STILL.visible_s
        )
        ratio = 1.0 - P_D
        if x_m is None:
            life.missed(
                scan(at_ms=at_ms), [0], np.array([[10.0, 0.0]]), np.array([10.0])
            )
        else:
            match(life, 0, scan(at_ms=at_ms), candidate(x_m, 0.0), MEAN, P)
            S = 0.09 + 0.01
            ratio += (
                P_D
                * math.exp(-0.5 * (x_m - 10.0) ** 2 / S)
                / (2.0 * math.pi * S)
                / 1e-3
            )
        likelihood = 1.0 - v + v * ratio
        r, v = r * likelihood / (1.0 - r + r * likelihood), v * ratio / likelihood
        assert probability(life, at_ms) == pytest.approx(r, rel=1e-6)


@pytest.mark.parametrize("gap_s", [400.0, 1e7])
def test_nothing_survives_a_gap_of_many_lifetimes(gap_s: float) -> None:
    life = lifecycle(ExistenceRules())
    life.born(0, scan(), HERE)
    assert life.expired(START_NS + ms(1e3 * gap_s)) == [0]
    assert probability(life, 1e3 * gap_s) < 1e-9
    match(life, 0, scan(at_ms=1e3 * gap_s), HERE, MEAN, P)
    assert 0.0 < probability(life, 1e3 * gap_s) < 1e-4


def test_an_object_survives_as_long_as_its_lifetime_says() -> None:
    life = lifecycle(ExistenceRules(birth_probability=0.75, lifetime_s=4.0))
    life.born(0, scan(), HERE)
    assert probability(life) == pytest.approx(0.75)
    assert probability(life, 6000.0) == pytest.approx(0.75 * math.exp(-1.5))


def test_a_track_that_is_hidden_for_too_long_ends_although_it_is_probable() -> None:
    life, there = lifecycle(replace(STILL, hidden_s=1.0)), np.array([[10.0, 0.0]])
    life.born(0, scan(), HERE)
    for k in range(1, 10):
        match(life, 0, scan(at_ms=100.0 * k), HERE, MEAN, P)
    ended = [
        k
        for k in range(10, 30)
        if life.missed(scan(at_ms=100.0 * k), [0], there, np.array([10.0]))
    ]
    assert probability(life, 3000.0) > 0.9
    assert 20 <= ended[0] <= 23


@pytest.mark.parametrize("learned_s", [0.0, 60.0])
def test_lists_count_at_their_stamps_in_whatever_order_they_arrive(
    learned_s: float,
) -> None:
    """Also after lists that have left the memory."""
    lists = [
        ("lidar", 300.0, True),
        ("ahead", 500.0, False),
        ("lidar", 600.0, False),
        ("ahead", 900.0, True),
    ]
    found = set()
    for order in permutations(lists):
        life = lifecycle(ExistenceRules(memory_s=2.0))
        life.born(0, scan(), HERE)
        for k in range(round(learned_s)):
            life.expired(START_NS + ms(1000.0 * k))
            match(life, 0, scan(at_ms=1000.0 * k, ego=ego()), HERE, MEAN, P)
        life.expired(START_NS + ms(1000.0 * learned_s + 1000.0))
        for sensor, at_ms, shown in order:
            seen = scan(sensor, 1000.0 * learned_s + at_ms, ego=ego())
            if shown:
                match(life, 0, seen, HERE, MEAN, P)
            else:
                life.missed(seen, [0], np.array([[10.0, 0.0]]), np.array([10.0]))
        found.add(probability(life, 1000.0 * learned_s + 1500.0))
    assert len(found) == 1


def test_the_misses_of_one_sensor_do_not_end_what_another_sees() -> None:
    rules, there = (
        ExistenceRules(out_of_view_s=2.0, delete_probability=0.002),
        np.array([[10.0, 0.0]]),
    )
    life = lifecycle(rules)
    life.born(0, scan("lidar"), HERE)
    for k in range(1, 200):
        if k % 10 == 0:
            match(life, 0, scan("lidar", 100.0 * k), HERE, MEAN, P)
        assert (
            life.missed(scan("scored", 100.0 * k), [0], there, np.array([10.0])) == []
        )
        life.expired(START_NS + ms(100.0 * k))
    assert status(life) is TrackStatus.COASTING
    assert probability_now(life) > rules.confirm_probability


@pytest.mark.parametrize(
    ("place", "counts"),
    [
        ((20.0, 0.0), True),
        ((60.0, 0.0), False),
        ((10.0, 20.0), False),
        ((-20.0, 0.0), False),
    ],
)
def test_a_list_says_nothing_of_what_its_sensor_cannot_see(
    place: tuple[float, float], counts: bool
) -> None:
    life = lifecycle()
    life.born(0, scan("ahead"), HERE)
    before = probability(life)
    life.missed(scan("ahead", ego=ego()), [0], np.array([place]), np.array([20.0]))
    assert (probability(life) < before) is counts
    match(life, 0, scan(at_ms=1.0), HERE, MEAN, P)
    life.missed(scan("ahead", 2.0, ego=ego()), [0], np.array([place]), np.array([20.0]))
    assert (status(life) is TrackStatus.COASTING) is counts


def test_a_track_that_left_the_view_of_all_sensors_ends_although_it_is_believed() -> (
    None
):
    life = lifecycle(replace(STILL, out_of_view_s=0.5))
    life.born(0, scan("ahead"), HERE)
    for k in range(5):
        match(life, 0, scan("ahead", 10.0 * k, ego=ego()), HERE, MEAN, P)
    for at_ms in (100.0, 540.0, 541.0):
        assert life.expired(START_NS + ms(5000)) == []  # nobody looked
        ended = life.missed(
            scan("ahead", at_ms, ego=ego(x_m=100.0)),
            [0],
            np.array([[10.0, 0.0]]),
            np.array([90.0]),
        )
        assert ended == ([0] if at_ms > 540.0 else [])


def late(at_ms: float, late_ms: float) -> np.ndarray:
    """Watermarks of the sensors, where the lists of the first are so late and those of the others are not."""
    now_ns = START_NS + ms(at_ms)
    return np.array([now_ns - ms(late_ms), now_ns, now_ns])


@pytest.mark.parametrize("late_ms", [0.0, 700.0, 3000.0])
def test_a_track_out_of_view_waits_for_the_lists_of_a_late_sensor(
    late_ms: float,
) -> None:
    """The sensor ahead sees nothing of it; the other one stops after five lists."""
    life, there = lifecycle(replace(STILL, out_of_view_s=0.5)), np.array([[-10.0, 0.0]])
    for at_ms in np.arange(0.0, late_ms, 100.0):
        life.missed(scan("ahead", at_ms, ego=ego()), [], np.zeros((0, 2)), np.zeros(0))
    life.born(0, scan("lidar", 0.0, ego=ego()), candidate(-10.0, 0.0))
    ended = []
    for k in range(1, 60):
        at_ms = late_ms + 100.0 * k
        life.expired(
            START_NS + ms(at_ms), late(at_ms, late_ms), START_NS + ms(100.0 * k)
        )
        if k < 5:
            match(
                life,
                0,
                scan("lidar", 100.0 * k, ego=ego()),
                candidate(-10.0, 0.0),
                BEHIND,
                P,
            )
        life.missed(scan("ahead", at_ms, ego=ego()), [0], there, np.array([10.0]))
        ended += [k] * len(life.expired(START_NS + ms(at_ms), late(at_ms, late_ms)))
    assert (
        ended[0] == 10
    )  # its list of 1.0 s should have come, 0.6 s after the last one that showed it


def test_a_track_that_a_late_list_may_still_show_is_suspended_and_comes_back() -> None:
    life, there = lifecycle(), np.array([[10.0, 0.0]])
    life.born(0, scan("lidar", ego=ego()), HERE)
    at_ms = 1000.0
    life.expired(START_NS + ms(at_ms), late(at_ms, 950.0))
    for k in range(20):
        assert (
            life.missed(
                scan("ahead", at_ms + 40.0 * k, ego=ego()), [0], there, np.array([10.0])
            )
            == []
        )
    now_ms = at_ms + 40.0 * 20
    assert life.expired(START_NS + ms(now_ms), late(now_ms, 950.0)) == []
    assert life.suspended() == {0}
    assert (
        life.suspended(START_NS + ms(500.0)) == frozenset()
    )  # nothing had missed it yet
    assert life.suspended(START_NS + ms(now_ms)) == {0}
    match(life, 0, scan("lidar", 500.0, ego=ego()), HERE, MEAN, P)
    assert life.expired(START_NS + ms(now_ms), late(now_ms, 950.0)) == []
    assert life.suspended() == frozenset()
    assert status(life) is not TrackStatus.TENTATIVE


def test_a_suspended_track_ends_when_the_lists_that_could_show_it_should_have_come() -> (
    None
):
    life, there = lifecycle(), np.array([[10.0, 0.0]])
    life.born(0, scan("lidar", ego=ego()), HERE)
    life.expired(START_NS + ms(1000.0), late(1000.0, 950.0))
    improbable_ms = None
    for k in range(20):
        life.missed(
            scan("ahead", 1000.0 + 40.0 * k, ego=ego()), [0], there, np.array([10.0])
        )
        life.expired(START_NS + ms(1000.0 + 40.0 * k), late(1000.0 + 40.0 * k, 950.0))
        if improbable_ms is None and life.suspended():
            improbable_ms = 1000.0 + 40.0 * k
    ended = [
        at_ms
        for at_ms in range(1800, 3000, 10)
        if life.expired(START_NS + ms(at_ms), late(at_ms, 950.0)) == [0]
    ]
    assert ended[0] == improbable_ms + 950.0


@pytest.mark.parametrize("order", [(1, 2), (2, 1)])
@pytest.mark.parametrize("lifetime_s", [0.5, 20.0])
def test_a_track_is_confirmed_at_the_stamp_of_a_list_however_late_it_comes(
    order: tuple[int, int], lifetime_s: float
) -> None:
    life = lifecycle(replace(STILL, lifetime_s=lifetime_s))
    life.born(0, scan("lidar", ego=ego()), candidate(-10.0, 0.0))
    for k in range(30):  # that cannot show it
        life.missed(
            scan("ahead", 100.0 * k, ego=ego()),
            [0],
            np.array([[-10.0, 0.0]]),
            np.array([10.0]),
        )
    for k in order:
        match(
            life,
            0,
            scan("lidar", 100.0 * k, ego=ego()),
            candidate(-10.0, 0.0),
            BEHIND,
            P,
        )
    life.expired(START_NS + ms(3000.0), late(3000.0, 2900.0))
    assert status(life) is TrackStatus.CONFIRMED
    assert probability_now(life) < math.exp(
        -2.8 / lifetime_s
    )  # the probability is that of now


@pytest.mark.parametrize("angle_rad", np.linspace(0.0, 3.0, 5))
def test_a_position_on_an_endless_line_proves_nothing(angle_rad: float) -> None:
    """As of a RADAR whose range is good to 1e9 m."""
    life = lifecycle()
    life.born(0, scan(), HERE)
    along = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    far = candidate(10.0, 0.0)._replace(
        position_covariance=1e18 * np.outer(along, along) + 0.01 * np.eye(2)
    )
    match(life, 0, scan(at_ms=20.0), far, MEAN, P)
    assert 0.0 < probability(life, 20.0) < 0.2001


def test_a_late_list_takes_nothing_back_of_when_the_track_was_last_in_view() -> None:
    life = lifecycle(replace(STILL, out_of_view_s=0.5))
    life.born(0, scan("ahead"), HERE)
    for at_ms in (400.0, 100.0):  # the second one late
        match(life, 0, scan("ahead", at_ms, ego=ego()), HERE, MEAN, P)
    elsewhere = scan("ahead", 800.0, ego=ego(x_m=100.0))
    assert life.missed(elsewhere, [0], np.array([[10.0, 0.0]]), np.array([90.0])) == []


def test_the_score_of_a_match_counts_as_much_as_its_place() -> None:
    found = []
    for score in (3.0, 2.5):
        life = lifecycle()
        life.born(0, scan("scored"), HERE)
        seen = (Detection(x_m=12.0, y_m=0.0, score=score),)
        match(
            life, 0, scan("scored", 10.0, objects=seen), candidate(12.0, 0.0), MEAN, P
        )
        found.append(probability(life, 10.0))
    odds = [4.0 * p / (1.0 - p) for p in found]  # at birth 1 / 4
    missed = scan("scored", 10.0)
    life = lifecycle()
    life.born(0, scan("scored"), HERE)
    life.missed(missed, [0], np.array([[12.0, 0.0]]), np.array([12.0]))
    p = probability(life, 10.0)
    at_miss = 4.0 * p / (1.0 - p)
    assert (odds[0] - at_miss) / (odds[1] - at_miss) == pytest.approx(math.e, rel=1e-6)


def test_a_better_score_makes_an_object_more_probable() -> None:
    found = []
    for score in (2.0, None, 3.0, 5.0):
        life = lifecycle()
        life.born(
            0,
            scan("scored", objects=(Detection(x_m=10.0, y_m=0.0, score=score),)),
            HERE,
        )
        found.append(probability(life))
    low, none, even, high = found
    assert low < none < high
    assert even == none == pytest.approx(0.2)
    assert high / (1.0 - high) == pytest.approx(0.25 * math.exp(4.0))


def test_a_confirmed_track_is_coasting_when_missed_tentative_when_doubted_and_confirmed_again_when_seen() -> (
    None
):
    life = lifecycle(replace(STILL, doubt_probability=0.6))
    life.born(0, scan(), HERE)
    assert status(life) is TrackStatus.TENTATIVE
    match(life, 0, scan(at_ms=10.0), HERE, MEAN, P)
    life.expired(START_NS + ms(10))
    assert status(life) is TrackStatus.CONFIRMED
    found = []
    for k in range(2, 6):
        life.missed(
            scan(at_ms=10.0 * k), [0], np.array([[10.0, 0.0]]), np.array([10.0])
        )
        life.expired(START_NS + ms(10 * k))
        found.append(status(life))
    assert found[0] is TrackStatus.COASTING
    assert found[-1] is TrackStatus.TENTATIVE
    match(life, 0, scan(at_ms=60.0), HERE, MEAN, P)
    life.expired(START_NS + ms(60))
    assert status(life) is TrackStatus.CONFIRMED


def test_what_never_moves_is_not_confirmed_and_what_has_moved_stays_so() -> None:
    life = lifecycle(replace(STILL, min_travel_m=5.0))
    life.born(0, scan(), HERE)
    found = []
    for k, x_m in enumerate((10.0, 14.9, 15.1, 10.0)):
        mean = np.array([x_m, 0.0, 0.0, 0.0, 0.0])
        match(life, 0, scan(at_ms=10.0 * k), candidate(x_m, 0.0), mean, P)
        life.expired(START_NS + ms(10 * k))
        found.append(status(life))
    assert found == [
        TrackStatus.TENTATIVE,
        TrackStatus.TENTATIVE,
        TrackStatus.CONFIRMED,
        TrackStatus.CONFIRMED,
    ]


@pytest.mark.parametrize(
    "setting",
    [
        "delete_probability=0.3",
        "birth_probability=0",
        "lifetime_s=0",
        "min_travel_m=-1",
        "doubt_probability=0.95",
    ],
)
def test_rules_that_make_no_sense_are_refused(setting: str) -> None:
    with pytest.raises(CallError, match="lifecycle"):
        load(Config, None, ["lifecycle={kind: existence}", f"lifecycle.{setting}"])


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_the_tracker_confirms_what_is_seen_again_and_ends_what_is_seen_once(
    estimator: str,
) -> None:
    config = replace(
        Config(), sensors=SENSORS, lifecycle=ExistenceRules(), estimator=estimator
    )
    one = build_tracker(config)
    for k in range(6):
        items = [
            Detection(x_m=10.0 + k, y_m=0.0),
            *([Detection(x_m=40.0, y_m=9.0)] if k == 0 else []),
        ]
        now_ns = START_NS + ms(100 * k)
        one.receive(DetectionList("lidar", now_ns, now_ns, items, "map"))
        report = one.tick(now_ns)
        assert len(report.tracks) == 2 - (k > 1)
    (track,) = report.tracks
    assert (track.status, track.num_measured) == (TrackStatus.CONFIRMED, 6)
    assert 0.9 < track.score < 1.0


@pytest.mark.parametrize(
    ("is_scan", "weight"), [(True, 1.0 / (1.0 - 0.8 * 0.5)), (False, 1.0)]
)
def test_a_pair_is_weighed_against_clutter_and_new_objects(
    is_scan: bool, weight: float
) -> None:
    """P_D r N(y; 0, S), of a scan over 1 - P_D r, is just above or below clutter / (1 - birth probability)."""
    sensors = {"lidar": replace(SENSORS["lidar"], scan=is_scan)}
    life = ExistenceLifecycle(
        replace(STILL, birth_probability=0.5), sensors, (0.0, 0.0)
    )
    life.born(7, scan(), HERE)
    life.expired(START_NS)
    density = 1e-3 / (1.0 - 0.5) / (0.8 * 0.5 * weight)
    cost = -2.0 * math.log(2.0 * math.pi * density)
    zeros = np.zeros(3, dtype=np.int64)
    pairs = Pairs(
        np.arange(3), zeros, np.array([cost - 1e-6, cost + 1e-6, cost - 20.0])
    )
    assert life.likely("lidar", START_NS, [7], pairs).tolist() == [True, False, True]


@pytest.mark.parametrize("weigh", [False, True])
def test_a_new_object_does_not_inherit_a_track_that_has_been_silent_for_long(
    weigh: bool,
) -> None:
    """Three minutes after its last report the gate of an aircraft is 80 km wide."""
    tracker = build_tracker(read_config("adsb", {"lifecycle.weigh_births": weigh}))
    for at_s, y_m in [
        *((float(k), 0.0) for k in range(10)),
        (200.0, 30000.0),
        (201.0, 30000.0),
    ]:
        now_ns = START_NS + ms(1e3 * at_s)
        tracker.receive(
            DetectionList(
                "adsb", now_ns, now_ns, [Detection(x_m=200.0 * at_s, y_m=y_m)], "map"
            )
        )
        report = tracker.tick(now_ns)
    assert len(report.tracks) == 1 + weigh


@pytest.mark.parametrize("offset_m", [0.0, 5.0, 20.0, 60.0])
@pytest.mark.parametrize("more_nis", [0.0, -18.4])
def test_a_pair_is_explained_by_a_track_that_is_likelier_than_others(
    offset_m: float, more_nis: float
) -> None:
    """The gate of a newborn is wide; clutter is nearer than 20 m, unless the identities are equal."""
    P = np.diag([100.0, 100.0, 1.0, 1e4, 1.0])
    tracks = StatesAt((0,), np.array([[10.0, 0.0, 0.0, 0.0, 0.0]]), P[None])
    pairs = Pairs(np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64), np.zeros(1))
    given = candidates_of([candidate(10.0 + offset_m, 0.0)])
    density = math.exp(-0.5 * (offset_m**2 / 100.09 + more_nis)) / (
        2.0 * math.pi * 100.09
    )
    found = explained(pairs, given, tracks, np.array([0.2]), 1e-4, np.array([more_nis]))
    assert found.tolist() == [0.2 * density >= 1e-4]
    assert found[0] == (offset_m < (10.0 if more_nis == 0.0 else 50.0))
