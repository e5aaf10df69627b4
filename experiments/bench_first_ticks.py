"""The longest tick of a tracker that has just been made, and the tick at which it came.

    python experiments/bench_first_ticks.py                                 # every estimator, some 15 minutes
    python experiments/bench_first_ticks.py -e smoother -e ekf-replay       # two estimators
    python experiments/bench_first_ticks.py --cold                          # also with an empty cache of compiled loops

Every run is a process of its own. Its ticks have a first detection, late lists, clutter, outliers, objects in two
parts, bearings, a robust loss and soft association. Times are those of the processor, so that other processes of the
machine take nothing of them. Exits 1 where the longest tick takes more than ten medians, and more than 12 ms.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated

import typer
from bench_report import progress, short_machine, table
from bench_tracker import yardstick_us

import fgtrack
from fgtrack.sim import (
    LIDAR_DELAY,
    RADAR_DELAY,
    Clutter,
    Scenario,
    SimulatedSensor,
    TrackVehicle,
)

MOST_MEDIANS, MOST_MS = 10.0, 12.0
NODE_HZ = 50.0
SETTINGS: dict[str, object] = {
    "sensors": {
        "lidar": {"std": {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1}, "max_delay_s": 0.5},
        "radar": {
            "std": {"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.3},
            "loss": {"kind": "huber", "width": 1.5},
        },
        "camera": {"std": {"bearing_rad": 0.01}, "births": False},
    },
    "merge": {"kind": "connected", "distance_m": 2.0},
    "lifecycle": {"kind": "existence", "weigh_births": True},
    "clock.node_hz": NODE_HZ,
}
#: Soft association takes positions alone.
CASES: dict[str, dict[str, object]] = {
    "bearings": {},
    "soft": {
        "association": {"kind": "mahalanobis", "joint_from": 3},
        "ignore_sensors": ["camera", "radar"],
    },
}


@dataclass(frozen=True)
class FirstTicks:
    """Durations of one run."""

    constructed_s: float
    """Time of the processor that making the tracker takes."""
    median_ms: float
    worst_ms: float
    worst_tick: int
    """Number of the longest tick; the first one is 0."""
    worst_wall_ms: float
    """Longest tick by the clock on the wall."""
    tracks: int
    """Tracks in the last tick."""


def scene(duration_s: float) -> list[fgtrack.EgoState | fgtrack.DetectionList]:
    """Messages of a LiDAR, a RADAR and a camera among eight cars, with clutter, outliers and split objects."""
    cars = tuple(
        TrackVehicle(
            arc_m=115.0 + 6.0 * k,
            lateral_m=(-4.0, 0.0, 4.0)[k % 3],
            speed=((0.0, 30.0 + 0.5 * k), (duration_s, 34.0 - 0.5 * k)),
        )
        for k in range(8)
    )
    sensors = (
        SimulatedSensor(
            "lidar",
            {"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1},
            delay=LIDAR_DELAY,
            detection_probability=0.9,
            clutter=Clutter(0.5),
            split_probability=0.1,
        ),
        SimulatedSensor(
            "radar",
            {"range_m": 0.5, "bearing_rad": 0.02, "range_rate_mps": 0.3},
            phase_s=0.02,
            delay=RADAR_DELAY,
            detection_probability=0.8,
            outlier_probability=0.1,
        ),
        SimulatedSensor("camera", {"bearing_rad": 0.01}, rate_hz=10.0, phase_s=0.03),
    )
    ego = TrackVehicle(arc_m=100.0, speed=((0.0, 32.0),))
    scenario = Scenario(ego, cars, sensors, duration_s=duration_s)
    return [
        message
        for message in fgtrack.simulate(scenario, seed=1)
        if not isinstance(message, fgtrack.TruthState)
    ]


def measured(estimator: str, case: str, duration_s: float) -> FirstTicks:
    """Return the durations of a run in this process."""
    begun_s = time.process_time()
    tracker = fgtrack.Tracker(estimator=estimator, set={**SETTINGS, **CASES[case]})
    constructed_s = time.process_time() - begun_s
    waiting = deque(scene(duration_s))
    cpu_ms, wall_ms = list[float](), list[float]()
    now_ns = waiting[0].receipt_ns
    while waiting:
        now_ns += fgtrack.nanoseconds(1.0 / NODE_HZ)
        wall_ns, cpu_ns = time.perf_counter_ns(), time.thread_time_ns()
        while waiting and waiting[0].receipt_ns <= now_ns:
            tracker.receive(waiting.popleft())
        report = tracker.tick(now_ns)
        num_tracks = len(report.tracks)
        tracker.tracks_at(now_ns - 100_000_000)
        cpu_ms.append((time.thread_time_ns() - cpu_ns) / 1e6)
        wall_ms.append((time.perf_counter_ns() - wall_ns) / 1e6)
    if tracker.failures:
        progress(f"{estimator}: {dict(tracker.failures)}")
    worst = max(range(len(cpu_ms)), key=cpu_ms.__getitem__)
    return FirstTicks(
        constructed_s,
        median(cpu_ms),
        cpu_ms[worst],
        worst,
        max(wall_ms),
        num_tracks,
    )


def run(estimator: str, case: str, duration_s: float, cache: Path | None) -> FirstTicks:
    """Return the durations of a run in a process of its own, with compiled loops in the folder `cache`."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    if cache is not None:
        environment["NUMBA_CACHE_DIR"] = str(cache)
    command = [sys.executable, __file__, "--one", case, "-e", estimator]
    done = subprocess.run(
        [*command, "--duration-s", str(duration_s)],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return FirstTicks(**json.loads(done.stdout.splitlines()[-1]))


def row(name: str, runs: Sequence[FirstTicks]) -> tuple[tuple[str, ...], bool]:
    """Return the row of the median of some runs, and True if its longest tick is too long."""
    ratio = median(each.worst_ms / each.median_ms for each in runs)
    worst_ms = median(each.worst_ms for each in runs)
    cells = (
        name,
        f"{median(each.constructed_s for each in runs):.1f}",
        f"{median(each.median_ms for each in runs):.2f}",
        f"{worst_ms:.1f}",
        f"{ratio:.1f}",
        " ".join(str(each.worst_tick) for each in runs),
        f"{median(each.worst_wall_ms for each in runs):.0f}",
    )
    return cells, ratio > MOST_MEDIANS and worst_ms > MOST_MS


def main(
    estimators: Annotated[
        list[str] | None, typer.Option("--estimator", "-e", help="All without it.")
    ] = None,
    cold: Annotated[
        bool, typer.Option("--cold", help="Also with an empty cache: minutes more.")
    ] = False,
    runs: int = 3,
    duration_s: float = 8.0,
    one: Annotated[str, typer.Option(hidden=True)] = "",
) -> None:
    """Print the table of the longest ticks."""
    names = estimators or fgtrack.list_estimators()
    if one:
        print(json.dumps(asdict(measured(names[0], one, duration_s))))
        return
    rows, slow = [], list[str]()
    for name, case in product(names, CASES):
        for is_cold in (False, True) if cold else (False,):
            label = f"{name}, {case}" + ", cold" * is_cold
            progress(label)
            with tempfile.TemporaryDirectory() as folder:
                done = []
                for k in range(runs):
                    cache = Path(folder, str(k)) if is_cold else None
                    done.append(run(name, case, duration_s, cache))
            cells, is_slow = row(label, done)
            rows.append(cells)
            slow += [label] * is_slow
    header = ["estimator", "made [s]", "median [ms]", "longest [ms]", "medians"]
    print(short_machine([yardstick_us()]), "", sep="\n")
    print(table([*header, "at ticks", "longest, wall [ms]"], rows))
    if slow:
        raise SystemExit(f"too long: {', '.join(slow)}")


if __name__ == "__main__":
    typer.run(main)
