"""Time per tick with detections, beside the published implementation scaled to this machine's present state.

    make bench

The published figures are of object handling only: no prediction, no output. They belong to a machine on which the
yardstick, one covariance prediction of a 6-state filter in NumPy, takes 3.8 us. Ours are given twice: of the whole
tick, and without what a tick without detections takes as well (prediction, output).
"""

import time
from statistics import median

import numpy as np
import pytest

from fgtrack.core.types import DetectionList, TruthState
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Tick, node_ticks
from fgtrack.pipeline.config import Config, MapConfig
from fgtrack.sim.delays import LIDAR_DELAY, RADAR_DELAY
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.simulate import simulate
from fgtrack.sim.vehicles import TrackVehicle

PUBLISHED_MS = {1: 2.8, 10: 16.0, 50: 118.0}
PUBLISHED_YARDSTICK_US = 3.8
REQUIRED = 5.0


def traffic(count: int) -> list[Tick]:
    """Ticks of 5 s with `count` cars in two lanes, 12 m apart, all seen by both sensors."""
    cars = tuple(
        TrackVehicle(arc_m=120.0 + 12.0 * (i // 2), lateral_m=3.5 - 7.0 * (i % 2), speed=((0.0, 65.0), (9.0, 65.0)))
        for i in range(count)
    )
    sensors = (
        SimulatedSensor("lidar_cluster", {"x_m": 0.3, "y_m": 0.3}, max_range_m=400.0, delay=LIDAR_DELAY),
        SimulatedSensor(
            "radar", {"x_m": 0.5, "y_m": 0.5, "speed_mps": 0.2}, phase_s=0.02, max_range_m=400.0, delay=RADAR_DELAY
        ),
    )
    ego = TrackVehicle(arc_m=100.0, speed=((0.0, 65.0), (9.0, 65.0)))
    messages = simulate(Scenario(ego, cars, sensors, duration_s=5.0), np.random.default_rng(0))
    return list(node_ticks([m for m in messages if not isinstance(m, TruthState)], 50.0))


def yardstick_us() -> float:
    """Median time of the reference operation."""
    rng = np.random.default_rng(0)
    F, P, Q = (rng.normal(size=(6, 6)) for _ in range(3))
    times = []
    for _ in range(2000):
        before = time.perf_counter_ns()
        np.dot(F, P).dot(F.T) + Q
        times.append(time.perf_counter_ns() - before)
    return median(times) / 1e3


@pytest.mark.parametrize("count", PUBLISHED_MS)
def test_tick_with_detections(benchmark, count):
    config = Config(map=MapConfig(track="oval", pit="oval"))
    ticks = traffic(count)
    yards: list[float] = []
    times_ns: dict[bool, list[int]] = {True: [], False: []}  # by whether there were detections
    tracks: list[int] = []

    def run() -> None:
        tracker = build_tracker(config)
        yards.append(yardstick_us())
        for tick in ticks:
            busy = any(isinstance(message, DetectionList) for message in tick.messages)
            before = time.perf_counter_ns()
            for message in tick.messages:
                tracker.receive(message)
            report = tracker.tick(tick.now_ns)
            if report.tracks:
                times_ns[busy].append(time.perf_counter_ns() - before)
                tracks.append(len(report.tracks))

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)
    whole_ms = median(times_ns[True]) / 1e6
    handling_ms = whole_ms - median(times_ns[False]) / 1e6
    yard_us = median(yards)
    published_ms = PUBLISHED_MS[count] * yard_us / PUBLISHED_YARDSTICK_US
    benchmark.extra_info.update(
        whole_ms=whole_ms, handling_ms=handling_ms, yardstick_us=yard_us, published_ms=published_ms
    )
    print(
        f"\n{count} objects: yardstick {yard_us:.2f} us; "
        f"published {PUBLISHED_MS[count]} ms, here {published_ms:.2f} ms; "
        f"handling {handling_ms:.2f} ms, {published_ms / handling_ms:.1f} times as fast (at least {REQUIRED:.0f}); "
        f"whole tick {whole_ms:.2f} ms, {published_ms / whole_ms:.1f} times"
    )
    assert median(tracks) >= count
