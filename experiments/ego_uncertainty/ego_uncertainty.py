"""What does it cost to ignore the error of the ego?

    python experiments/ego_uncertainty/ego_uncertainty.py -o out/ego_uncertainty

The scene. An ego drives straight on at 20 m/s; objects start on a circle of 60 m around it, drive the same way and move
as the motion model of the tracker says. A LiDAR (0.3 m along, 0.1 m across the line of sight, heading 0.1 rad, 10 Hz,
50 ms late) sees all of them. The ego's own yaw has an error of 0.01 rad, 0.6 m at 60 m, and its position one of 0.1 m:
new in every message (time 0), or lasting, a first-order Gauss-Markov process with that correlation time. It says so in
the covariance of its messages. The low-pass of the ego is off, so that these are the errors that the tracker meets.

`ego.uncertainty` is `none` or `independent`, with the same recordings: differences are paired. Errors and
NEES (expected 2) are those of the present positions, from 2 s on.
"""

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from joblib import Parallel, delayed

from fgtrack import (
    Config,
    EgoState,
    Message,
    SensorModel,
    nanoseconds,
    replay,
    seconds,
    simulate,
)
from fgtrack.config import Birth, EgoConfig, MotionConfig
from fgtrack.evaluation import average, match, paired, position_nees
from fgtrack.sim import (
    ConstantDelay,
    DrawnVehicle,
    EgoMessages,
    Scenario,
    SimulatedSensor,
)

MODES = ("none", "independent")
EXACT = "no error"
INTERVAL = ("mean", "low", "high")
COUNTS, TIMES_S = (3, 8), (0.0, 1.0)
RANGE_M, SPEED_MPS = 60.0, 20.0
YAW_STD_RAD, POSITION_STD_M = 0.01, 0.1
ORIGIN_M = -1.74
"""Of the detections, ahead of the ego reference point: the rear axle."""
STD = {"x_m": 0.3, "y_m": 0.1, "yaw_rad": 0.1}
MOTION = MotionConfig(
    kind="ctrv", std_per_s={"position": 0.1, "yaw": 0.05, "speed": 0.5, "yaw_rate": 0.1}
)
SETTLED_S = 2.0


@dataclass(frozen=True)
class Result:
    """Of one drive."""

    squared_m2: float
    """Mean squared error of the positions."""
    nees: float
    """Mean NEES of the positions."""


def scenario(count: int, duration_s: float) -> Scenario:
    """The ego and `count` objects around it; what the ego says of itself is exact."""
    motion = MOTION.model()
    still = replace(
        motion, **dict.fromkeys(motion.density_names(), 0.0), resting_yaw_rad2ps=0.0
    )
    angles = 2.0 * np.pi * np.arange(count) / count + 0.3
    places = RANGE_M * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    exact = dict.fromkeys(
        (
            "position_std_m",
            "yaw_std_rad",
            "speed_std_mps",
            "yaw_rate_std_radps",
            "accel_std_mps2",
        ),
        0.0,
    )
    sensor = SimulatedSensor(
        "lidar", STD, rate_hz=10.0, max_range_m=1000.0, delay=ConstantDelay(0.05)
    )
    return Scenario(
        ego=DrawnVehicle(0.0, 0.0, 0.0, SPEED_MPS, motion=still),
        opponents=tuple(
            DrawnVehicle(x_m, y_m, 0.0, SPEED_MPS, motion=motion)
            for x_m, y_m in places.tolist()
        ),
        sensors=(sensor,),
        map=None,
        duration_s=duration_s,
        ego_messages=EgoMessages(**exact),
        detection_origin_x_m=ORIGIN_M,
    )


def erring(
    messages: Sequence[Message], time_s: float, rng: np.random.Generator
) -> Iterator[Message]:
    """`messages` with errors of the ego's position and yaw that last for `time_s`, and their covariance."""
    std = np.array([POSITION_STD_M, POSITION_STD_M, YAW_STD_RAD])
    covariance = tuple(np.diag([*(std**2).tolist(), 0.0, 0.0]).ravel().tolist())
    error, last_ns = std * rng.standard_normal(3), None
    for message in messages:
        if not isinstance(message, EgoState):
            yield message
            continue
        if last_ns is not None:
            kept = (
                np.exp(-seconds(message.stamp_ns - last_ns) / time_s) if time_s else 0.0
            )
            error = kept * error + np.sqrt(1.0 - kept**2) * std * rng.standard_normal(3)
        last_ns = message.stamp_ns
        x_m, y_m, yaw_rad = (
            np.array([message.x_m, message.y_m, message.yaw_rad]) + error
        ).tolist()
        yield replace(message, x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, covariance=covariance)


def result(messages: Sequence[Message], mode: str, estimator: str) -> Result:
    """One drive, tracked with `ego.uncertainty` of `mode`."""
    config = replace(
        Config.from_yaml("karle2023"),
        estimator=estimator,
        sensors={"lidar": SensorModel(std=STD)},
        motion=MOTION,
        ego=EgoConfig(detection_origin_x_m=ORIGIN_M, uncertainty=mode),
        birth=Birth(
            ego_speed_factor=1.0, speed_std_mps=3.0, yaw_rate_std_radps=math.sqrt(0.3)
        ),
    )
    matching = match(replay(iter(messages), config))
    tracks, truth = (
        matching.tracks.where(matching.paired),
        matching.truth_of(matching.paired),
    )
    settled = tracks["stamp_ns"] >= matching.tracks["stamp_ns"].min() + nanoseconds(
        SETTLED_S
    )
    squared_m2 = (tracks["x_m"] - truth[:, 0]) ** 2 + (tracks["y_m"] - truth[:, 1]) ** 2
    return Result(
        float(squared_m2[settled].mean()),
        float(position_nees(matching)[settled].mean()),
    )


def drive(
    count: int, time_s: float, seed: int, duration_s: float, estimator: str
) -> dict[str, Result]:
    """One recording in every mode, and with an ego that has no error."""
    rng = np.random.default_rng([seed, count])
    exact = list(simulate(scenario(count, duration_s), seed=rng))
    messages = list(erring(exact, time_s, rng))
    return {mode: result(messages, mode, estimator) for mode in MODES} | {
        EXACT: result(exact, "none", estimator)
    }


Row = dict[str, str | float]


def rows(
    count: int, time_s: float, found: Sequence[dict[str, Result]]
) -> Iterator[Row]:
    """A row for each mode: RMSE, its change to `independent` in per cent, NEES; with 95 % intervals over the drives."""
    for mode in (*MODES, EXACT):
        own, other = (
            [one[each].squared_m2 for one in found] for each in (mode, "independent")
        )
        nees = average([one[mode].nees for one in found])
        change = paired(0.5 * np.log(own), 0.5 * np.log(other))
        yield {
            "objects": count,
            "lasts_s": time_s,
            "uncertainty": mode,
            "rmse_m": float(np.sqrt(np.mean(own))),
            **{
                f"change_{name}": 100.0 * float(np.expm1(getattr(change, name)))
                for name in INTERVAL
            },
            **{f"nees_{name}": getattr(nees, name) for name in INTERVAL},
        }


def main(
    out: Annotated[
        Path, typer.Option("-o", "--out", help="Folder for the table.")
    ] = Path("out/ego_uncertainty"),
    runs: Annotated[int, typer.Option(help="Drives for each setting.")] = 20,
    duration_s: Annotated[
        float, typer.Option(help="Length of a drive, above 2 s.")
    ] = 6.0,
    estimator: Annotated[
        str, typer.Option("-e", "--estimator", help="Estimator of all tracks.")
    ] = "ekf-replay",
    jobs: Annotated[int, typer.Option(help="Drives at a time.")] = 1,
) -> None:
    """Track the same drives in every mode, write ego_uncertainty.csv."""
    table: list[Row] = []
    for count in COUNTS:
        for time_s in TIMES_S:
            found = Parallel(n_jobs=jobs)(
                delayed(drive)(count, time_s, seed, duration_s, estimator)
                for seed in range(runs)
            )
            table += rows(count, time_s, found)
    out.mkdir(parents=True, exist_ok=True)
    with (out / "ego_uncertainty.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table[0])
        writer.writerows(
            [v if isinstance(v, str) else f"{v:.4g}" for v in row.values()]
            for row in table
        )
    print((out / "ego_uncertainty.csv").read_text(), end="")


if __name__ == "__main__":
    typer.run(main)
