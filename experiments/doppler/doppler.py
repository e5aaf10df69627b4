"""Range, a coarse bearing and range rate from a moving sensor: which estimator and start find the right state?

    python experiments/doppler/doppler.py -o out/doppler

One object drawn from the motion model. Association is known, nothing is late. Every estimator sees the same
measurements.
"""

import csv
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack import (
    CTRV,
    Estimator,
    FloatArray,
    Measurement,
    SensorPose,
    Start,
    TrackState,
    measured_position,
    measurement_model,
    wrap_angle,
)
from fgtrack.evaluation import Estimate, paired
from fgtrack.sim import draw_states

MOTION = CTRV()
STEP_S, DURATION_S, SETTLED_S = 0.1, 5.0, 1.0
DOPPLER = measurement_model(("range_m", "bearing_rad", "range_rate_mps"), MOTION)
DOPPLER_STD = np.array([0.3, np.deg2rad(2.0), 0.1])
NUM_HEADINGS = 8
FAR_M = 3.0
WINDOW_S = 2.0
#: A hypothesis is dropped once it is so much less likely than the best.
LEAST_WEIGHT = 1e-4
#: Two are the same once the squared Mahalanobis distance of their means is less than this.
SAME = 1.0


class Scene(NamedTuple):
    """What one run gives to every estimator."""

    start: Start
    hypotheses: list[Start]
    truth: FloatArray
    """After the start, shape (num, 5)."""
    measurements: list[Measurement]
    """One at each of these stamps."""


def distance_squared(y: FloatArray, S: FloatArray) -> float:
    """Squared Mahalanobis distance y' S^-1 y of a vector y (k,)."""
    return float(y @ np.linalg.solve(S, y))


def difference(one: FloatArray, other: FloatArray) -> FloatArray:
    """Difference of two states of CTRV, shape (5,), with the yaw in (-pi, pi]."""
    result = one - other
    result[2] = wrap_angle(result[2])
    return result


class Hypotheses:
    """One estimator for each of several starts, until one is left; the state is that of the likeliest.

    After measurements z_1, z_2, ... log w = sum of log N(y_k; 0, S_k), with the innovation y_k against everything
    fused before (Bar-Shalom, Li and Kirubarajan 2001, section 11.6.2, the static multiple model estimator). What is
    less likely than `LEAST_WEIGHT` times the best is dropped, and the less likely of two that are the `SAME`.
    """

    def __init__(self, estimators: list[Estimator]) -> None:
        self.weighted = [(0.0, each) for each in estimators]
        """Log-weights and estimators, the likeliest first."""

    def update(self, measurement: Measurement) -> None:
        """Fuse `measurement` with all, weigh them, and drop some."""
        if len(self.weighted) == 1:
            self.weighted[0][1].update(measurement)
            return
        fused: list[tuple[float, Estimator]] = []
        for log_weight, each in self.weighted:
            state = each.state_at(measurement.stamp_ns)
            y, H = measurement.model.linearised(
                measurement.z, state.mean, measurement.pose
            )
            S = H @ state.covariance @ H.T + measurement.R
            result = each.update(measurement)
            if result.innovation is not None:
                if result.innovation_covariance is not None:
                    y, S = result.innovation, result.innovation_covariance
                density = -0.5 * float(distance_squared(y, S) + np.linalg.slogdet(S)[1])
                fused.append((log_weight + density, each))
        ordered, self.weighted = (
            sorted(fused or self.weighted, key=lambda each: -each[0]),
            [],
        )
        for log_weight, each in ordered:
            if log_weight < ordered[0][0] + math.log(LEAST_WEIGHT):
                break
            state = each.state_at(measurement.stamp_ns)
            for index, (other, better) in enumerate(self.weighted):
                kept = better.state_at(measurement.stamp_ns)
                if (
                    distance_squared(difference(state.mean, kept.mean), kept.covariance)
                    < SAME
                ):
                    self.weighted[index] = (
                        float(np.logaddexp(other, log_weight)),
                        better,
                    )
                    break
            else:
                self.weighted.append((log_weight, each))
        self.weighted.sort(key=lambda each: -each[0])

    def state_at(self, stamp_ns: int) -> TrackState:
        """State of the likeliest hypothesis."""
        return self.weighted[0][1].state_at(stamp_ns)


def headings(start: Start, count: int) -> list[Start]:
    """`count` starts that head for equal sectors of the circle, each as uncertain as its sector is wide.

    The direction holds the sign of the speed, so the speed has the folded normal distribution.
    """
    mean, std = start.speed_mps, start.speed_std_mps
    speed_mps = std * math.sqrt(2.0 / math.pi) * math.exp(-0.5 * (mean / std) ** 2)
    speed_mps += mean * math.erf(mean / (std * math.sqrt(2.0)))
    sector_rad = math.tau / count
    turned = replace(
        start,
        yaw_std_rad=sector_rad / math.sqrt(12.0),
        speed_mps=speed_mps,
        speed_std_mps=math.sqrt(max(mean**2 + std**2 - speed_mps**2, 0.0)),
    )
    return [replace(turned, yaw_rad=wrap_angle(k * sector_rad)) for k in range(count)]


def driven(x: FloatArray, rng: np.random.Generator) -> Iterator[tuple[int, FloatArray]]:
    """Stamps and true states of an object that starts at `x` (5,)."""
    for k in range(round(DURATION_S / STEP_S)):
        if k:
            x = draw_states(MOTION, x, STEP_S, rng)
        yield round(k * STEP_S * 1e9), x


def doppler(rng: np.random.Generator) -> Scene:
    """An object of unknown heading and speed, 40 to 80 m from a sensor that drives at 15 m/s."""
    away_m, direction_rad = rng.uniform(40.0, 80.0), rng.uniform(-np.pi, np.pi)
    place_m = away_m * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    x = np.array(
        [
            *place_m,
            rng.uniform(-np.pi, np.pi),
            rng.uniform(8.0, 20.0),
            rng.uniform(-0.1, 0.1),
        ]
    )
    truth, measurements, R = [], [], np.diag(DOPPLER_STD**2)
    for stamp_ns, state in driven(x, rng):
        pose = SensorPose(15.0 * stamp_ns / 1e9, 0.0, 0.0, 15.0, 0.0)
        exact = DOPPLER.predict(state, pose)
        measurements.append(
            Measurement(
                stamp_ns, DOPPLER, exact + DOPPLER_STD * rng.standard_normal(3), R, pose
            )
        )
        truth.append(state)
    first = measurements.pop(0)
    position_m, covariance = measured_position(
        DOPPLER.components, first.z, R, first.pose
    ) or (first.z, R)
    start = Start(
        position_m=position_m, position_covariance=covariance, speed_std_mps=20.0
    )
    return Scene(
        start, headings(start, NUM_HEADINGS), np.array(truth[1:]), measurements
    )


NAMES = ("ekf-replay", "iekf-replay", "ukf-replay", "smoother-banded")
#: How the object may start.
STARTS: dict[str, dict[str, str]] = {
    "one start": {"initiation": "regression"},
    "8 headings": {},
}


def errors_m(name: str, how: str, seed: int, run: int) -> FloatArray:
    """Position error at the newest stamp, after each stamp of one run, shape (num,)."""
    scene = doppler(np.random.default_rng([seed, run]))
    options: dict[str, Any] = dict(STARTS[how])
    if name == NAMES[-1]:
        options |= {"lagged_s": (), "final": False}
    starts = scene.hypotheses if how == "8 headings" else [scene.start]
    estimator = Hypotheses(
        [
            fgtrack.estimator(name, MOTION, each, lag_s=WINDOW_S, **options)
            for each in starts
        ]
    )
    found = []
    for measurement, truth in zip(scene.measurements, scene.truth, strict=True):
        estimator.update(measurement)
        state = estimator.state_at(measurement.stamp_ns)
        found.append(float(np.hypot(*(state.mean[:2] - truth[:2]))))
    return np.array(found)


def rmse_m(errors: FloatArray) -> FloatArray:
    """RMSE of each run from `SETTLED_S` on; `errors` (runs, num), result (runs,)."""
    return np.asarray(
        np.sqrt(np.mean(errors[:, round(SETTLED_S / STEP_S) :] ** 2, axis=1))
    )


def over_runs(values: FloatArray, rng: np.random.Generator) -> Estimate:
    """Root of the mean square of `values` (runs,), and its 95 % interval by a bootstrap over the runs."""
    resampled = np.sqrt((rng.choice(values, (2000, len(values))) ** 2).mean(axis=1))
    return Estimate(
        float(np.sqrt((values**2).mean())),
        *np.quantile(resampled, [0.025, 0.975]).tolist(),
        len(values),
    )


def table(found: dict[tuple[str, str], FloatArray], rng: np.random.Generator) -> str:
    """RMSE, median, runs that end far off, and the paired difference to the smoother that starts alike, as Markdown."""
    lines = [
        f"| estimator | start | RMSE [m] | median of the runs [m] | runs above {FAR_M:g} m "
        "| less the smoother's, paired [m] |",
        "|---|---|---|---|---|---|",
    ]
    for (name, how), values in found.items():
        difference = (
            "" if name == NAMES[-1] else f"{paired(values, found[NAMES[-1], how]):+.2f}"
        )
        far = f"{int((values > FAR_M).sum())} of {len(values)}"
        cells = f"{over_runs(values, rng):.2f} | {np.median(values):.2f} | {far} | {difference}"
        lines.append(f"| {name} | {how} | {cells} |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the tables.")] = Path(
        "out/doppler"
    ),
    runs: int = 20,
    seed: int = 0,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Run every estimator with every start, write doppler.csv and doppler.md."""
    out.mkdir(parents=True, exist_ok=True)
    cases = [(name, how) for how in STARTS for name in NAMES]
    every = Parallel(n_jobs=jobs)(
        delayed(errors_m)(*case, seed, run) for case in cases for run in range(runs)
    )
    found = {
        case: rmse_m(np.array(every[k * runs : (k + 1) * runs]))
        for k, case in enumerate(cases)
    }
    with (out / "doppler.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["estimator", "start", "run", "rmse_m"])
        for (name, how), values in found.items():
            writer.writerows(
                [name, how, run, f"{value:.4f}"]
                for run, value in enumerate(values.tolist())
            )
    (out / "doppler.md").write_text(table(found, np.random.default_rng(seed)))
    print((out / "doppler.md").read_text())


if __name__ == "__main__":
    typer.run(main)
