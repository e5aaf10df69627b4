"""What a running tracker promises: stamps that never go back, threads, failures, lateness, deadlines."""

import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fgtrack.config.reading import read_config
from fgtrack.core.diagnostic import EGO
from fgtrack.core.types import (
    Detection,
    DetectionList,
    EgoState,
    TrackReport,
    TruthState,
)
from fgtrack.pipeline.live import Tracker
from fgtrack.pipeline.live_statistics import TickTiming
from fgtrack.tracking.detections import PosedBatch
from fgtrack.tracking.preprocess import Preprocess, Preprocessed

MS = 1_000_000
NOW_NS = 1_600_000_000_000_000_000
SETTINGS = {"merge.distance_m": 3.0, "clock.node_hz": 50.0}
CARS_M = (30.0, 60.0)


def tracker_of(estimator: str = "ekf-replay") -> Tracker:
    return Tracker.from_config("smoother", estimator=estimator, set=SETTINGS)


def messages(
    count: int, sensor: str = "lidar_cluster"
) -> Iterator[EgoState | DetectionList]:
    """Two standing cars, seen every 50 ms from a standing ego."""
    for k in range(count):
        at_ns = NOW_NS + 50 * MS * k
        yield EgoState(at_ns, at_ns + 5 * MS, 0.0, 0.0, 0.0, 0.0)
        objects = [Detection(x_m=x_m, y_m=1.0) for x_m in CARS_M]
        yield DetectionList(sensor, at_ns, at_ns + 40 * MS, objects)


def run(tracker: Tracker, count: int = 20) -> tuple[TrackReport, ...]:
    for message in messages(count):
        tracker.receive(message)
        tracks = tracker.tick(message.receipt_ns).tracks
    return tracks


def detections_of(tracker: Tracker) -> int:
    return sum(sum(counts.values()) for counts in tracker.counts.values())


# For which time


@pytest.mark.parametrize("estimator", ["ekf-replay", "smoother-banded"])
def test_all_tracks_can_be_asked_for_at_any_time_as_one_can(estimator: str) -> None:
    tracker = tracker_of(estimator)
    tracks = run(tracker)
    now_ns = tracks[0].stamp_ns
    for stamp_ns in (now_ns - 300 * MS, now_ns, now_ns + 1, now_ns + 500 * MS):
        found = tracker.tracks_at(stamp_ns)
        assert [track.track_id for track in found] == [
            track.track_id for track in tracks
        ]
        for track in found:
            one = tracker.state_at(track.track_id, stamp_ns)
            assert track.stamp_ns == stamp_ns
            assert (track.status, track.num_measured) == (one.status, one.num_measured)
            np.testing.assert_allclose(track.state.mean, one.state.mean, rtol=1e-12)
            np.testing.assert_allclose(track.covariance, one.covariance, rtol=1e-12)
    ahead, now = tracker.tracks_at(now_ns + 500 * MS)[0], tracker.tracks_at(now_ns)[0]
    assert np.trace(ahead.covariance[:2, :2]) > np.trace(now.covariance[:2, :2])
    assert tracker.tracks_at(now_ns - 100_000 * MS) == ()
    assert tracker_of(estimator).tracks_at(now_ns) == ()


# What cannot be used


def test_what_is_no_message_and_what_cannot_be_read_is_counted() -> None:
    tracker = tracker_of()
    run(tracker)
    before = detections_of(tracker)
    tracker.receive(TruthState(NOW_NS, NOW_NS, 1, 0.0, 0.0))  # type: ignore[arg-type]
    tracker.receive(EgoState(float("nan"), NOW_NS, 0.0, 0.0, 0.0, 0.0))  # type: ignore[arg-type]
    tracker.receive(
        DetectionList("radar", NOW_NS, NOW_NS, [Detection(x_m="near", y_m=1.0)])
    )  # type: ignore[arg-type]
    tracker.receive(
        DetectionList("radar", -(2**70), NOW_NS, [Detection(x_m=1.0, y_m=1.0)] * 3)
    )
    tracker.receive(DetectionList("radar", NOW_NS, NOW_NS, [{"x_m": 1.0}]))  # type: ignore[list-item]
    assert sum(tracker.refused.values()) == 5
    assert tracker.refused["neither ego state nor object list"] == 1
    report = tracker.tick(NOW_NS + 2_000 * MS)
    assert [row.disposition for row in report.updates] == ["invalid"] * 5
    assert detections_of(tracker) == before + 5


# Failures


def test_a_list_whose_processing_raises_ends_as_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker = tracker_of()
    run(tracker)

    def broken(*_: object) -> None:
        raise KeyError("a defect")

    with monkeypatch.context() as patch:
        patch.setattr("fgtrack.tracking.list_update.ListUpdate.fuse", broken)
        late_ns = NOW_NS + 1_000 * MS
        tracker.receive(
            DetectionList(
                "lidar_cluster", late_ns, late_ns, [Detection(x_m=30.0, y_m=1.0)] * 3
            )
        )
        report = tracker.tick(late_ns)
    assert sorted(row.disposition for row in report.updates) == ["failed"] * 3
    assert tracker.failures == {"list failed": 1}
    assert "a defect" in str(tracker.last_failure)
    assert len(report.tracks) == 2


def test_a_batch_whose_preprocessing_raises_fails_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tracker = tracker_of()
    run(tracker)
    together = Preprocess.together

    def broken(step: Preprocess, batches: Sequence[PosedBatch]) -> list[Preprocessed]:
        if any(len(each.batch.indices) == 3 for each in batches):
            raise KeyError("a defect")
        return together(step, batches)

    with monkeypatch.context() as patch:
        patch.setattr(Preprocess, "together", broken)
        late_ns = NOW_NS + 1_000 * MS
        for num in (3, 2):
            objects = [Detection(x_m=30.0 * k, y_m=1.0) for k in range(1, num + 1)]
            tracker.receive(
                DetectionList("lidar_cluster", late_ns + num, late_ns + num, objects)
            )
        report = tracker.tick(late_ns + MS)
    assert [row.disposition == "failed" for row in report.updates] == [False] * 2 + [
        True
    ] * 3
    assert tracker.failures == {"list failed": 1}


# Threads


@pytest.fixture
def eager_threads() -> Iterator[None]:
    """Threads take turns as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("eager_threads")
def test_messages_may_be_received_by_many_threads_while_others_tick_and_ask() -> None:
    tracker = tracker_of()
    over = threading.Event()
    counts = {"lidar_cluster": 50, "radar": 50, "stranger": 5000, "unknown": 5000}

    def receive(sensor: str) -> None:
        lists = [
            message
            for message in messages(counts[sensor], sensor)
            if isinstance(message, DetectionList)
        ]
        for number, message in enumerate(lists):
            tracker.receive(message)
            if number % 300 == 0:
                time.sleep(0.001)  # let a tick pass

    def ask() -> None:
        while not over.is_set():
            assert (
                len(
                    {
                        track.stamp_ns
                        for track in tracker.tracks_at(NOW_NS + time.monotonic_ns())
                    }
                )
                <= 1
            )
            assert tracker.lateness["radar"].messages <= counts["radar"]
            assert tracker.timing.ticks >= 0
            assert sum(tracker.refused.values()) <= 10_000
            assert detections_of(tracker) <= 2 * sum(counts.values())

    now_ns, ticks = NOW_NS, 0
    with ThreadPoolExecutor(8) as pool:
        receivers = [pool.submit(receive, sensor) for sensor in counts]
        asker = pool.submit(ask)
        while not all(one.done() for one in receivers):
            now_ns, ticks = now_ns + 20 * MS, ticks + 1
            tracker.tick(now_ns)
        over.set()
    tracker.tick(now_ns)
    tracker.finish()  # lists wait for an ego that never comes
    for one in (*receivers, asker):
        one.result()
    assert ticks > 10
    found = {
        sensor: sum(of_sensor.values()) for sensor, of_sensor in tracker.counts.items()
    }
    assert found == {sensor: 2 * count for sensor, count in counts.items()}
    assert [
        tracker.lateness[sensor].messages for sensor in ("lidar_cluster", "radar")
    ] == [50, 50]
    assert sum(tracker.refused.values()) == 10_000


def test_receiving_never_waits_for_a_tick() -> None:
    tracker = tracker_of()
    with tracker._turn:  # as a tick that takes long
        thread = threading.Thread(
            target=lambda: [tracker.receive(message) for message in messages(5)]
        )
        thread.start()
        thread.join(10.0)
        assert not thread.is_alive()
    run(tracker)
    assert tracker.lateness["lidar_cluster"].messages == 25


# What it says of itself


def test_it_says_how_late_every_sensor_is() -> None:
    tracker = tracker_of()
    delays_ms = np.arange(1, 1101)
    np.random.default_rng(1).shuffle(delays_ms)
    for k, delay_ms in enumerate(delays_ms.tolist()):
        stamp_ns = NOW_NS + 10 * MS * k
        tracker.receive(
            DetectionList(
                "radar",
                stamp_ns,
                stamp_ns + delay_ms * MS,
                [Detection(x_m=9.0, y_m=0.0)] * 2,
            )
        )
    tracker.tick(NOW_NS)
    tracker.tick(NOW_NS + 20_000 * MS)
    late = tracker.lateness["radar"]
    spread_s = np.quantile(delays_ms[-1000:] / 1e3, (0.5, 0.99, 1.0))
    assert late.messages == 1100
    assert (late.delay_median_s, late.delay_p99_s, late.delay_worst_s) == pytest.approx(
        tuple(spread_s)
    )
    receipts_ns = NOW_NS + MS * (10 * np.arange(1100) + delays_ms)
    assert late.silent_s == pytest.approx(
        (NOW_NS + 20_000 * MS - receipts_ns.max()) / 1e9
    )


def test_a_sensor_that_has_said_nothing_is_silent_since_the_first_tick() -> None:
    tracker = tracker_of()
    run(tracker)
    none = tracker.lateness["radar"]
    assert (none.messages, none.delay_median_s, none.delay_worst_s) == (0, None, None)
    assert none.silent_s == pytest.approx(19 * 0.05 + 0.04 - 0.005)
    ego = tracker.lateness[EGO]
    assert (ego.messages, ego.delay_median_s) == (20, pytest.approx(0.005))
    assert set(tracker.lateness) == {*tracker.config.sensors, EGO}


class Clock:
    """Stands still unless told how long ticks take."""

    def __init__(self, durations_ms: Sequence[int]) -> None:
        self._times_ns = [0]
        for duration_ms in durations_ms:
            self._times_ns += [
                self._times_ns[-1],
                self._times_ns[-1] + duration_ms * MS,
            ]
        self._times_ns.pop(0)

    def __call__(self) -> int:
        return self._times_ns.pop(0)


@pytest.mark.parametrize(
    ("period_ms", "durations_ms", "misses", "skipped"),
    [
        (20, [5, 5, 5, 5], 0, 0),
        (20, [5, 50, 5, 5], 2, 0),  # the next one begins late
        (60, [5, 50, 5, 5], 1, 6),
        (22, [5, 5, 5, 5], 0, 0),  # the host's timer is not exact
    ],
)
def test_it_counts_missed_deadlines_and_skipped_ticks(
    monkeypatch: pytest.MonkeyPatch,
    period_ms: int,
    durations_ms: list[int],
    misses: int,
    skipped: int,
) -> None:
    config = read_config("smoother", ["clock.node_hz=50"])
    tracker = Tracker(config)
    monkeypatch.setattr("fgtrack.pipeline.live.perf_counter_ns", Clock(durations_ms))
    assert tracker.timing == TickTiming(0, None, None, None, 0, 0)
    for k in range(4):
        tracker.tick(NOW_NS + k * period_ms * MS)
    timing = tracker.timing
    assert (timing.ticks, timing.deadline_misses, timing.skipped) == (
        4,
        misses,
        skipped,
    )
    assert timing.worst_s == max(durations_ms) / 1e3
    assert timing.median_s == pytest.approx(np.median(durations_ms) / 1e3)


# Clocks that are wrong


def far_ahead(kind: str, ahead_ns: int, at_ns: int) -> EgoState | DetectionList:
    """A message of a clock that is ahead: of the receipt alone (`receipt`), or of both times."""
    stamp_ns = at_ns if kind.endswith("receipt") else at_ns + ahead_ns
    if kind.startswith("ego"):
        return EgoState(stamp_ns, at_ns + ahead_ns, 10.0, 0.0, 0.0, 20.0)
    return DetectionList(
        "lidar_cluster",
        stamp_ns,
        at_ns + ahead_ns,
        [Detection(x_m=31.0, y_m=1.0)],
        frame="ego",
    )


@pytest.mark.parametrize("ahead_s", [62, 3600, 10 * 365 * 86_400])
@pytest.mark.parametrize("kind", ["ego", "ego receipt", "list", "list receipt"])
def test_one_message_of_a_clock_that_is_ahead_hides_no_later_one(
    kind: str, ahead_s: float
) -> None:
    """All later lists are fused, and a silent sensor is silent."""
    tracker = Tracker("open_space", estimator="ekf-replay")
    for k in range(40):
        at_ns = NOW_NS + k * 50 * MS
        if k == 10:
            tracker.receive(far_ahead(kind, round(ahead_s * 1e9), at_ns + 10 * MS))
        tracker.receive(EgoState(at_ns, at_ns, 1.0 * k, 0.0, 0.0, 20.0))
        position = Detection(x_m=30.0 - 0.5 * k + 0.01 * (k % 3), y_m=1.0)
        tracker.receive(
            DetectionList(
                "lidar_cluster", at_ns, at_ns + 30 * MS, [position], frame="ego"
            )
        )
        report = tracker.tick(at_ns + 30 * MS)
    assert len(report.tracks) == 1
    counts = tracker.counts["lidar_cluster"]
    fused = sum(
        counts.get(name, 0) for name in ("birth", "in_sequence", "out_of_sequence")
    )
    assert fused >= 40
    assert sum(counts.values()) == 40 + kind.startswith("list")
    assert sum(tracker.refused.values()) <= 1
    tracker.tick(at_ns + 10_030 * MS)
    for name in ("lidar_cluster", "ego"):
        assert tracker.lateness[name].silent_s == pytest.approx(10.0, abs=0.1)
        worst_s = tracker.lateness[name].delay_worst_s
        assert worst_s is not None
        assert worst_s < 0.1
