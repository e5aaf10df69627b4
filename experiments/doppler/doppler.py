"""Range, a coarse bearing and range rate from a moving sensor, and ranges from two points: who finds the right state?

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

import matplotlib.pyplot as plt
import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.linalg import congruence, identity, mahalanobis_squared, psd_solve, symmetrise
from fgtrack.core.types import FloatArray, TrackState
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.filters.propagation import wrapped
from fgtrack.evaluation.intervals import Estimate, paired
from fgtrack.models.measurement import SensorPose, measured_position, measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.sim.vehicles import drawn

MOTION = CTRV()
STEP_S, DURATION_S, SETTLED_S = 0.1, 5.0, 1.0
DOPPLER = measurement_model(("range_m", "bearing_rad", "range_rate_mps"), MOTION)
DOPPLER_STD = np.array([0.3, np.deg2rad(2.0), 0.1])
NUM_HEADINGS = 8
RANGE_STD_M, ANCHORS_M = 0.3, ((0.0, 0.0), (20.0, 0.0))
FAR_M = 3.0
WINDOW_S = 2.0
#: A hypothesis is dropped once it is so much less likely than the best.
LEAST_WEIGHT = 1e-4
#: Two are the same once the squared Mahalanobis distance of their means is less than this.
SAME = 1.0


class Scene(NamedTuple):
    """What one run gives to every estimator."""

    start: Start
    first: list[Measurement]
    """At the stamp of the start; the hypotheses are made of them already."""
    hypotheses: list[Start]
    truth: FloatArray
    """After the start, shape (num, 5)."""
    measurements: list[list[Measurement]]
    """Those of each of these stamps."""


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
            y, H = measurement.model.linearised(measurement.z, state.mean, measurement.pose)
            S = congruence(H, state.covariance) + measurement.R
            result = each.update(measurement)
            if result.innovation is not None:
                if result.innovation_covariance is not None:
                    y, S = result.innovation, result.innovation_covariance
                density = -0.5 * float(mahalanobis_squared(y, S) + np.linalg.slogdet(S)[1])
                fused.append((log_weight + density, each))
        ordered, self.weighted = sorted(fused or self.weighted, key=lambda each: -each[0]), []
        for log_weight, each in ordered:
            if log_weight < ordered[0][0] + math.log(LEAST_WEIGHT):
                break
            state = each.state_at(measurement.stamp_ns)
            for index, (other, better) in enumerate(self.weighted):
                kept = better.state_at(measurement.stamp_ns)
                if mahalanobis_squared(wrapped(MOTION, state.mean - kept.mean), kept.covariance) < SAME:
                    self.weighted[index] = float(np.logaddexp(other, log_weight)), better
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


def intersections(start: Start, ranges_m: list[float]) -> list[Start]:
    """Both intersections of the circles of two ranges around `ANCHORS_M`, or where they nearly touch.

    The covariance is that of the two ranges, to first order; it is limited to the mean range.
    """
    first, second = (np.array(each) for each in ANCHORS_M)
    apart_m = float(np.hypot(*(second - first)))
    along = (second - first) / apart_m
    across = np.array([-along[1], along[0]])
    near_m, far_m = ranges_m
    foot_m = (near_m**2 - far_m**2 + apart_m**2) / (2.0 * apart_m)
    height_m = math.sqrt(max(near_m**2 - foot_m**2, 0.0))
    found = []
    for side in (1.0, -1.0) if height_m > 0.0 else (1.0,):
        position_m = first + foot_m * along + side * height_m * across
        offsets_m = [position_m - each for each in (first, second)]
        H = np.array([each / max(float(np.hypot(*each)), 1e-9) for each in offsets_m])
        vague = identity(2) / (0.5 * (near_m + far_m)) ** 2
        covariance = symmetrise(psd_solve(H.T @ H / RANGE_STD_M**2 + vague, identity(2)))
        found.append(replace(start, position_m=position_m, position_covariance=covariance))
    return found


def driven(x: FloatArray, rng: np.random.Generator) -> Iterator[tuple[int, FloatArray]]:
    """Stamps and true states of an object that starts at `x` (5,)."""
    for k in range(round(DURATION_S / STEP_S)):
        if k:
            x = drawn(MOTION, x, STEP_S, rng)
        yield round(k * STEP_S * 1e9), x


def doppler(rng: np.random.Generator) -> Scene:
    """An object of unknown heading and speed, 40 to 80 m from a sensor that drives at 15 m/s."""
    away_m, direction_rad = rng.uniform(40.0, 80.0), rng.uniform(-np.pi, np.pi)
    place_m = away_m * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    x = np.array([*place_m, rng.uniform(-np.pi, np.pi), rng.uniform(8.0, 20.0), rng.uniform(-0.1, 0.1)])
    truth, measurements, R = [], [], np.diag(DOPPLER_STD**2)
    for stamp_ns, state in driven(x, rng):
        pose = SensorPose(15.0 * stamp_ns / 1e9, 0.0, 0.0, 15.0, 0.0)
        exact = DOPPLER.predict(state, pose)
        measurements.append([Measurement(stamp_ns, DOPPLER, exact + DOPPLER_STD * rng.standard_normal(3), R, pose)])
        truth.append(state)
    (first,) = measurements.pop(0)
    position_m, covariance = measured_position(DOPPLER.components, first.z, R, first.pose) or (first.z, R)
    start = Start(position_m=position_m, position_covariance=covariance, speed_std_mps=20.0)
    return Scene(start, [], headings(start, NUM_HEADINGS), np.array(truth[1:]), measurements)


def ranging(rng: np.random.Generator) -> Scene:
    """An object of known heading and speed, of which two sensors at fixed places measure the ranges alone."""
    side = rng.choice([-1.0, 1.0])
    yaw_rad = side * (0.5 * np.pi + rng.uniform(-0.8, 0.8))  # away from the line of the sensors
    x = np.array([rng.uniform(0.0, 20.0), side * rng.uniform(5.0, 15.0), yaw_rad, 5.0, 0.0])
    truth, measurements = [], []
    for stamp_ns, state in driven(x, rng):
        found = []
        for anchor in ANCHORS_M:
            range_m = float(np.hypot(*(state[:2] - np.array(anchor)))) + RANGE_STD_M * rng.standard_normal()
            pose, std = SensorPose(*anchor), {"range_m": RANGE_STD_M}
            found.append(Measurement.of(stamp_ns, range_m=abs(range_m), std=std, pose=pose))
        measurements.append(found)
        truth.append(state)
    first = measurements.pop(0)
    known = Start(
        position_m=x[:2] + 8.0 * rng.standard_normal(2),
        position_std_m=8.0,
        yaw_rad=float(x[2] + 0.15 * rng.standard_normal()),
        yaw_std_rad=0.15,
        speed_mps=float(x[3] + rng.standard_normal()),
        speed_std_mps=1.0,
    )
    both = intersections(known, [float(each.z[0]) for each in first])
    return Scene(known, first, both, np.array(truth[1:]), measurements)


SCENES = {"doppler": doppler, "ranging": ranging}
NAMES = ("ekf-replay", "iekf-replay", "ukf-replay", "iplf-replay", "smoother")
#: By scene: how the object may start.
STARTS: dict[str, dict[str, dict[str, str]]] = {
    "doppler": {"one-point": {"initiation": "one-point"}, "regression": {"initiation": "regression"}, "8 headings": {}},
    "ranging": {"one start": {}, "two intersections": {}},
}


def errors_m(scene_name: str, name: str, how: str, seed: int, run: int) -> FloatArray:
    """Position error at the newest stamp, after each stamp of one run, shape (num,)."""
    scene = SCENES[scene_name](np.random.default_rng([seed, run]))
    options: dict[str, Any] = dict(STARTS[scene_name][how])
    if name == "smoother":
        options |= {"lagged_s": (), "final": False}
    several = how in ("8 headings", "two intersections")
    starts = scene.hypotheses if several else [scene.start]
    estimator = Hypotheses([fgtrack.estimator(name, MOTION, each, lag_s=WINDOW_S, **options) for each in starts])
    for measurement in [] if several else scene.first:
        estimator.update(measurement)
    found = []
    for measurements, truth in zip(scene.measurements, scene.truth, strict=True):
        for measurement in measurements:
            estimator.update(measurement)
        state = estimator.state_at(measurements[0].stamp_ns)
        found.append(float(np.hypot(*(state.mean[:2] - truth[:2]))))
    return np.array(found)


def rmse_m(errors: FloatArray) -> FloatArray:
    """RMSE of each run from `SETTLED_S` on; `errors` (runs, num), result (runs,)."""
    return np.asarray(np.sqrt(np.mean(errors[:, round(SETTLED_S / STEP_S) :] ** 2, axis=1)))


def over_runs(values: FloatArray, rng: np.random.Generator) -> Estimate:
    """Root of the mean square of `values` (runs,), and its 95 % interval by a bootstrap over the runs."""
    resampled = np.sqrt((rng.choice(values, (2000, len(values))) ** 2).mean(axis=1))
    return Estimate(float(np.sqrt((values**2).mean())), *np.quantile(resampled, [0.025, 0.975]).tolist(), len(values))


def table(scene: str, found: dict[tuple[str, str], FloatArray], rng: np.random.Generator) -> str:
    """RMSE, median, runs that end far off, and the paired difference to the smoother that starts alike, as Markdown."""
    lines = [
        f"| {scene} | start | RMSE [m] | median of the runs [m] | runs above {FAR_M:g} m "
        "| less the smoother's, paired [m] |",
        "|---|---|---|---|---|---|",
    ]
    for (name, how), errors in found.items():
        values, reference = rmse_m(errors), rmse_m(found["smoother", how])
        difference = "" if name == "smoother" else f"{paired(values, reference):+.2f}"
        far = f"{int((values > FAR_M).sum())} of {len(values)}"
        cells = f"{over_runs(values, rng):.2f} | {np.median(values):.2f} | {far} | {difference}"
        lines.append(f"| {name} | {how} | {cells} |")
    return "\n".join(lines) + "\n"


def draw(results: dict[str, dict[tuple[str, str], FloatArray]], file: Path) -> None:
    """Root of the mean squared error of all runs over time."""
    figure, axes = plt.subplots(1, len(results), figsize=(11.0, 4.0), layout="constrained")
    for axis, (scene, found) in zip(axes, results.items(), strict=True):
        for (name, how), errors in found.items():
            style = ["-", "--", ":"][list(STARTS[scene]).index(how)]
            time_s = STEP_S * np.arange(1, errors.shape[1] + 1)
            label = f"{name}, {how}"
            axis.plot(time_s, np.sqrt((errors**2).mean(axis=0)), style, color=f"C{NAMES.index(name)}", label=label)
        axis.set(xlabel="time since the first measurement [s]", ylabel="position RMSE [m]", yscale="log", title=scene)
        axis.grid(alpha=0.3, which="both")
        axis.legend(fontsize=6)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the tables and the figure.")] = Path("out/doppler"),
    runs: Annotated[int, typer.Option(help="Runs per scene.")] = 20,
    seed: int = 0,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Run every estimator with every start in both scenes, write doppler.csv, doppler.md and doppler.png."""
    out.mkdir(parents=True, exist_ok=True)
    cases = [(scene, name, how) for scene in SCENES for how in STARTS[scene] for name in NAMES]
    found = Parallel(n_jobs=jobs)(delayed(errors_m)(*case, seed, run) for case in cases for run in range(runs))
    results: dict[str, dict[tuple[str, str], FloatArray]] = {scene: {} for scene in SCENES}
    for index, (scene, name, how) in enumerate(cases):
        results[scene][name, how] = np.array(found[index * runs : (index + 1) * runs])
    with (out / "doppler.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["scene", "estimator", "start", "run", "rmse_m"])
        for scene, each in results.items():
            for (name, how), errors in each.items():
                values = rmse_m(errors).tolist()
                writer.writerows([scene, name, how, run, f"{value:.4f}"] for run, value in enumerate(values))
    rng = np.random.default_rng(seed)
    (out / "doppler.md").write_text("\n".join(table(scene, each, rng) for scene, each in results.items()))
    draw(results, out / "doppler.png")
    print((out / "doppler.md").read_text() + f"figure: {out / 'doppler.png'}")


if __name__ == "__main__":
    typer.run(main)
