"""Cameras on real drives: why is a smoother's past overconfident, and what cures it?

    python experiments/bearing_only/drives.py KITTI -o out/drives

KITTI is the folder of the KITTI tracking data set (docs/recordings.md). Two tables:

- `causes.csv`: every detection goes to the labelled car that it is of, for both estimators alike, so that neither
  association nor gates differ. Then the errors of the bearings are replaced, one property at a time.
- `cures.csv`: the whole tracker with `configs/kitti.yaml`, and without each part of the cure.
"""

import csv
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

import fgtrack
from fgtrack import (
    CTRV,
    Config,
    Detection,
    DetectionList,
    EgoState,
    Estimator,
    FloatArray,
    Measurement,
    SensorPose,
    Start,
    TruthState,
    estimator,
    measurement_model,
    nanoseconds,
    open_input,
    rotation,
    wrap_angle,
)
from fgtrack.evaluation import Matching, lag_metrics, match, sums_by_stamp, within_run

SEQUENCES = ("0004", "0006", "0008", "0010", "0018")
LIDAR, CAMERA = "pointrcnn_car", "rrc_car"
DELAYS_NS = {LIDAR: 150_000_000, CAMERA: 50_000_000}
LAG_S = 0.3
LIDAR_STD, BEARING_STD_RAD = np.array([0.25, 0.12, 0.06]), 0.008
FARTHEST_M, FARTHEST_RAD = 1.5, 0.06
WARM_UP, FEWEST = 5, 8
MOTION = CTRV.from_std_per_step(
    {"position": 0.3, "yaw": 0.1, "speed": 15.0, "yaw_rate": 1.0}, 100.0
)
BOX = measurement_model(("x_m", "y_m", "yaw_rad"), MOTION)
BEARING = measurement_model(("bearing_rad",), MOTION)
ESTIMATORS = {
    "ekf-replay": {"lag_s": 3.0},
    "smoother": {"lag_s": 1.0},
    "smoother, 20 steps": {"lag_s": 1.0},
}
STEPS = {
    "max_iterations": 20,
    "relinearise": {"x_m": 1e-3, "y_m": 1e-3, "yaw_rad": 1e-3, "speed_mps": 0.01},
}


class Sighting(NamedTuple):
    """A detection of a labelled car."""

    sensor: str
    stamp_ns: int
    z: FloatArray
    pose: SensorPose
    car: TruthState

    @property
    def error_rad(self) -> float:
        """Of a bearing."""
        return wrap_angle(float(self.z[0]) - _bearing_rad(self.pose, self.car))


class Case(NamedTuple):
    """What the bearings' errors are replaced by, given those of one car; None leaves out the camera."""

    errors: Callable[[FloatArray, np.random.Generator], FloatArray] | None
    white_boxes: bool = False
    """Whether the LiDAR's errors are drawn, too."""


CASES = {
    "LiDAR alone": Case(None),
    "as measured": Case(lambda errors, rng: errors),
    "without the mean of each car": Case(lambda errors, rng: errors - errors.mean()),
    "in random order": Case(lambda errors, rng: rng.permutation(errors)),
    "both": Case(lambda errors, rng: rng.permutation(errors) - errors.mean()),
    "drawn, white": Case(
        lambda errors, rng: BEARING_STD_RAD * rng.standard_normal(len(errors))
    ),
    "drawn, LiDAR's as well": Case(
        lambda errors, rng: BEARING_STD_RAD * rng.standard_normal(len(errors)), True
    ),
}


def sightings(kitti: Path, sequence: str) -> dict[int, list[Sighting]]:
    """What was seen of every labelled car, in order of time."""
    config = Config.from_yaml("kitti")
    mount, settings = (
        config.sensors[CAMERA].mount,
        replace(config.input.kitti, sequence=sequence),
    )
    ego, cars, found = None, {}, {}
    for message in open_input(kitti, replace(config.input, kitti=settings)).messages():
        if isinstance(message, TruthState) and message.ignored:
            continue
        if isinstance(message, TruthState):
            cars = {message.object_id: message} | {
                i: car for i, car in cars.items() if car.stamp_ns == message.stamp_ns
            }
        elif isinstance(message, EgoState):
            ego = message
        elif ego is not None:
            cars = {
                i: car for i, car in cars.items() if car.stamp_ns == message.stamp_ns
            }
            offset = (
                np.array([mount.x_m, mount.y_m])
                if message.sensor == CAMERA
                else np.zeros(2)
            )
            place = np.array([ego.x_m, ego.y_m]) + rotation(ego.yaw_rad) @ offset
            pose = SensorPose(float(place[0]), float(place[1]), ego.yaw_rad)
            for sighting in _of(message, pose, list(cars.values())):
                found.setdefault(sighting.car.object_id, []).append(sighting)
    return found


def _of(
    message: DetectionList, pose: SensorPose, cars: Sequence[TruthState]
) -> Iterator[Sighting]:
    for detection in message.objects if cars else ():
        z = _in_map(detection, pose)
        misses = [_miss(z, pose, car) for car in cars]
        nearest = int(np.argmin(misses))
        if misses[nearest] < 1.0:
            yield Sighting(message.sensor, message.stamp_ns, z, pose, cars[nearest])


def _in_map(detection: Detection, pose: SensorPose) -> FloatArray:
    if detection.bearing_rad is not None:
        return np.array([detection.bearing_rad])
    assert detection.x_m is not None
    assert detection.y_m is not None
    assert detection.yaw_rad is not None
    place = np.array([pose.x_m, pose.y_m]) + rotation(pose.yaw_rad) @ [
        detection.x_m,
        detection.y_m,
    ]
    return np.array([*place, wrap_angle(detection.yaw_rad + pose.yaw_rad)])


def _miss(z: FloatArray, pose: SensorPose, car: TruthState) -> float:
    """How far a detection is from `car`, 1 at the limit of what can be one of it; a yaw turned round is none."""
    if len(z) == 1:
        return abs(wrap_angle(float(z[0]) - _bearing_rad(pose, car))) / FARTHEST_RAD
    assert car.yaw_rad is not None
    turned = abs(wrap_angle(float(z[2]) - car.yaw_rad)) > 1.0
    return (
        np.inf
        if turned
        else float(np.hypot(z[0] - car.x_m, z[1] - car.y_m)) / FARTHEST_M
    )


def _bearing_rad(pose: SensorPose, car: TruthState) -> float:
    return wrap_angle(np.arctan2(car.y_m - pose.y_m, car.x_m - pose.x_m) - pose.yaw_rad)


def measured(
    seen: Sequence[Sighting], case: Case, rng: np.random.Generator
) -> list[tuple[int, Measurement]]:
    """Receipts and measurements of one car in the order of receipt, its errors replaced as in `case`."""
    bearings = [item for item in seen if item.sensor == CAMERA]
    errors = np.array([item.error_rad for item in bearings])
    replaced = iter(errors if case.errors is None else case.errors(errors, rng))
    found = []
    for item in seen:
        if item.sensor == CAMERA:
            z = np.array([_bearing_rad(item.pose, item.car) + next(replaced)])
            R, model = np.array([[BEARING_STD_RAD**2]]), BEARING
        else:
            turn, z, model = np.eye(3), item.z, BOX
            turn[:2, :2] = rotation(
                np.arctan2(z[1] - item.pose.y_m, z[0] - item.pose.x_m)
            )
            R = turn @ np.diag(LIDAR_STD**2) @ turn.T
            if case.white_boxes:
                truth = np.array([item.car.x_m, item.car.y_m, item.car.yaw_rad])
                z = truth + np.linalg.cholesky(R) @ rng.standard_normal(3)
        if case.errors is not None or item.sensor == LIDAR:
            found.append(
                (
                    item.stamp_ns + DELAYS_NS[item.sensor],
                    Measurement(item.stamp_ns, model, z, R, item.pose),
                )
            )
    return sorted(found, key=lambda pair: (pair[0], pair[1].stamp_ns))


def judged(
    name: str, seen: Sequence[Sighting], case: Case, rng: np.random.Generator
) -> list[tuple[float, ...]]:
    """Squared error and NEES of one car, of the present and 0.3 s ago, at every scan; NaN where there is none."""
    heard = measured(seen, case, rng)
    first = next(
        (k for k, (_, item) in enumerate(heard) if item.model is BOX), len(heard)
    )
    if len(heard) - first < FEWEST:
        return []
    start = heard[first][1]
    known = Start(
        stamp_ns=start.stamp_ns,
        position_m=start.z[:2],
        position_covariance=start.R[:2, :2],
        yaw_rad=float(start.z[2]),
        yaw_std_rad=float(LIDAR_STD[2]),
        speed_std_mps=8.0,
        yaw_rate_std_radps=0.2,
    )
    options = ESTIMATORS[name] | (STEPS if "20" in name else {})
    one = estimator(name.split(",")[0], MOTION, known, **options)
    cars, rest, found, fused = (
        {item.stamp_ns: item.car for item in seen},
        heard[first + 1 :],
        [],
        0,
    )
    for now_ns in sorted(cars):
        while rest and rest[0][0] <= now_ns:
            fused += one.update(rest.pop(0)[1]).innovation is not None
        if fused >= WARM_UP:
            one.advance(now_ns)
            found.append(
                (
                    *_error(one, now_ns, cars),
                    *_error(one, now_ns - nanoseconds(LAG_S), cars),
                )
            )
    return found


def _error(
    one: Estimator, stamp_ns: int, cars: dict[int, TruthState]
) -> tuple[float, float]:
    if stamp_ns not in cars or stamp_ns < one.window_ns[0]:
        return np.nan, np.nan
    state, car = one.state_at(stamp_ns), cars[stamp_ns]
    d = state.mean[:2] - [car.x_m, car.y_m]
    return float(d @ d), float(d @ np.linalg.solve(state.covariance[:2, :2], d))


def cures(config: Config) -> dict[str, Config]:
    """`configs/kitti.yaml` and what it is without each part of the cure."""
    camera, lidar = config.sensors[CAMERA], config.sensors[LIDAR]
    same_std = replace(config.input, kitti=replace(config.input.kitti, box_std=None))
    white = config.sensors | {
        CAMERA: replace(camera, correlation=None),
        LIDAR: replace(lidar, correlation=None),
    }
    return {
        "no camera": replace(config, sensors={LIDAR: lidar}, ignore_sensors=(CAMERA,)),
        "neither": replace(config, sensors=white, input=same_std),
        "std from the box": replace(config, sensors=white),
        "correlation": replace(config, input=same_std),
        "both (kitti.yaml)": config,
    }


def track_row(config: Config, source: Path) -> list[str]:
    """Errors of both estimators in the tracker, and the difference of their RMSE with its interval."""
    pairs = []
    for name in ("ekf-replay", "smoother"):
        run = fgtrack.replay(source, replace(config, estimator=name))
        pairs.append((run, match(run, config.evaluation)))
    values = [
        f"{found.errors['position_m'].rmse:.3f}"
        for run, matching in pairs
        for found in lag_metrics(run, matching)[:1]
    ]
    lags = {found.lag_s: found for found in lag_metrics(*pairs[1])}
    nees = [
        f"{lag_metrics(run, matching)[0].position_nees.mean:.2f}"
        for run, matching in pairs
    ]
    return [
        *values,
        _difference(*(matching for _, matching in pairs)),
        *nees,
        f"{lags[LAG_S].position_nees.mean:.2f}",
    ]


def _difference(ekf: Matching | None, smoother: Matching | None) -> str:
    """RMSE of the smoother less that of the filter, at the objects and ticks that both track."""
    assert ekf is not None
    assert smoother is not None
    squares = [_squares(matching) for matching in (ekf, smoother)]
    common = sorted(squares[0].keys() & squares[1].keys())
    samples = np.array([[square[key] for square in squares] for key in common])
    ticks = sums_by_stamp(np.array([key[0] for key in common]), samples)
    found = within_run(ticks, lambda S: np.sqrt(S[1] / S[2]) - np.sqrt(S[0] / S[2]))
    return f"{found:+.4f}"


def _squares(matching: Matching) -> dict[tuple[int, int], float]:
    tracks, truth = (
        matching.tracks.where(matching.paired),
        matching.truth_of(matching.paired),
    )
    errors = (tracks["x_m"] - truth[:, 0]) ** 2 + (tracks["y_m"] - truth[:, 1]) ** 2
    keys = zip(
        tracks["now_ns"].tolist(),
        matching.object_index[matching.paired].tolist(),
        strict=True,
    )
    return dict(zip(keys, errors.tolist(), strict=True))


def main(
    kitti: Annotated[Path, typer.Argument(help="Folder of the data set.")],
    out: Annotated[Path, typer.Option("-o", help="Folder for the tables.")] = Path(
        "out/drives"
    ),
    sequences: Annotated[
        str, typer.Option(help="Sequences, separated by commas.")
    ] = ",".join(SEQUENCES),
) -> None:
    """Replace the errors, run the tracker, write causes.csv and cures.csv."""
    out.mkdir(parents=True, exist_ok=True)
    with (out / "causes.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            [
                "sequence",
                "errors",
                "estimator",
                "rmse_m",
                "nees",
                f"nees_{LAG_S:g}s_ago",
            ]
        )
        for sequence in sequences.split(","):
            cars = sightings(kitti, sequence)
            for label, case in CASES.items():
                for name in ESTIMATORS:
                    rng = np.random.default_rng(1)
                    rows = np.array(
                        [
                            row
                            for seen in cars.values()
                            for row in judged(name, seen, case, rng)
                        ]
                    )
                    means = np.nanmean(rows, axis=0)
                    writer.writerow(
                        [
                            sequence,
                            label,
                            name,
                            f"{means[0] ** 0.5:.3f}",
                            f"{means[1]:.2f}",
                            f"{means[3]:.2f}",
                        ]
                    )
    with (out / "cures.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        header = [
            "rmse_ekf_m",
            "rmse_smoother_m",
            "difference_m",
            "nees_ekf",
            "nees_smoother",
            f"nees_{LAG_S:g}s_ago",
        ]
        writer.writerow(["sequence", "with", *header])
        for sequence in sequences.split(","):
            for label, config in cures(Config.from_yaml("kitti")).items():
                writer.writerow(
                    [
                        sequence,
                        label,
                        *track_row(config, kitti / "oxts" / f"{sequence}.txt"),
                    ]
                )
    print((out / "causes.csv").read_text() + "\n" + (out / "cures.csv").read_text())


if __name__ == "__main__":
    typer.run(main)
