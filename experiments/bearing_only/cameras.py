"""Positions now and then and bearings often: is a smoother consistent, and what do lasting errors of the bearings cost?

    python experiments/bearing_only/cameras.py -o out/cameras

Three cars around a moving ego, drawn from the motion model; a LiDAR gives positions and yaws at 2 Hz, 150 ms late, two
cameras bearings at 10 Hz, 60 ms late. Their errors are white, or most of their variance lasts for a second, as with
boxes around real cars. Both go through the whole tracker: births, association, gates.
"""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack import (
    CTRV,
    NS_PER_S,
    Config,
    Detection,
    DetectionList,
    EgoState,
    Message,
    SensorModel,
    TruthState,
    wrap_angle,
)
from fgtrack.config import Correlation, Mount
from fgtrack.evaluation import average, lag_metrics, match, paired
from fgtrack.sim import draw_states

MOTION = CTRV(0.01, 0.001, 0.5, 0.01)
STARTS = np.array(
    [
        [30.0, 8.0, 0.1, 10.0, 0.0],
        [45.0, -12.0, -0.1, 9.0, 0.0],
        [20.0, 30.0, 0.0, 11.0, 0.0],
    ]
)  # x, y, yaw, speed, yaw rate
EGO_MPS, PERIOD_S, LIDAR_EVERY = 10.0, 0.1, 5
LIDAR_STD_M, LIDAR_STD_RAD, BEARING_STD_RAD = 0.3, 0.1, 0.01
LASTING = Correlation(share=0.8, time_s=1.0)
MOUNTS = {"left": Mount(1.0, 0.5), "right": Mount(1.0, -0.5)}
DELAYS_S = {"lidar": 0.15, "left": 0.06, "right": 0.06}
LAG_S = 0.3
ERRORS = ("white", "lasting")
ESTIMATORS = ("ekf-replay", "smoother")


class Result(NamedTuple):
    """Of one run."""

    rmse_m: float
    """Of the present positions."""
    nees: float
    lagged_rmse_m: float
    """Of the states 0.3 s ago, or of the present ones of a filter, which has none."""
    lagged_nees: float


def drive(errors: str, duration_s: float, rng: np.random.Generator) -> list[Message]:
    """Messages of one drawn scene in receipt order."""
    return sorted(
        _sensed(errors, duration_s, rng), key=lambda message: message.receipt_ns
    )


def _sensed(
    errors: str, duration_s: float, rng: np.random.Generator
) -> Iterator[Message]:
    states = STARTS.copy()
    share = LASTING.share if errors == "lasting" else 0.0
    decay = np.exp(-PERIOD_S / LASTING.time_s)
    lasting = {name: rng.standard_normal(len(states)) for name in MOUNTS}
    for step in range(round(duration_s / PERIOD_S)):
        stamp_ns = NS_PER_S + round(step * PERIOD_S * NS_PER_S)
        ego_m = np.array([EGO_MPS * step * PERIOD_S, 0.0])
        yield EgoState(stamp_ns, stamp_ns, *ego_m.tolist(), 0.0, EGO_MPS)
        for index, (x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps) in enumerate(
            states.tolist()
        ):
            yield TruthState(
                stamp_ns,
                stamp_ns,
                index,
                x_m,
                y_m,
                wrap_angle(yaw_rad),
                speed_mps,
                yaw_rate_radps,
            )
        offsets = states[:, :2] - ego_m
        if step % LIDAR_EVERY == 0:
            std = [LIDAR_STD_M, LIDAR_STD_M, LIDAR_STD_RAD]
            seen = np.column_stack([offsets, states[:, 2]]) + std * rng.standard_normal(
                (len(states), 3)
            )
            boxes = [
                Detection(x_m=x, y_m=y, yaw_rad=wrap_angle(yaw))
                for x, y, yaw in seen.tolist()
            ]
            yield _list("lidar", stamp_ns, boxes, "ego")
        for name, mount in MOUNTS.items():
            rays = offsets - np.array([mount.x_m, mount.y_m])
            lasting[name] = decay * lasting[name] + np.sqrt(
                1.0 - decay**2
            ) * rng.standard_normal(len(states))
            noise = np.sqrt(share) * lasting[name] + np.sqrt(
                1.0 - share
            ) * rng.standard_normal(len(states))
            bearings = np.arctan2(rays[:, 1], rays[:, 0]) + BEARING_STD_RAD * noise
            yield _list(
                name,
                stamp_ns,
                [Detection(bearing_rad=value) for value in bearings.tolist()],
                "sensor",
            )
        states = draw_states(MOTION, states, PERIOD_S, rng)


def _list(
    sensor: str,
    stamp_ns: int,
    objects: list[Detection],
    frame: fgtrack.core.types.Frame,
) -> DetectionList:
    return DetectionList(
        sensor, stamp_ns, stamp_ns + round(DELAYS_S[sensor] * NS_PER_S), objects, frame
    )


def configuration(modelled: str) -> Config:
    """The tracker's, with the noise of the scene; the errors of the cameras are taken for white or lasting ones."""
    camera = SensorModel({"bearing_rad": BEARING_STD_RAD})
    correlation = LASTING if modelled == "lasting" else None
    densities = {
        name: float(np.sqrt(100.0 * getattr(MOTION, field)))
        for name, field in zip(
            ("position", "yaw", "speed", "yaw_rate"), CTRV.density_names(), strict=True
        )
    }
    base = Config.from_yaml("open_space").replace(
        {"clock.node_hz": 10, "association.gate_m": 15}
    )
    sensors = {
        name: replace(camera, mount=mount, correlation=correlation)
        for name, mount in MOUNTS.items()
    }
    lidar = SensorModel(
        {"x_m": LIDAR_STD_M, "y_m": LIDAR_STD_M, "yaw_rad": LIDAR_STD_RAD}
    )
    motion = replace(base.motion, std_per_s=densities)
    birth = replace(base.birth, speed_std_mps=15.0, yaw_rate_std_radps=0.1)
    return replace(
        base, sensors={"lidar": lidar, **sensors}, motion=motion, birth=birth
    )


def result(
    errors: str, modelled: str, name: str, duration_s: float, seed: int
) -> Result:
    """The estimator `name` on the scene of `seed` with such errors, modelled so."""
    messages = drive(errors, duration_s, np.random.default_rng(seed))
    run = fgtrack.replay(messages, replace(configuration(modelled), estimator=name))
    by_lag = {found.lag_s: found for found in lag_metrics(run, match(run))}
    present, lagged = by_lag[0.0], by_lag.get(LAG_S, by_lag[0.0])
    return Result(
        present.errors["position_m"].rmse,
        present.position_nees.mean,
        lagged.errors["position_m"].rmse,
        lagged.position_nees.mean,
    )


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the table.")] = Path(
        "out/cameras"
    ),
    runs: Annotated[int, typer.Option(help="Seeds.")] = 20,
    duration_s: Annotated[float, typer.Option(help="Length of a scene.")] = 10.0,
    jobs: int = 1,
) -> None:
    """Draw the scenes, run both estimators with both models of the errors, write cameras.csv."""
    out.mkdir(parents=True, exist_ok=True)
    cases = [
        (errors, modelled)
        for errors in ERRORS
        for modelled in ERRORS[: 1 + ERRORS.index(errors)]
    ]
    tasks = [
        delayed(result)(*case, name, duration_s, seed)
        for case in cases
        for name in ESTIMATORS
        for seed in range(runs)
    ]
    values = np.array(Parallel(n_jobs=jobs)(tasks)).reshape(
        len(cases), len(ESTIMATORS), runs, -1
    )
    with (out / "cameras.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "errors",
                "modelled_as",
                "estimator",
                *Result._fields,
                "rmse_less_ekf_percent",
            ]
        )
        for case, by_estimator in zip(cases, values, strict=True):
            for name, found in zip(ESTIMATORS, by_estimator, strict=True):
                gain = paired(
                    100.0 * np.log(found[:, 0]), 100.0 * np.log(by_estimator[0, :, 0])
                )
                columns = [
                    f"{average(column):.{3 - index % 2}f}"
                    for index, column in enumerate(found.T)
                ]
                writer.writerow(
                    [
                        *case,
                        name,
                        *columns,
                        f"{gain:.2f}" if name != ESTIMATORS[0] else "",
                    ]
                )
    print((out / "cameras.csv").read_text())


if __name__ == "__main__":
    typer.run(main)
