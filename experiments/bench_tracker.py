"""Time of whole ticks with detections, beside the published implementation by its yardstick.

`count` cars drive in two lanes, 12 m apart, at 65 m/s, all seen by the paper's sensors: LiDAR and RADAR at 20 Hz, with
their delays. The published implementation of Karle et al. 2023 was measured on this traffic (object handling only, no
prediction, no output); its times are given per microsecond of a yardstick, one covariance prediction of a 6-state
filter in NumPy, so that they hold on other machines, too.

As a script it measures one cell and prints it as JSON, so that an older checkout can be measured by the same code:

    PYTHONPATH=CHECKOUT python experiments/bench_tracker.py '{"label": "smoother", "config": "smoother", "count": 10}'
"""

import gc
import json
import resource
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median

import numpy as np

from fgtrack.core.types import DetectionList, Message, TruthState
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Tick, clock_ticks
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config
from fgtrack.sim.delays import LIDAR_DELAY, RADAR_DELAY, ConstantDelay
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.sensor import SimulatedSensor
from fgtrack.sim.simulate import simulate
from fgtrack.sim.vehicles import TrackVehicle

PUBLISHED_MS_PER_US = {1: 0.56, 10: 3.45, 50: 20.4}
"""Median tick with detections of the published implementation in ms per microsecond of yardstick, by cars; its 99 %
quantile is 2.1 times as long."""

NODE_HZ = 50.0
Clock = Callable[[], int]
"""Gives nanoseconds."""

SPEED_MPS = 65.0
_MB = 1 << 20


@dataclass(frozen=True)
class Cell:
    """What is measured."""

    label: str
    """Row of the table."""
    config: str
    """Shipped configuration."""
    count: int
    """Cars."""
    estimator: str | None = None
    """None for that of the configuration."""
    lag_s: float = 1.0
    delay_s: float | None = None
    """Constant delay of both sensors; None for the paper's delays."""
    duration_s: float = 8.0
    cpu: bool = False
    """Whether time of the processor counts instead of that of the wall, for a machine that has other work, too."""

    @property
    def settings(self) -> Config:
        """The configuration."""
        own: dict[str, object] = {"smoother.lag_s": self.lag_s, "smoother.lagged_s": [], "smoother.final": False}
        if self.delay_s is not None:
            own |= {f"sensors.{name}.max_delay_s": 1.0 for name in ("lidar_cluster", "radar")}
        given = [f"{key}={json.dumps(value)}" for key, value in own.items()]
        return read_config(self.config, given, track_map="oval", pit_map="oval", estimator=self.estimator)


@dataclass(frozen=True)
class Measured:
    """Ticks with detections after the window has filled, in one pass over the traffic."""

    yardstick_us: float
    ticks_ms: list[float]
    per_detection_us: float
    """Time of these ticks over the detections in them."""
    largest_ms: float
    """The longest tick of all, the births included."""
    tracks: float
    """Median number of tracks; at least as many as there are cars, or the time is not that of so many objects."""
    memory_mb: float
    """How far the peak of the process rose during the pass; says something only in a fresh process."""

    @property
    def median_ms(self) -> float:
        """Median of the ticks."""
        return median(self.ticks_ms)

    @property
    def p99_ms(self) -> float:
        """99 % quantile of the ticks."""
        return float(np.quantile(self.ticks_ms, 0.99))


def traffic(count: int, duration_s: float = 5.0, delay_s: float | None = None) -> list[Tick]:
    """Ticks of `duration_s` with `count` cars in two lanes, 12 m apart, all seen by both sensors."""
    return list(clock_ticks([m for m in scene(count, duration_s, delay_s) if not isinstance(m, TruthState)], NODE_HZ))


def scene(count: int, duration_s: float, delay_s: float | None = None) -> list[Message]:
    """The messages of `traffic`, truth included, in order of receipt."""
    return simulate(scenario(count, duration_s, delay_s), np.random.default_rng(0))


def scenario(count: int, duration_s: float, delay_s: float | None = None, speed_mps: float = SPEED_MPS) -> Scenario:
    """What `traffic` is drawn from."""
    speed = ((0.0, speed_mps), (duration_s + 4.0, speed_mps))
    cars = tuple(
        TrackVehicle(arc_m=120.0 + 12.0 * (i // 2), lateral_m=3.5 - 7.0 * (i % 2), speed=speed) for i in range(count)
    )
    range_m = 400.0 if count <= 50 else 4000.0
    lidar, radar = (LIDAR_DELAY, RADAR_DELAY) if delay_s is None else (ConstantDelay(delay_s),) * 2
    sensors = (
        SimulatedSensor("lidar_cluster", {"x_m": 0.3, "y_m": 0.3}, max_range_m=range_m, delay=lidar),
        SimulatedSensor(
            "radar", {"x_m": 0.5, "y_m": 0.5, "speed_mps": 0.2}, phase_s=0.02, max_range_m=range_m, delay=radar
        ),
    )
    ego = TrackVehicle(arc_m=100.0, speed=speed)
    return Scenario(ego, cars, sensors, duration_s=duration_s, detection_origin_x_m=-1.74)


def yardstick_us(clock: Clock = time.perf_counter_ns, at_once: int = 1) -> float:
    """Time of the reference operation: the smallest of five medians, as single readings stray.

    A clock that takes long to read itself reads the time of several operations `at_once`.
    """
    rng = np.random.default_rng(0)
    F, P, Q = (rng.normal(size=(6, 6)) for _ in range(3))
    medians = []
    for _ in range(5):
        times = []
        for _ in range(400 // at_once):
            before = clock()
            for _ in range(at_once):
                np.dot(F, P).dot(F.T) + Q
            times.append(clock() - before)
        medians.append(median(times))
    return min(medians) / 1e3 / at_once


def measure(cell: Cell, ticks: list[Tick] | None = None) -> Measured:
    """One pass of `cell` over its traffic; `ticks` where they are there already."""
    clock, at_once = (time.thread_time_ns, 40) if cell.cpu else (time.perf_counter_ns, 1)
    ticks = ticks or traffic(cell.count, cell.duration_s, cell.delay_s)
    gc.collect()
    gc.freeze()  # a node holds no recordings, so its collections of garbage do not look through them
    tracker = build_tracker(cell.settings)
    steady_ns = ticks[0].now_ns + round(1e9 * min(cell.lag_s + 0.5, cell.duration_s / 2.0))
    _forget_peak()
    before_mb, yard_us = _peak_mb(), yardstick_us(clock, at_once)
    every_ms, steady_ms, tracks, detections = [], [], [], 0
    for tick in ticks:
        lists = [message for message in tick.messages if isinstance(message, DetectionList)]
        before_ns = clock()
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        took_ms = (clock() - before_ns) / 1e6
        if lists and report.tracks:
            every_ms.append(took_ms)
            if tick.now_ns >= steady_ns:
                steady_ms.append(took_ms)
                tracks.append(len(report.tracks))
                detections += sum(len(message.objects) for message in lists)
    gc.unfreeze()
    return Measured(
        yardstick_us=min(yard_us, yardstick_us(clock, at_once)),
        ticks_ms=steady_ms,
        per_detection_us=1e3 * sum(steady_ms) / detections,
        largest_ms=max(every_ms),
        tracks=median(tracks),
        memory_mb=_peak_mb() - before_mb,
    )


def _forget_peak() -> None:
    """Where the system can, let the peak begin anew: imports and the making of traffic need more than a tracker."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_mb() -> float:
    """Largest memory of this process so far, or since `_forget_peak`."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (_MB if sys.platform == "darwin" else 1024)


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    known = {field.name for field in fields(Cell)}
    print(json.dumps(asdict(measure(Cell(**{key: given[key] for key in given if key in known})))))
