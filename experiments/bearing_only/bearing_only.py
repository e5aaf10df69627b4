"""Range from bearings alone: what is each estimator worth where the range is hardly known at the start?

    python experiments/bearing_only/bearing_only.py -o out/bearing_only

An observer that hears the bearing of an object only, and manoeuvres so that the range becomes observable (Ristic,
Arulampalam, Gordon, "Beyond the Kalman filter", 2004, chapter 6): a ship by sonar as there, and a car by a camera. The
bearings come late and out of sequence. Every estimator has the same start, drawn from what it is told, the same model
and data, and reaches back to the first bearing.
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import typer
from joblib import Parallel, delayed

from fgtrack import (
    CV,
    NS_PER_S,
    FloatArray,
    Measurement,
    SensorPose,
    Start,
    estimator,
    list_estimators,
    measurement_model,
    rotation,
)
from fgtrack.evaluation import average, paired
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
FIRST_BEARING_RAD = np.deg2rad(10.0)
NEAREST = 0.1  # of the expected range: nothing starts nearer


@dataclass(frozen=True)
class World:
    """A scene: what is known at the start, how the observer moves, and what it hears."""

    step_s: float
    last_s: float
    bearing_std_rad: float
    range_m: float
    range_std_m: float
    velocity_std_mps: float
    """Of the object, per axis."""
    latest_s: float
    """A bearing arrives up to this much late."""
    observer_mps: float
    courses: tuple[tuple[float, float], ...]
    """Times and courses of the observer, in s and degrees from the x axis; between them it turns steadily."""
    motion: CV

    def steps(self, last_s: float) -> int:
        """Number of bearings up to `last_s`."""
        return round(last_s / self.step_s) + 1

    def observer(self, steps: int) -> FloatArray:
        """Positions of the observer, shape (steps, 2)."""
        times_s, courses_deg = np.array(self.courses).T
        courses = np.deg2rad(
            np.interp(self.step_s * np.arange(steps), times_s, courses_deg)
        )
        velocity = self.observer_mps * np.stack(
            [np.cos(courses), np.sin(courses)], axis=-1
        )
        return np.concatenate(
            [np.zeros((1, 2)), np.cumsum(self.step_s * velocity[:-1], axis=0)]
        )


WORLDS = {
    "ship": World(
        step_s=30.0,
        last_s=1800.0,
        bearing_std_rad=np.deg2rad(1.5),
        range_m=5000.0,
        range_std_m=2000.0,
        velocity_std_mps=2.0,
        latest_s=90.0,
        observer_mps=2.57,
        courses=((0.0, -50.0), (780.0, -50.0), (1020.0, 70.0)),
        motion=CV(velocity_density_m2ps3=1e-5),
    ),
    "car": World(
        step_s=0.2,
        last_s=10.0,
        bearing_std_rad=np.deg2rad(0.1),
        range_m=100.0,
        range_std_m=60.0,
        velocity_std_mps=10.0,
        latest_s=0.6,
        observer_mps=20.0,
        courses=((0.0, 0.0), (5.0, 0.0), (7.0, 90.0)),
        motion=CV(velocity_density_m2ps3=0.05),
    ),
}

Options = Mapping[str, object]
#: Name in the table: estimator and its options. One that is not registered is left out.
CASES: dict[str, tuple[str, Options]] = {
    "ekf-replay": ("ekf-replay", {}),
    "ukf-replay": ("ukf-replay", {}),
    "smoother-banded": ("smoother-banded", {}),
}


class Pursuit(NamedTuple):
    """One draw: where the object is, what is heard of it and when, and what is known at the start."""

    truth: FloatArray
    """States of the object at every step, shape (steps, 4)."""
    measurements: list[Measurement]
    receipts_s: FloatArray
    start: Start


class Errors(NamedTuple):
    """Of the present position at every step."""

    distance_m: FloatArray
    nees: FloatArray


def pursuit(world: World, rng: np.random.Generator, last_s: float) -> Pursuit:
    """Draw an object from the prior, its way from the motion model, and its bearings up to `last_s`."""
    steps, model = (
        world.steps(last_s),
        measurement_model(("bearing_rad",), world.motion),
    )
    range_m = 0.0
    while range_m < NEAREST * world.range_m:
        range_m = world.range_m + world.range_std_m * rng.standard_normal()
    position = range_m * np.array(
        [np.cos(FIRST_BEARING_RAD), np.sin(FIRST_BEARING_RAD)]
    )
    truth = [
        np.concatenate([position, world.velocity_std_mps * rng.standard_normal(2)])
    ]
    for _ in range(steps - 1):
        truth.append(draw_states(world.motion, truth[-1], world.step_s, rng))
    R = np.array([[world.bearing_std_rad**2]])
    measurements = []
    for k, (place, state) in enumerate(zip(world.observer(steps), truth, strict=True)):
        pose = SensorPose(float(place[0]), float(place[1]))
        z = model.predict(state, pose) + world.bearing_std_rad * rng.standard_normal(1)
        measurements.append(
            Measurement(
                START_NS + round(k * world.step_s * NS_PER_S), model, z, R, pose
            )
        )
    turn, spread_m = (
        rotation(float(measurements[0].z[0])),
        [world.range_std_m, world.range_m * world.bearing_std_rad],
    )
    start = Start(
        stamp_ns=START_NS,
        position_m=turn @ np.array([world.range_m, 0.0]),
        position_covariance=turn @ np.diag(np.square(spread_m)) @ turn.T,
        speed_std_mps=world.velocity_std_mps,
    )
    receipts_s = world.step_s * np.arange(steps) + rng.uniform(
        0.0, world.latest_s, steps
    )
    return Pursuit(np.array(truth), measurements, receipts_s, start)


def errors(world: World, name: str, drawn: Pursuit) -> Errors:
    """Errors of the present state of the case `name`, from what has been received at every step."""
    entry, options = CASES[name]
    one = estimator(
        entry, world.motion, drawn.start, lag_s=2.0 * world.last_s, **options
    )
    order = np.argsort(drawn.receipts_s[1:]) + 1  # the first bearing is in the start
    heard, distance_m, nees = 0, [], []
    for k in range(1, len(drawn.truth)):
        while heard < len(order) and drawn.receipts_s[order[heard]] <= k * world.step_s:
            one.update(drawn.measurements[order[heard]])
            heard += 1
        state = one.state_at(START_NS + round(k * world.step_s * NS_PER_S))
        d = state.mean[:2] - drawn.truth[k, :2]
        distance_m.append(float(np.hypot(*d)))
        nees.append(float(d @ np.linalg.solve(state.covariance[:2, :2], d)))
    return Errors(np.array(distance_m), np.array(nees))


def chosen(names: str | None) -> list[str]:
    """The cases of `names`, separated by semicolons, or all whose estimator there is."""
    there = [name for name, (entry, _) in CASES.items() if entry in list_estimators()]
    return there if names is None else [name.strip() for name in names.split(";")]


def row(name: str, found: list[Errors], reference: list[Errors]) -> list[str]:
    """The case's errors at the last step, and in pairs those less than of the reference."""
    last, base = (
        np.array([one.distance_m[-1] for one in runs]) for runs in (found, reference)
    )
    nees = np.array([one.nees[-1] for one in found])
    return [
        name,
        f"{np.median(last):.3g}",
        f"{np.quantile(last, 0.9):.3g}",
        f"{np.sqrt(np.mean(last**2)):.3g}",
        f"{paired(last, base):.3g}" if found is not reference else "",
        f"{average(nees):.3g}",
        f"{np.median(nees):.2f}",
        f"{100.0 * np.mean(nees > 13.8):.0f}",  # one in a thousand of a consistent estimator
    ]


HEADER = [
    "estimator",
    "median_m",
    "q90_m",
    "rmse_m",
    "mean_less_ekf_m",
    "nees",
    "nees_median",
    "lost_percent",
]


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for the table and the figure.")
    ] = Path("out/bearing_only"),
    runs: Annotated[int, typer.Option(help="Draws in each world.")] = 24,
    share: Annotated[float, typer.Option(help="Share of each world's duration.")] = 1.0,
    cases: Annotated[
        str | None, typer.Option(help="Cases, separated by semicolons.")
    ] = None,
    worlds: Annotated[
        str, typer.Option(help="Worlds, separated by commas.")
    ] = ",".join(WORLDS),
    seed: int = 0,
    jobs: int = 1,
) -> None:
    """Draw the pursuits, run every case, write bearing_only.csv and bearing_only.png."""
    out.mkdir(parents=True, exist_ok=True)
    names, places = chosen(cases), worlds.split(",")
    figure, axes = plt.subplots(
        1,
        len(places),
        figsize=(5.5 * len(places), 4.0),
        layout="constrained",
        squeeze=False,
    )
    lines = []
    for axis, place in zip(axes[0], places, strict=True):
        world = WORLDS[place]
        draws = [
            pursuit(world, np.random.default_rng([seed, run]), share * world.last_s)
            for run in range(runs)
        ]
        tasks = [
            delayed(errors)(world, name, drawn) for name in names for drawn in draws
        ]
        flat: list[Errors] = Parallel(n_jobs=jobs)(tasks)
        found = {
            name: flat[index * runs : (index + 1) * runs]
            for index, name in enumerate(names)
        }
        lines += [[place, *row(name, found[name], found[names[0]])] for name in names]
        for name, of_case in found.items():
            rms_m = np.sqrt(np.mean([one.distance_m**2 for one in of_case], axis=0))
            axis.plot(world.step_s * np.arange(1, len(rms_m) + 1), rms_m, label=name)
        axis.set(
            title=place,
            xlabel="time [s]",
            ylabel="position RMSE of the present [m]",
            yscale="log",
        )
        axis.grid(alpha=0.3, which="both")
    axes[0, -1].legend(fontsize=8)
    figure.savefig(out / "bearing_only.png", dpi=150)
    plt.close(figure)
    with (out / "bearing_only.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["world", *HEADER], *lines])
    print(
        (out / "bearing_only.csv").read_text() + f"figure: {out / 'bearing_only.png'}"
    )


if __name__ == "__main__":
    typer.run(main)
