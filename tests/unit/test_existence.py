"""The existence probability of a track, and the lifecycle that it decides."""

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from support.tracking import START_NS, candidate, match, ms

from fgtrack.core.errors import CallError
from fgtrack.core.types import Detection, DetectionList, TrackStatus
from fgtrack.models.sensors import Score, SensorModel
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.load import load
from fgtrack.tracking.ego import EgoPose
from fgtrack.tracking.existence import Existence, ExistenceLifecycle, ExistenceRules
from fgtrack.tracking.lifecycle import Scan

SENSORS = {
    "lidar": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, detection_probability=0.8, clutter_per_m2=1e-3),
    "ahead": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, view_range_m=50.0, field_of_view_rad=1.0),
    "scored": SensorModel(std={"x_m": 0.3, "y_m": 0.3}, score=Score(even=3.0, scale=0.5)),
}
STILL = ExistenceRules(lifetime_s=1e9)
HERE = candidate(10.0, 0.0)
MEAN, P = np.array([10.0, 0.0, 0.0, 0.0, 0.0]), 0.01 * np.eye(5)


def lifecycle(rules: ExistenceRules = STILL) -> ExistenceLifecycle:
    return ExistenceLifecycle(rules, SENSORS, (0.0, 0.0))


def scan(sensor: str = "lidar", at_ms: float = 0.0, **more) -> Scan:
    return Scan(sensor, START_NS + ms(at_ms), START_NS + ms(at_ms), **more)


def ego(x_m: float = 0.0, y_m: float = 0.0, yaw_rad: float = 0.0) -> EgoPose:
    return EgoPose(x_m, y_m, yaw_rad, 0.0, 0.0)


def existing(lifetime_s: float, stamp_ns: int, log_odds: float) -> Existence:
    return Existence(lifetime_s, [stamp_ns], [log_odds], [log_odds], in_view_ns=stamp_ns)


def probability(life: ExistenceLifecycle, at_ms: float = 0.0) -> float:
    return life.lives[0].probability(START_NS + ms(at_ms))


def test_a_miss_and_a_match_change_the_probability_as_integrated_data_association_says() -> None:
    life = lifecycle()
    life.born(0, scan(), HERE)
    r = 0.2
    life.missed(scan(at_ms=10.0), [0], np.array([[10.0, 0.0]]), np.array([10.0]))
    r = 0.2 * r / (1.0 - 0.8 * r)
    assert probability(life, 10.0) == pytest.approx(r, rel=1e-6)
    match(life, 0, scan(at_ms=20.0), candidate(10.3, 0.0), MEAN, P)
    S = 0.09 + 0.01
    density = math.exp(-0.5 * 0.3**2 / S) / (2.0 * math.pi * S)
    delta = 0.8 - 0.8 * density / 1e-3
    r = (1.0 - delta) * r / (1.0 - delta * r)
    assert probability(life, 20.0) == pytest.approx(r, rel=1e-6)


def test_an_object_survives_as_long_as_its_lifetime_says() -> None:
    one = existing(4.0, START_NS, math.log(3.0))
    assert one.probability(START_NS) == pytest.approx(0.75)
    assert one.probability(START_NS + ms(6000)) == pytest.approx(0.75 * math.exp(-1.5))


@pytest.mark.parametrize("gap_s", [400.0, 1e7])
def test_nothing_survives_a_gap_of_many_lifetimes(gap_s: float) -> None:
    one = existing(10.0, START_NS, math.log(3.0))
    assert one.probability(START_NS + ms(1e3 * gap_s)) < 1e-9
    life = lifecycle(ExistenceRules())
    life.born(0, scan(), HERE)
    assert life.expired(START_NS + ms(1e3 * gap_s)) == [0]
    one.learn(START_NS + ms(1e3 * gap_s), 20.0)
    assert 0.0 < one.probability(START_NS + ms(1e3 * gap_s)) < 1e-4


def test_evidence_counts_at_its_own_stamp_in_whatever_order_it_arrives() -> None:
    evidence = [(300.0, -1.2), (500.0, 2.5), (900.0, -0.4), (1400.0, 1.0)]
    found = set()
    for order in permutations(evidence):
        one = existing(2.0, START_NS, 0.3)
        for at_ms, weight in order:
            one.learn(START_NS + ms(at_ms), weight)
        found.add(one.probability(START_NS + ms(1500)))
    assert len(found) == 1
    late = existing(2.0, START_NS, 0.3)
    late.learn(START_NS + ms(1400), sum(weight for _, weight in evidence))
    assert late.probability(START_NS + ms(1500)) != pytest.approx(found.pop(), abs=1e-3)


def test_what_is_forgotten_changes_nothing_and_what_is_older_counts_as_the_oldest() -> None:
    one, other = (existing(2.0, START_NS, 0.3) for _ in range(2))
    for each in (one, other):
        each.learn(START_NS + ms(300), -1.0)
        each.learn(START_NS + ms(600), 1.5)
    other.forget(START_NS + ms(650))
    assert other.stamps_ns == [START_NS + ms(600)]
    assert other.probability(START_NS + ms(900)) == one.probability(START_NS + ms(900))
    one.learn(START_NS + ms(600), 0.7)
    other.learn(START_NS + ms(100), 0.7)
    assert other.probability(START_NS + ms(900)) == one.probability(START_NS + ms(900))


@pytest.mark.parametrize(
    ("place", "counts"), [((20.0, 0.0), True), ((60.0, 0.0), False), ((10.0, 20.0), False), ((-20.0, 0.0), False)]
)
def test_a_list_says_nothing_of_what_its_sensor_cannot_see(place: tuple[float, float], counts: bool) -> None:
    life = lifecycle()
    life.born(0, scan("ahead"), HERE)
    before = probability(life)
    life.missed(scan("ahead", ego=ego()), [0], np.array([place]), np.array([20.0]))
    assert (probability(life) < before) is counts
    assert bool(life.lives[0].misses) is counts


def test_a_track_that_left_the_view_of_all_sensors_ends_although_it_is_believed() -> None:
    life = lifecycle(replace(STILL, out_of_view_s=0.5))
    life.born(0, scan("ahead"), HERE)
    for k in range(5):
        match(life, 0, scan("ahead", 10.0 * k, ego=ego()), HERE, MEAN, P)
    for at_ms in (100.0, 540.0, 541.0):
        assert life.expired(START_NS + ms(5000)) == []  # nobody looked
        ended = life.missed(scan("ahead", at_ms, ego=ego(x_m=100.0)), [0], np.array([[10.0, 0.0]]), np.array([90.0]))
        assert ended == ([0] if at_ms > 540.0 else [])


@pytest.mark.parametrize("angle_rad", np.linspace(0.0, 3.0, 5))
def test_a_position_on_an_endless_line_proves_nothing(angle_rad: float) -> None:
    """As of a RADAR whose range is good to 1e9 m."""
    life = lifecycle()
    life.born(0, scan(), HERE)
    along = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    far = candidate(10.0, 0.0)._replace(position_covariance=1e18 * np.outer(along, along) + 0.01 * np.eye(2))
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
        match(life, 0, scan("scored", 10.0, objects=seen), candidate(12.0, 0.0), MEAN, P)
        found.append(probability(life, 10.0))
    odds = [4.0 * p / (1.0 - p) for p in found]  # at birth 1 / 4
    missed = 1.0 - SENSORS["scored"].detection_probability
    assert (odds[0] - missed) / (odds[1] - missed) == pytest.approx(math.e, rel=1e-6)


def test_a_better_score_makes_an_object_more_probable() -> None:
    found = []
    for score in (2.0, None, 3.0, 5.0):
        life = lifecycle()
        life.born(0, scan("scored", objects=(Detection(x_m=10.0, y_m=0.0, score=score),)), HERE)
        found.append(probability(life))
    low, none, even, high = found
    assert low < none < high
    assert even == none == pytest.approx(0.2)
    assert high / (1.0 - high) == pytest.approx(0.25 * math.exp(4.0))


def test_a_confirmed_track_is_coasting_when_missed_tentative_when_doubted_and_confirmed_again_when_seen() -> None:
    life = lifecycle(replace(STILL, doubt_probability=0.6))
    life.born(0, scan(), HERE)
    assert life.status(0) is TrackStatus.TENTATIVE
    match(life, 0, scan(at_ms=10.0), HERE, MEAN, P)
    life.expired(START_NS + ms(10))
    assert life.status(0) is TrackStatus.CONFIRMED
    found = []
    for k in range(2, 6):
        life.missed(scan(at_ms=10.0 * k), [0], np.array([[10.0, 0.0]]), np.array([10.0]))
        life.expired(START_NS + ms(10 * k))
        found.append(life.status(0))
    assert found[0] is TrackStatus.COASTING
    assert found[-1] is TrackStatus.TENTATIVE
    match(life, 0, scan(at_ms=60.0), HERE, MEAN, P)
    life.expired(START_NS + ms(60))
    assert life.status(0) is TrackStatus.CONFIRMED


def test_what_never_moves_is_not_confirmed_and_what_has_moved_stays_so() -> None:
    life = lifecycle(replace(STILL, min_travel_m=5.0))
    life.born(0, scan(), HERE)
    found = []
    for k, x_m in enumerate((10.0, 14.9, 15.1, 10.0)):
        mean = np.array([x_m, 0.0, 0.0, 0.0, 0.0])
        match(life, 0, scan(at_ms=10.0 * k), candidate(x_m, 0.0), mean, P)
        life.expired(START_NS + ms(10 * k))
        found.append(life.status(0))
    assert found == [TrackStatus.TENTATIVE, TrackStatus.TENTATIVE, TrackStatus.CONFIRMED, TrackStatus.CONFIRMED]


@pytest.mark.parametrize(
    "setting",
    ["delete_probability=0.3", "birth_probability=0", "lifetime_s=0", "min_travel_m=-1", "doubt_probability=0.95"],
)
def test_rules_that_make_no_sense_are_refused(setting: str) -> None:
    with pytest.raises(CallError, match="lifecycle"):
        load(Config, None, ["lifecycle={kind: existence}", f"lifecycle.{setting}"])


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_the_tracker_confirms_what_is_seen_again_and_ends_what_is_seen_once(estimator: str) -> None:
    config = replace(Config(), sensors=SENSORS, lifecycle=ExistenceRules(), estimator=estimator)
    one = build_tracker(config)
    for k in range(6):
        items = [Detection(x_m=10.0 + k, y_m=0.0), *([Detection(x_m=40.0, y_m=9.0)] if k == 0 else [])]
        now_ns = START_NS + ms(100 * k)
        one.receive(DetectionList("lidar", now_ns, now_ns, items, "map"))
        report = one.tick(now_ns)
        assert len(report.tracks) == 2 - (k > 1)
    (track,) = report.tracks
    assert (track.status, track.num_measured) == (TrackStatus.CONFIRMED, 6)
