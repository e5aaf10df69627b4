"""Ticks of a tracker in dense traffic: cars 12 m apart at 65 m/s, LiDAR and RADAR at 20 Hz with the paper's delays.

As a script it measures one cell and prints it as JSON:

    python experiments/bench_tracker.py '{"label": "smoother", "config": "smoother", "count": 10}'
"""

import gc
import json
import sys
import time
from dataclasses import asdict, dataclass
from statistics import median

import numpy as np

from fgtrack import Config, DetectionList, Message, TruthState, simulate
from fgtrack.pipeline.build import build_tracker
from fgtrack.pipeline.clock import Tick, clock_ticks
from fgtrack.sim import (
    LIDAR_DELAY,
    RADAR_DELAY,
    ConstantDelay,
    Scenario,
    SimulatedSensor,
    TrackVehicle,
)

NODE_HZ = 50.0
SPEED_MPS = 65.0
_LANE_M = 7.0
_TWO_LANES = 380  # cars in two lanes of the oval; more cars drive in lanes beside it


@dataclass(frozen=True)
class Cell:
    """A tracker, the number of cars, and their delays."""

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
    """Time of the processor instead of that of the clock on the wall."""
    revises: bool = False
    """Late lists change decisions about newer lists."""

    @property
    def settings(self) -> Config:
        """The configuration."""
        own: dict[str, object] = {
            "smoother.lag_s": self.lag_s,
            "smoother.lagged_s": [],
            "smoother.final": False,
        }
        if self.count > _TWO_LANES:
            own |= {
                f"map.{side}_buffer_m": _LANE_M * _num_lanes(self.count)
                for side in ("inner", "outer")
            }
        if self.delay_s is not None:
            own |= {
                f"sensors.{name}.max_delay_s": 1.0
                for name in ("lidar_cluster", "radar")
            }
        own |= {"map.track": "oval", "map.pit": "oval"}
        if self.estimator is not None:
            own["estimator"] = self.estimator
        if self.revises:
            own |= {
                "lifecycle": {"kind": "existence"},
                "association": {"kind": "hypotheses"},
            }
        return Config.from_yaml(self.config).replace(own)


@dataclass(frozen=True)
class Measured:
    """Ticks with detections after the window has filled, in one pass over the traffic."""

    yardstick_us: float
    ticks_ms: list[float]
    detections: int
    """Number in these ticks."""
    tracks: float
    """Median number; fewer than cars, and the times are not those of so many objects."""


def traffic(count: int, duration_s: float, delay_s: float | None = None) -> list[Tick]:
    """Ticks of `scene`."""
    return list(
        clock_ticks(
            [
                m
                for m in scene(count, duration_s, delay_s)
                if not isinstance(m, TruthState)
            ],
            NODE_HZ,
        )
    )


def scene(count: int, duration_s: float, delay_s: float | None = None) -> list[Message]:
    """Messages of `scenario` in order of receipt, truth included."""
    return list(simulate(scenario(count, duration_s, delay_s), seed=0))


def scenario(
    count: int,
    duration_s: float,
    delay_s: float | None = None,
    speed_mps: float = SPEED_MPS,
) -> Scenario:
    """Scenario of `count` cars side by side in rows 12 m apart, each detected by both sensors in every list."""
    speed, lanes = ((0.0, speed_mps), (duration_s + 4.0, speed_mps)), _num_lanes(count)
    cars = tuple(
        TrackVehicle(
            arc_m=120.0 + 12.0 * (k // lanes),
            lateral_m=_LANE_M * ((lanes - 1) / 2.0 - k % lanes),
            speed=speed,
        )
        for k in range(count)
    )
    range_m = 400.0 if count <= 50 else 4000.0
    lidar, radar = (
        (LIDAR_DELAY, RADAR_DELAY) if delay_s is None else (ConstantDelay(delay_s),) * 2
    )
    sensors = (
        SimulatedSensor(
            "lidar_cluster", {"x_m": 0.3, "y_m": 0.3}, max_range_m=range_m, delay=lidar
        ),
        SimulatedSensor(
            "radar",
            {"x_m": 0.5, "y_m": 0.5, "speed_mps": 0.2},
            phase_s=0.02,
            max_range_m=range_m,
            delay=radar,
        ),
    )
    ego = TrackVehicle(arc_m=100.0, speed=speed)
    return Scenario(
        ego, cars, sensors, duration_s=duration_s, detection_origin_x_m=-1.74
    )


def _num_lanes(count: int) -> int:
    return 2 * -(-count // _TWO_LANES)


def yardstick_us() -> float:
    """Time of a 6-state covariance prediction in NumPy: the smallest of five medians, as single readings stray."""
    F, P, Q = np.random.default_rng(0).normal(size=(3, 6, 6))
    medians = []
    for _ in range(5):
        times = []
        for _ in range(400):
            before_ns = time.perf_counter_ns()
            np.dot(F, P).dot(F.T) + Q
            times.append(time.perf_counter_ns() - before_ns)
        medians.append(median(times))
    return min(medians) / 1e3


def measure(cell: Cell, ticks: list[Tick]) -> Measured:
    """Return one pass of `cell` over its traffic."""
    clock = time.thread_time_ns if cell.cpu else time.perf_counter_ns
    tracker = build_tracker(cell.settings)
    steady_ns = ticks[0].now_ns + round(
        1e9 * min(cell.lag_s + 0.5, cell.duration_s / 2.0)
    )
    yard_us, ticks_ms, tracks, detections = yardstick_us(), [], [], 0
    gc.collect()
    gc.freeze()  # a node holds no recordings, so its collections of garbage do not look through them
    for tick in ticks:
        before_ns = clock()
        for message in tick.messages:
            tracker.receive(message)
        report = tracker.tick(tick.now_ns)
        took_ms = (clock() - before_ns) / 1e6
        lists = [
            message for message in tick.messages if isinstance(message, DetectionList)
        ]
        if lists and tick.now_ns >= steady_ns:
            ticks_ms.append(took_ms)
            tracks.append(len(report.tracks))
            detections += sum(len(message.objects) for message in lists)
    gc.unfreeze()
    return Measured(min(yard_us, yardstick_us()), ticks_ms, detections, median(tracks))


if __name__ == "__main__":
    asked = Cell(**json.loads(sys.argv[1]))
    print(
        json.dumps(
            asdict(
                measure(asked, traffic(asked.count, asked.duration_s, asked.delay_s))
            )
        )
    )
