from itertools import permutations

import numpy as np
import pytest
from support.tracking import START_NS, candidate, match, ms, status

from fgtrack.core.types import TrackStatus
from fgtrack.karle2023.tracker_parts import PublishedLifecycle
from fgtrack.models.sensors import SensorModel
from fgtrack.tracking.lives.counters import (
    CountingLifecycle,
    LifecycleRules,
    Scan,
)

STD = {"x_m": 0.3, "y_m": 0.3}
SENSORS = {
    "near": SensorModel(std=STD, counter_init=3, counter_add=1, ages="short_range"),
    "far": SensorModel(std=STD, counter_init=5, counter_add=2, ages="long_range"),
    "both": SensorModel(std=STD, counter_init=2, counter_add=2, ages="always"),
    "blind": SensorModel(std=STD, counter_init=4, counter_add=0, ages="never"),
}
HERE = candidate(0.0, 0.0)
NOWHERE = np.zeros((3, 2))
KINDS = [CountingLifecycle, PublishedLifecycle]


def lifecycle(kind=CountingLifecycle, **rules) -> CountingLifecycle:
    return kind(LifecycleRules(**rules), SENSORS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_track_starts_with_the_counter_of_the_sensor_that_found_it(kind) -> None:
    life = lifecycle(kind)
    for track_id, sensor in enumerate(SENSORS):
        life.born(track_id, Scan(sensor, START_NS, START_NS), HERE)
    assert [life.lives[i].counter for i in range(4)] == [3, 5, 2, 4]


@pytest.mark.parametrize(
    ("ages", "near", "at_limit", "far"),
    [
        ("always", True, True, True),
        ("never", False, False, False),
        ("short_range", True, True, False),
        ("long_range", False, False, True),
    ],
)
def test_a_sensor_ages_only_what_it_is_responsible_for(
    ages, near: bool, at_limit: bool, far: bool
) -> None:
    life = CountingLifecycle(
        LifecycleRules(short_range_m=60.0), {"one": SensorModel(std=STD, ages=ages)}
    )
    for track_id in range(3):
        life.born(track_id, Scan("one", START_NS, START_NS), HERE)
    life.missed(
        Scan("one", START_NS, START_NS),
        [0, 1, 2],
        NOWHERE,
        np.array([10.0, 60.0, 60.1]),
    )
    assert [life.lives[i].misses == 1 for i in range(3)] == [near, at_limit, far]


@pytest.mark.parametrize("kind", KINDS)
def test_a_missed_track_counts_down_and_ends_at_zero(kind) -> None:
    life = lifecycle(kind)
    life.born(0, Scan("near", START_NS, START_NS), HERE)
    life.born(1, Scan("near", START_NS, START_NS), HERE)
    ranges_m = np.array([10.0, 61.0])
    assert (
        life.missed(Scan("near", START_NS, START_NS), [0, 1], NOWHERE[:2], ranges_m)
        == []
    )
    assert (
        life.missed(Scan("far", START_NS, START_NS), [0, 1], NOWHERE[:2], ranges_m)
        == []
    )
    assert [life.lives[i].counter for i in (0, 1)] == [2, 2]
    assert (
        life.missed(Scan("near", START_NS, START_NS), [0, 1], NOWHERE[:2], ranges_m)
        == []
    )
    assert life.missed(
        Scan("near", START_NS, START_NS), [0, 1], NOWHERE[:2], ranges_m
    ) == [0]
    life.forget(0)
    assert list(life.lives) == [1]


def test_only_the_clean_life_cycle_knows_sensors_that_age_always() -> None:
    clean, published = lifecycle(), lifecycle(PublishedLifecycle)
    for life in (clean, published):
        life.born(0, Scan("both", START_NS, START_NS), HERE)
        life.missed(
            Scan("both", START_NS, START_NS), [0], NOWHERE[:1], np.array([10.0])
        )
    assert (clean.lives[0].counter, published.lives[0].counter) == (1, 2)


def test_the_counter_stops_at_its_cap_but_the_published_one_may_pass_it() -> None:
    clean, published = (
        lifecycle(counter_cap=6),
        lifecycle(PublishedLifecycle, counter_cap=6),
    )
    for life in (clean, published):
        life.born(0, Scan("far", START_NS, START_NS), HERE)
        for _ in range(3):
            match(life, 0, Scan("far", START_NS, START_NS), HERE)
    assert (clean.lives[0].counter, published.lives[0].counter) == (6, 7)


def test_the_last_sight_is_the_newest_stamp_and_in_the_published_one_the_last() -> None:
    clean, published = lifecycle(), lifecycle(PublishedLifecycle)
    for life in (clean, published):
        life.born(0, Scan("near", START_NS, START_NS + ms(100)), HERE)
    assert clean.lives[0].last_seen_ns == START_NS
    assert published.lives[0].last_seen_ns == START_NS + ms(100)
    for life in (clean, published):
        match(life, 0, Scan("near", START_NS + ms(50), START_NS + ms(50)), HERE)
        match(life, 0, Scan("near", START_NS + ms(20), START_NS + ms(20)), HERE)
    assert clean.lives[0].last_seen_ns == START_NS + ms(50)
    assert published.lives[0].last_seen_ns == START_NS + ms(20)


def test_time_alone_ends_a_track_but_the_published_one_needs_a_list() -> None:
    clean, published = (
        lifecycle(forget_s=2.0),
        lifecycle(PublishedLifecycle, forget_s=2.0),
    )
    late_ns = START_NS + ms(2000) + 1
    for life in (clean, published):
        life.born(0, Scan("blind", START_NS, START_NS), HERE)
        assert life.expired(late_ns - 1) == []
    assert clean.expired(late_ns) == [0]
    assert published.expired(late_ns) == []
    assert (
        published.missed(
            Scan("blind", late_ns - 1, late_ns - 1), [0], NOWHERE[:1], np.array([10.0])
        )
        == []
    )
    assert published.missed(
        Scan("blind", late_ns, late_ns), [0], NOWHERE[:1], np.array([10.0])
    ) == [0]


@pytest.mark.parametrize("order", list(permutations(range(4))))
def test_matches_and_misses_count_in_order_of_their_stamps(
    order: tuple[int, ...],
) -> None:
    """With a cap of 6: 5 + 2 -> 6, then 5, 4, and + 2 -> 6."""
    life = lifecycle(counter_cap=6)
    life.born(0, Scan("far", START_NS, START_NS), HERE)
    seen = [("far", True), ("both", False), ("both", False), ("far", True)]
    for k in order:
        sensor, is_match = seen[k]
        scan = Scan(sensor, START_NS + ms(10 * (k + 1)), START_NS + ms(500))
        if is_match:
            match(life, 0, scan, HERE)
        else:
            assert life.missed(scan, [0], NOWHERE[:1], np.array([10.0])) == []
    assert life.lives[0].counter == 6
    life.expired(START_NS + ms(500))
    assert life.lives[0].counter == 6


def test_counts_that_no_late_list_can_precede_are_settled() -> None:
    life = lifecycle(counter_cap=6)
    life.born(0, Scan("far", START_NS, START_NS), HERE)
    for k in range(1, 50):
        stamp_ns = START_NS + ms(10 * k)
        match(life, 0, Scan("far", stamp_ns, stamp_ns), HERE)
        assert life.expired(stamp_ns) == []
        assert life.lives[0].num_changes < 20
    assert (life.lives[0].counter, life.lives[0].settled) == (6, 6)


def counted(start: int, changes: list[tuple[int, int]], most: int) -> int:
    """Counter after matches and misses, in order of their stamps, as the rules have it."""
    counter = start
    for _, decrement in sorted(changes):
        counter -= decrement
        if decrement <= 0:
            counter = min(counter, most)
        if counter <= 0:
            break
    return counter


@pytest.mark.parametrize("seed", range(5))
def test_lists_in_any_order_count_as_in_order_of_their_stamps(seed: int) -> None:
    """Of 12 tracks, more than the first arrays hold, with more late changes than they hold."""
    rng = np.random.default_rng(seed)
    life = lifecycle(counter_cap=9)
    changes: dict[int, list[tuple[int, int]]] = {}
    for track_id in range(12):
        life.born(track_id, Scan("far", START_NS, START_NS), HERE)
        changes[track_id] = []
    for _ in range(600):
        track_id, sensor = int(rng.integers(12)), str(rng.choice(["both", "far"]))
        scan = Scan(sensor, START_NS + ms(int(rng.integers(1, 40))), START_NS + ms(500))
        if rng.random() < 0.4:
            match(life, track_id, scan, HERE)
            changes[track_id].append((scan.stamp_ns, -2))
        else:
            life.missed(scan, [track_id], NOWHERE[:1], np.array([70.0]))
            changes[track_id].append((scan.stamp_ns, 1))
        for each, own in changes.items():
            assert life.lives[each].counter == counted(5, own, 9)
            assert life.lives[each].num_changes == len(own)


def test_arrays_that_cannot_grow_leave_the_counters_as_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    life = lifecycle()
    for track_id in range(8):
        life.born(track_id, Scan("far", START_NS, START_NS), HERE)
    before = life.lives

    def fail(*_: object, **__: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(np, "zeros", fail)
        with pytest.raises(MemoryError):
            life.born(8, Scan("far", START_NS, START_NS), HERE)
    assert life.lives == before
    life.born(8, Scan("far", START_NS, START_NS), HERE)
    assert list(life.lives) == [*range(9)]


def test_a_new_track_takes_the_row_of_an_ended_one_and_none_of_its_counts() -> None:
    life = lifecycle()
    for track_id in range(3):
        life.born(track_id, Scan("near", START_NS, START_NS), HERE)
        match(life, track_id, Scan("near", START_NS, START_NS), HERE)
    life.fused([0, 1, 2])
    life.forget(1)
    life.forget(1)
    life.born(3, Scan("far", START_NS, START_NS), HERE)
    life.born(4, Scan("far", START_NS, START_NS), HERE)
    lives = life.lives
    assert list(lives) == [0, 2, 3, 4]
    assert [(one.counter, one.num_placed) for one in lives.values()] == [
        (4, 2),
        (4, 2),
        (5, 1),
        (5, 1),
    ]


@pytest.mark.parametrize("comes", [True, False])
def test_a_track_waits_for_the_lists_that_could_show_it(comes: bool) -> None:
    """Of a sensor whose lists are 2.5 s late, while another one misses the object 3 times."""
    life, late_ns = lifecycle(forget_s=1.0), 2_500_000_000
    life.born(0, Scan("both", START_NS, START_NS + late_ns), HERE)

    def watermarks(at_ms: float) -> np.ndarray:
        fast_ns = START_NS + ms(at_ms)
        return np.array([fast_ns, fast_ns, fast_ns - late_ns, fast_ns])

    assert life.expired(START_NS + late_ns, watermarks(2500.0)) == []
    for k in range(1, 4):  # at 2.51, 2.52 and 2.53 s
        scan = Scan(
            "near", START_NS + late_ns + ms(10 * k), START_NS + late_ns + ms(10 * k)
        )
        assert life.missed(scan, [0], NOWHERE[:1], np.array([10.0])) == []
    assert life.lives[0].counter == 0
    if comes:
        for k in range(1, 4):
            match(
                life,
                0,
                Scan("both", START_NS + ms(700 * k), START_NS + late_ns + ms(700 * k)),
                HERE,
            )
        assert life.lives[0].counter == 2 + 3 * 2 - 3
    assert life.expired(START_NS + ms(3500), watermarks(3500.0)) == []
    ended = [
        at_ms
        for at_ms in range(3500, 7000, 10)
        if life.expired(START_NS + ms(at_ms), watermarks(at_ms))
    ]
    assert ended[0] == (2100 + 2500 + 1000 + 10 if comes else 2500 + 1000 + 10)


def test_times_are_compared_with_the_present_where_late_lists_are_not_awaited() -> None:
    life = lifecycle(forget_s=1.0, awaits_late_lists=False)
    life.born(0, Scan("both", START_NS, START_NS), HERE)
    late = np.full(4, START_NS - ms(2500))
    assert life.expired(START_NS + ms(1000), late) == []
    assert life.expired(START_NS + ms(1000) + 1, late) == [0]


def test_the_status_tells_unconfirmed_from_seen_from_missed() -> None:
    life = lifecycle(confirm_count=3)
    life.born(0, Scan("both", START_NS, START_NS), HERE)
    found = []
    for _ in range(2):
        match(life, 0, Scan("both", START_NS, START_NS), HERE)
        life.fused([0])
        found.append(status(life))
    life.missed(Scan("both", START_NS, START_NS), [0], NOWHERE[:1], np.array([1.0]))
    found.append(status(life))
    match(life, 0, Scan("both", START_NS, START_NS), HERE)
    found.append(status(life))
    assert found == [
        TrackStatus.TENTATIVE,
        TrackStatus.CONFIRMED,
        TrackStatus.COASTING,
        TrackStatus.CONFIRMED,
    ]
