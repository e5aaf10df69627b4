"""Situations that lead the published tracker into its corners."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

Interval = tuple[float, float]
NEVER: Interval = (math.inf, math.inf)
SENSORS = ("lidar", "lidar_cluster", "radar")


@dataclass(frozen=True)
class Situation:
    """What a stream is like; `_p` are probabilities per message or per object."""

    duration_s: float = 1.0
    epoch_ns: int = 1_000_000_000_000
    clock: str = "node"  # node, jitter, gaps
    start: str = "anywhere"  # anywhere, closing (point of the lap), jump (of the heading), jump_rep103

    ego_speed_mps: tuple[float, ...] = (40.0, 70.0)  # one of these ...
    ego_speed_changes_mps: float = 0.0  # ... plus what a sine adds
    ego_exact_speeds_mps: tuple[
        float, ...
    ] = ()  # reported instead of the true one, by chance
    ego_noise: float = 1.0
    ego_bias: float = 0.0  # of speed, yaw rate and acceleration: reported motion and poses contradict each other
    ego_hz: float = 100.0
    ego_silent_s: Interval = NEVER
    ego_repeated_p: float = 0.0
    ego_resent_p: float = 0.0  # an earlier record once more
    ego_nan_p: float = 0.0
    pit_toggle_p: float = 0.0

    sensors: tuple[str, ...] = SENSORS
    sensors_silent_s: Interval = NEVER
    sensors_hz: float = 20.0
    delay: str = "usual"  # usual, none, mixed (of these two), tiny, future, huge
    stamp_grid_ns: int = 1
    object_stamps: bool = False
    duplicate_p: float = 0.0
    burst_p: float = 0.0  # a second, slightly younger list right behind
    empty_p: float = 0.0

    num_objects: tuple[int, int] = (1, 6)
    spread_m: float = 60.0
    objects_gone_s: Interval = NEVER
    relative_speed_mps: float = 3.0  # standard deviation over the objects
    in_pit_p: float = 0.0
    seen_p: float = 0.9
    clutter: float = 0.3
    noise_m: float = 0.3
    noise_rad: float = 0.1
    noise_mps: float = 0.3
    zero_p: float = 0.0
    nan_p: float = 0.0


TODAY_NS = 1_790_000_000_000_000_000

#: What `anything` hardly ever meets.
SITUATIONS = {
    "usual": Situation(),
    "stalled_ego": Situation(duration_s=2.6, ego_silent_s=(0.4, 2.3), ego_bias=0.3),
    "pit_lane": Situation(in_pit_p=0.6, pit_toggle_p=0.02, start="closing"),
    "vanishing_objects": Situation(
        duration_s=4.0, objects_gone_s=(1.2, 3.7), clutter=0.05
    ),
    "only_lidar": Situation(
        duration_s=3.5, sensors=("lidar",), objects_gone_s=(0.8, 3.2)
    ),
    "clock_with_gaps": Situation(
        duration_s=16.0, clock="gaps", sensors_hz=5.0, ego_hz=20.0
    ),
    "wound_up_yaw": Situation(
        duration_s=9.0,
        sensors_silent_s=(0.8, 8.5),
        sensors=("lidar",),
        ego_hz=10.0,
        ego_speed_mps=(0.0,),
        relative_speed_mps=0.0,
        noise_rad=3.0,
        num_objects=(6, 10),
        clutter=0.0,
    ),
}


def anything(rng: np.random.Generator) -> Situation:
    """Everything at once, by chance."""

    def sometimes(value: Any, otherwise: Any, p: float = 0.25) -> Any:
        return value if rng.random() < p else otherwise

    def silence() -> Interval:
        begin = float(rng.uniform(0.0, 1.5))
        return (begin, begin + float(rng.uniform(0.1, 1.5)))

    return Situation(
        duration_s=2.5,
        epoch_ns=sometimes(TODAY_NS, 1_000_000_000_000),
        clock=sometimes(str(rng.choice(["jitter", "gaps"])), "node"),
        start=str(rng.choice(["anywhere", "closing", "jump", "jump_rep103"])),
        ego_speed_mps=(0.0, 5.0, 9.9, 10.0, 30.0, 60.0, 90.0),
        ego_speed_changes_mps=float(rng.uniform(0.0, 5.0)),
        ego_exact_speeds_mps=sometimes((10.0, 0.0), ()),
        ego_noise=float(rng.choice([0.0, 1.0, 10.0])),
        ego_bias=sometimes(1.0, 0.0),
        ego_hz=float(rng.choice([10.0, 40.0, 100.0, 130.0])),
        ego_silent_s=sometimes(silence(), NEVER),
        ego_repeated_p=sometimes(0.2, 0.0),
        ego_resent_p=sometimes(0.1, 0.0),
        ego_nan_p=sometimes(0.2, 0.0),
        pit_toggle_p=sometimes(0.02, 0.0),
        sensors=tuple(
            str(name) for name in rng.permutation(SENSORS)[: rng.integers(1, 4)]
        ),
        sensors_silent_s=sometimes(silence(), NEVER),
        sensors_hz=float(rng.choice([5.0, 20.0, 33.0])),
        delay=str(rng.choice(["usual", "none", "mixed", "tiny", "future", "huge"])),
        stamp_grid_ns=sometimes(5_000_000, 1),
        object_stamps=sometimes(True, False),
        duplicate_p=sometimes(0.1, 0.0),
        burst_p=sometimes(0.2, 0.0),
        empty_p=sometimes(0.2, 0.0),
        num_objects=(0, 10),
        spread_m=float(rng.choice([20.0, 60.0, 150.0])),
        objects_gone_s=sometimes(silence(), NEVER),
        in_pit_p=sometimes(0.5, 0.0),
        seen_p=float(rng.uniform(0.5, 1.0)),
        clutter=float(rng.uniform(0.0, 1.5)),
        noise_m=float(rng.choice([0.0, 0.3, 2.0])),
        noise_rad=float(rng.choice([0.0, 0.1, 2.0])),
        zero_p=sometimes(0.1, 0.0),
        nan_p=sometimes(0.1, 0.0),
    )
