"""Objects that only a late sensor sees: each one track, confirmed, whatever the delays, rates and times configured."""

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import pytest
from support.cases import each_once

from fgtrack.config.settings import Config
from fgtrack.core.types import Detection, DetectionList, EgoState, TrackStatus
from fgtrack.pipeline.live import Tracker
from fgtrack.pipeline.replay import replay_in_memory

START_NS = 1_600_000_000_000_000_000
NODE_HZ = 20.0
RANGE_M = 30.0
CONFIRMED_S = 2.0  # from its first list on, an object of a sensor at 2 Hz is confirmed within four lists
SHARE = 0.98


def ns(time_s: float) -> int:
    return START_NS + round(time_s * 1e9)


class Watched(NamedTuple):
    """A sensor that sees a sector of its own, and the object in it, which moves away at 0.3 m/s."""

    rate_hz: float
    delay_s: float | Callable[[float], float] = 0.05
    """Or the delay by stamp."""
    ahead_s: float = 0.0
    """Advance of its stamps."""


def config(
    watched: int,
    estimator: str,
    noise_m: float = 0.3,
    reach_s: float = 4.0,
    **settings: object,
) -> Config:
    """A sensor for each sector around the ego."""
    sensors = {
        f"s{k}": {
            "std": {"x_m": noise_m, "y_m": noise_m},
            "field_of_view_rad": min(2.0, math.tau / watched),
            "view_range_m": 100.0,
            "mount": {"yaw_rad": math.remainder(math.tau * k / watched, math.tau)},
        }
        for k in range(watched)
    }
    times = (
        {"smoother.lag_s": reach_s}
        if "smoother" in estimator
        else {"filter.storage_s": reach_s}
    )
    keys = {key.replace("__", "."): value for key, value in settings.items()}
    return Config().replace(
        {
            "estimator": estimator,
            "clock.node_hz": NODE_HZ,
            "sensors": sensors,
            **times,
            **keys,
        }
    )


def place_m(k: int, watched: int, time_s: float) -> tuple[float, float]:
    """Position of object k."""
    angle_rad, range_m = math.tau * k / watched, RANGE_M + 0.3 * time_s
    return range_m * math.cos(angle_rad), range_m * math.sin(angle_rad)


def messages(
    watched: Iterable[Watched], duration_s: float, noise_m: float = 0.3, seed: int = 0
) -> list[EgoState | DetectionList]:
    """The lists of all sensors in order of receipt, and an ego that stands."""
    watched, generator = list(watched), np.random.default_rng(seed)
    made: list[EgoState | DetectionList] = [
        EgoState(ns(0.05 * k), ns(0.05 * k), 0.0, 0.0, 0.0, 0.0)
        for k in range(round(20 * duration_s) + 1)
    ]
    for k, one in enumerate(watched):
        for i in range(math.ceil(duration_s * one.rate_hz)):
            at_s = (i + 0.3 * k / len(watched)) / one.rate_hz
            late_s = one.delay_s(at_s) if callable(one.delay_s) else one.delay_s
            x_m, y_m = place_m(k, len(watched), at_s) + generator.normal(
                0.0, noise_m, 2
            )
            stamps_ns = ns(at_s + one.ahead_s), ns(at_s + late_s)
            made.append(
                DetectionList(f"s{k}", *stamps_ns, [Detection(x_m=x_m, y_m=y_m)], "map")
            )
    return sorted(
        (one for one in made if one.receipt_ns <= ns(duration_s)),
        key=lambda one: one.receipt_ns,
    )


class Found(NamedTuple):
    """What a tracker published of each object."""

    shares: list[float]
    """Share of the ticks with a track that is not tentative within half the distance to the ego."""
    ids: list[int]
    """Number of tracks that it had."""


def tracked(
    tracker: Tracker,
    watched: list[Watched],
    duration_s: float,
    noise_m: float = 0.3,
    seed: int = 0,
) -> Found:
    """Objects as published at every tick from `CONFIRMED_S` after the first list of their sensor came."""
    pending = messages(watched, duration_s, noise_m, seed)[::-1]
    hits: list[list[bool]] = [[] for _ in watched]
    ids: list[set[int]] = [set() for _ in watched]
    for tick in range(round(duration_s * NODE_HZ) + 1):
        at_s = tick / NODE_HZ
        while pending and pending[-1].receipt_ns <= ns(at_s):
            tracker.receive(pending.pop())
        report = tracker.tick(ns(at_s))
        for k, one in enumerate(watched):
            latest_s = (
                one.delay_s
                if not callable(one.delay_s)
                else max(map(one.delay_s, np.arange(0.0, 30.0, 0.05)))
            )
            if at_s < CONFIRMED_S + latest_s:
                continue
            x_m, y_m = place_m(k, len(watched), at_s)
            near = [
                track.track_id
                for track in report.tracks
                if track.status is not TrackStatus.TENTATIVE
                and math.hypot(track.x_m - x_m, track.y_m - y_m) < RANGE_M / 2.0
            ]
            hits[k].append(bool(near))
            ids[k].update(near)
    return Found([float(np.mean(each)) for each in hits], [len(each) for each in ids])


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimator", "case"),
    each_once(
        ["imm-replay", "ekf-replay", "smoother-banded", "smoother"],
        [
            ((10.0, 10.0), 0.1, 2.0),
            ((25.0, 2.0), 0.6, 0.1),
            ((2.0, 25.0), 1.2, 0.3),
            ((12.0, 5.0), 3.0, 0.3),
        ],
    ),
    ids=str,
)
def test_an_object_that_only_a_late_sensor_sees_is_one_confirmed_track(
    estimator: str, case: tuple[tuple[float, float], float, float]
) -> None:
    """A case has the rates of both sensors in Hz, the delay of the second, and the noise in m."""
    rates_hz, delay_s, noise_m = case
    watched = [Watched(rates_hz[0]), Watched(rates_hz[1], delay_s)]
    tracker = Tracker(config(2, estimator, noise_m))
    found = tracked(tracker, watched, delay_s + 7.0, noise_m)
    assert min(found.shares) >= SHARE
    assert found.ids == [1, 1]


@pytest.mark.long
@pytest.mark.parametrize(
    "estimator",
    ["ekf-replay", pytest.param("smoother-banded", marks=pytest.mark.slow)],
)
def test_so_is_each_object_of_four_sensors_with_their_own_delays(
    estimator: str,
) -> None:
    watched = [Watched(10.0), Watched(5.0, 0.7), Watched(2.0, 2.5), Watched(25.0, 0.2)]
    found = tracked(Tracker(config(4, estimator)), watched, 8.0, seed=3)
    assert min(found.shares) >= SHARE
    assert found.ids == [1] * 4


@pytest.mark.long
@pytest.mark.parametrize(
    "settings",
    [
        {"lifecycle__out_of_view_s": 0.1},
        {"lifecycle__hidden_s": 0.2},
        {"lifecycle__lifetime_s": 2.0},
        {"lifecycle__memory_s": 0.3},
        {"lifecycle": {"kind": "counting", "forget_s": 0.3}},
        {
            "lifecycle": {
                "kind": "counting",
                "forget_s": 1.0,
                "suppress_births_near_newer_tracks": True,
            }
        },
    ],
    ids=str,
)
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_no_configured_time_of_the_lifecycle_is_too_short_for_a_delay(
    settings: dict[str, object], estimator: str
) -> None:
    watched = [Watched(10.0), Watched(8.0, 2.3)]
    found = tracked(Tracker(config(2, estimator, **settings)), watched, 7.0, seed=1)
    assert min(found.shares) >= SHARE
    assert found.ids == [1, 1]


@pytest.mark.parametrize("kind", ["existence", "counting"])
@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_a_single_slow_sensor_keeps_its_tracks(kind: str, estimator: str) -> None:
    one = config(1, estimator, lifecycle={"kind": kind})
    found = tracked(Tracker(one), [Watched(4.0, 2.9)], 8.0)
    assert found == Found([1.0], [1])


@pytest.mark.parametrize(
    "delay_s",
    [
        lambda at_s: 0.15 + 1.4 * (at_s % 3.0 < 0.4),
        lambda at_s: math.ceil((at_s + 0.01) / 1.3) * 1.3 - at_s,
    ],
    ids=["stalls", "queue"],
)
@pytest.mark.parametrize("rate_hz", [4.0, 20.0])
def test_a_sensor_whose_lists_come_in_bursts_keeps_its_tracks(
    delay_s: Callable[[float], float], rate_hz: float
) -> None:
    found = tracked(
        Tracker(config(2, "ekf-replay")),
        [Watched(10.0), Watched(rate_hz, delay_s)],
        10.0,
    )
    assert min(found.shares) >= SHARE
    assert found.ids == [1, 1]


def test_a_longer_delay_breaks_a_track_at_most_once() -> None:
    watched = [Watched(10.0), Watched(10.0, lambda at_s: 0.1 if at_s < 4.0 else 1.6)]
    assert tracked(Tracker(config(2, "ekf-replay")), watched, 10.0).ids[1] <= 2


def test_one_list_that_is_an_hour_late_keeps_no_track() -> None:
    """The second sensor stops 4 s after the start; its track ends as without the late list."""
    ends = []
    for late_s in (0.2, 3600.0):
        tracker = Tracker(config(2, "ekf-replay"))
        pending = messages([Watched(10.0), Watched(10.0, 0.2)], 8.0)
        pending = [
            one
            for one in pending
            if getattr(one, "sensor", "s0") == "s0" or one.stamp_ns < ns(4.0)
        ]
        stale = DetectionList("s1", ns(2.2 - late_s), ns(2.2), [], "map")
        pending = sorted([*pending, stale], key=lambda one: one.receipt_ns)[::-1]
        for tick in range(round(8.0 * NODE_HZ)):
            while pending and pending[-1].receipt_ns <= ns(tick / NODE_HZ):
                tracker.receive(pending.pop())
            report = tracker.tick(ns(tick / NODE_HZ))
            behind = any(track.x_m < 0.0 for track in report.tracks)
            if tick > 3 * NODE_HZ and not behind:
                ends.append(tick / NODE_HZ)
                break
    assert ends[0] == ends[1]
    assert 4.4 < ends[0] < 5.0  # half a second out of view, and the usual delay


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
@pytest.mark.parametrize("delay_s", [0.3, 2.2])
def test_an_object_that_is_gone_leaves_no_track_after_the_usual_delay(
    estimator: str, delay_s: float
) -> None:
    """The sensors go on, and show nothing."""
    tracker, gone_s = Tracker(config(2, estimator)), 3.0
    pending = messages([Watched(10.0), Watched(10.0, delay_s)], 12.0)
    pending = [
        DetectionList(one.sensor, one.stamp_ns, one.receipt_ns, [], "map")
        if isinstance(one, DetectionList) and one.stamp_ns >= ns(gone_s)
        else one
        for one in pending
    ][::-1]
    last_s = [0.0, 0.0]
    for tick in range(round(12.0 * NODE_HZ)):
        at_s = tick / NODE_HZ
        while pending and pending[-1].receipt_ns <= ns(at_s):
            tracker.receive(pending.pop())
        for track in tracker.tick(ns(at_s)).tracks:
            last_s[track.x_m < 0.0] = at_s
    assert gone_s + 0.1 < last_s[0] < gone_s + 2.5
    assert gone_s + delay_s < last_s[1] < last_s[0] + delay_s + 0.2


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimator", "case"),
    each_once(
        ["ekf-replay", "imm-replay", "smoother-banded", "smoother"],
        [
            ((10.0, 10.0), (0.2, 0.0), 0.3),
            ((2.0, 2.0), (0.45, 0.0), 0.1),
            ((25.0, 5.0), (0.0, 0.95), 1.0),
            ((4.0, 4.0, 4.0, 4.0), (0.0, 0.3, 0.9, 0.1), 0.3),
        ],
    ),
    ids=str,
)
def test_a_clock_that_is_ahead_swaps_no_objects(
    estimator: str, case: tuple[tuple[float, ...], tuple[float, ...], float]
) -> None:
    rates_hz, ahead_s, noise_m = case
    """A first detection of one object, with an unknown velocity, does not take those of another, 60 m away."""
    watched = [
        Watched(rate_hz, 0.06, ahead)
        for rate_hz, ahead in zip(rates_hz, ahead_s, strict=True)
    ]
    found = tracked(
        Tracker(config(len(watched), estimator, noise_m)), watched, 6.0, noise_m, seed=2
    )
    assert min(found.shares) >= SHARE
    assert found.ids == [1] * len(watched)


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_nor_do_sensors_that_take_turns(estimator: str) -> None:
    """At 2 Hz each, a quarter of a second apart: no list is late, and none ahead."""
    watched = [Watched(2.0, 0.05), Watched(2.0, 0.05, 0.1)]
    found = tracked(Tracker(config(2, estimator)), watched, 7.0, seed=4)
    assert found == Found([1.0, 1.0], [1, 1])


@pytest.mark.parametrize(
    ("estimator", "key"),
    [("ekf-replay", "filter.storage_s"), ("smoother", "smoother.lag_s")],
)
def test_an_estimator_with_a_shorter_memory_than_a_delay_warns_once(
    estimator: str, key: str
) -> None:
    watched = [Watched(10.0), Watched(10.0, lambda at_s: 0.1 if at_s < 2.0 else 2.6)]
    for reach_s, is_warned in ((1.5, True), (3.0, False)):
        tracker = Tracker(
            config(
                2,
                estimator,
                reach_s=reach_s,
                smoother__ring_s=0.0,
                smoother__late="drop",
            )
        )
        for message in messages(watched, 6.0):
            tracker.receive(message)
            tracker.tick(message.receipt_ns)
        found = tracker.warnings
        assert found == tracker.warnings
        assert [
            (f"{key} ({reach_s:g} s)" in one, "s1: " in one, "2.6 s" in one)
            for one in found
        ] == ([(True,) * 3] * is_warned)
        assert bool(tracker.counts["s1"].get("too_old")) is is_warned


def test_a_live_tracker_and_a_replay_await_the_same_lists() -> None:
    watched = [Watched(10.0), Watched(5.0, 1.1), Watched(2.0, 2.0)]
    configured, made = config(3, "ekf-replay"), messages(watched, 6.0, seed=5)
    run, tracker, rows = replay_in_memory(made, configured), Tracker(configured), []
    pending = made[::-1]
    for now_ns in run.tables["timing"]["now_ns"].tolist():
        while pending and pending[-1].receipt_ns <= now_ns:
            tracker.receive(pending.pop())
        rows += [
            (now_ns, one.track_id, one.x_m, one.score)
            for one in tracker.tick(now_ns).tracks
        ]
    tracks = run.tables["tracks"]
    assert len(rows) > 100
    assert rows == list(
        zip(
            *(tracks[name].tolist() for name in ("now_ns", "track_id", "x_m", "score")),
            strict=True,
        )
    )
