"""What makes the difference between a filter and a smoother: one ingredient after the other, on the same data.

    python experiments/attribution/attribution.py -o out/attribution --jobs 2

Objects drawn from the motion model with the noise that the estimators assume; association is known. Every contestant
gets the same measurements in the same order of arrival, the same start, and the same loss where it has one.
"""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any

import joblib
import numpy as np
import typer

from fgtrack import (
    CTRV,
    NS_PER_S,
    Estimator,
    FloatArray,
    Measurement,
    RobustLoss,
    SensorPose,
    Start,
    estimator,
    measured_position,
    measurement_model,
    nanoseconds,
)
from fgtrack.evaluation import Estimate, average, paired
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
HUBER = RobustLoss("huber", 1.5)
WAIT_S = 0.3
LAG_S = 1.5
JUDGED_EVERY_S = 0.1
LOST_M = 30.0


@dataclass(frozen=True)
class Contestant:
    """An estimator with what is added to it."""

    estimator: str
    loss: RobustLoss | None = None
    options: Mapping[str, Any] = field(default_factory=dict)  # Any: an estimator's own


_REGRESSION = {"initiation": "regression"}
_ONE_POINT = {"initiation": "one-point"}

#: From the published way to the smoother; the same words in every table.
CONTESTANTS: Mapping[str, Contestant] = {
    "forgets": Contestant("rewind-forget", options=_ONE_POINT),
    "EKF": Contestant("ekf-replay", options=_ONE_POINT),
    "EKF, initiated": Contestant("ekf-replay", options=_REGRESSION),
    "EKF, initiated, smoothing pass": Contestant("ekf-rts", options=_REGRESSION),
    "EKF, initiated, robust": Contestant("ekf-replay", HUBER, _REGRESSION),
    "iterated EKF, initiated": Contestant("iekf-replay", options=_REGRESSION),
    "IPLF, initiated": Contestant("iplf-replay", options=_REGRESSION),
    "smoother": Contestant("smoother-banded"),
    "smoother, robust": Contestant("smoother-banded", HUBER),
}

SMOOTHING = "smoothing, now"
#: What each step adds, from one contestant to the other.
STEPS: Mapping[str, tuple[str, str]] = {
    "keeping what was fused since": ("forgets", "EKF"),
    "initiation": ("EKF", "EKF, initiated"),
    "robust loss": ("EKF, initiated", "EKF, initiated, robust"),
    "iterating the update": ("EKF, initiated", "iterated EKF, initiated"),
    "linearising by sigma points": ("EKF, initiated", "IPLF, initiated"),
    SMOOTHING: ("iterated EKF, initiated", "smoother"),
    "smoothing and robust loss, now": ("EKF, initiated, robust", "smoother, robust"),
}


@dataclass(frozen=True)
class Sensor:
    """A sensor on an observer that drives along x."""

    std: Mapping[str, float]
    period_s: float
    phase_s: float = 0.0
    delay_s: float = 0.0
    outliers: float = 0.0
    """Share of measurements with ten times the noise."""


@dataclass(frozen=True)
class World:
    """A class of scenarios."""

    sensors: tuple[Sensor, ...]
    speed_mps: tuple[float, float]
    duration_s: float
    judged_from_s: float
    heading_known: bool = True
    motion: CTRV = field(default_factory=CTRV)
    distance_m: float = 40.0
    """Of the object at the start, in any direction."""
    observer_mps: float = 0.0


_LIDAR = Sensor({"x_m": 0.3, "y_m": 0.3}, 0.05, delay_s=0.151)
_RADAR = Sensor(
    {"x_m": 1.0, "y_m": 1.0, "speed_mps": 1.0}, 0.05, phase_s=0.023, delay_s=0.062
)
_URBAN = CTRV(0.01, 0.002, 1.0, 0.05)

WORLDS: Mapping[str, World] = {
    "race: LiDAR and RADAR, late": World((_LIDAR, _RADAR), (50.0, 70.0), 6.0, 2.0),
    "birth: positions, heading unknown": World(
        (Sensor({"x_m": 0.3, "y_m": 0.3}, 0.05, delay_s=0.151),),
        (20.0, 70.0),
        2.5,
        0.5,
        heading_known=False,
    ),
    "outliers: 10 % of ten times the noise, late": World(
        (Sensor(_LIDAR.std, 0.05, delay_s=0.151, outliers=0.1), _RADAR),
        (50.0, 70.0),
        6.0,
        2.0,
    ),
    "town: 2 Hz positions of turning cars": World(
        (Sensor({"x_m": 0.5, "y_m": 0.5}, 0.5, delay_s=0.3),),
        (5.0, 15.0),
        20.0,
        5.0,
        motion=_URBAN,
    ),
    "near: range and bearing, 6 degrees": World(
        (Sensor({"range_m": 0.2, "bearing_rad": 0.1}, 0.1, delay_s=0.15),),
        (3.0, 10.0),
        8.0,
        2.0,
        motion=_URBAN,
        distance_m=15.0,
        heading_known=False,
        observer_mps=5.0,
    ),
}


@dataclass(frozen=True)
class Drawn:
    """One run of a world."""

    world: World
    start: Start
    received: tuple[tuple[int, Measurement], ...]
    """Receipt and measurement, in order of receipt."""
    truth: Mapping[int, FloatArray]
    """By stamp."""


def scene(world: World, rng: np.random.Generator) -> Drawn:
    """Truth with the motion model's noise, and what the sensors measure of it."""
    plan: list[tuple[int, Sensor | None]] = []
    for sensor in world.sensors:
        count = int((world.duration_s - sensor.phase_s) / sensor.period_s)
        plan += [
            (nanoseconds(sensor.phase_s + k * sensor.period_s), sensor)
            for k in range(1, count + 1)
        ]
    waits_ns = nanoseconds(WAIT_S)
    judged = [
        nanoseconds(k * JUDGED_EVERY_S)
        for k in range(1, int(world.duration_s / JUDGED_EVERY_S) + 1)
    ]
    plan += [(at, None) for at in judged] + [
        (at - waits_ns, None) for at in judged if at > waits_ns
    ]
    plan.sort(key=lambda item: item[0])
    direction, heading = rng.uniform(-np.pi, np.pi, 2)
    x = np.array(
        [
            world.distance_m * np.cos(direction),
            world.distance_m * np.sin(direction),
            heading,
            rng.uniform(*world.speed_mps),
            rng.uniform(-0.1, 0.1),
        ]
    )
    start = first(world, x, rng)
    truth, received, last_ns = {0: x}, [], 0
    for since_ns, sensor in plan:
        dt_s = (since_ns - last_ns) / NS_PER_S
        if dt_s > 0.0:
            x = draw_states(world.motion, x, dt_s, rng)
            last_ns = since_ns
        truth[since_ns] = x
        if sensor is not None:
            measurement = measured(world, sensor, x, since_ns, rng)
            received.append((since_ns + nanoseconds(sensor.delay_s), measurement))
    received.sort(key=lambda item: (item[0], item[1].stamp_ns))
    return Drawn(world, start, tuple(received), truth)


def first(world: World, x: FloatArray, rng: np.random.Generator) -> Start:
    """What a tracker would know after the first detection: where, and in some worlds whither and how fast."""
    measurement = measured(world, world.sensors[0], x, 0, rng)
    position_m, R = measured_position(
        measurement.model.components, measurement.z, measurement.R, measurement.pose
    ) or (
        x[:2],
        np.eye(2),
    )
    known = world.heading_known
    low_mps, high_mps = world.speed_mps
    middle_mps = (low_mps + high_mps) / 2.0
    return Start(
        stamp_ns=START_NS,
        position_m=position_m,
        position_covariance=R,
        yaw_rad=float(x[2] + 0.1 * rng.standard_normal()) if known else None,
        speed_mps=middle_mps if known else 0.0,
        speed_std_mps=(high_mps - low_mps) / np.sqrt(12.0)
        if known
        else high_mps / np.sqrt(2.0),
        yaw_rate_std_radps=0.1,
    )


def measured(
    world: World, sensor: Sensor, x: FloatArray, since_ns: int, rng: np.random.Generator
) -> Measurement:
    """What `sensor` measures of the state `x`, shape (5,); the covariance is that without outliers."""
    pose = SensorPose(
        x_m=world.observer_mps * since_ns / NS_PER_S, vx_mps=world.observer_mps
    )
    model = measurement_model(tuple(sensor.std), world.motion)
    std = np.array(list(sensor.std.values()))
    noise = (
        std
        * rng.standard_normal(len(std))
        * (10.0 if rng.random() < sensor.outliers else 1.0)
    )
    return Measurement(
        START_NS + since_ns,
        model,
        model.predict(x, pose) + noise,
        np.diag(std**2),
        pose,
    )


def start_of(contestant: Contestant, run: Drawn) -> Estimator:
    """A new estimator for `run`."""
    return estimator(
        contestant.estimator,
        run.world.motion,
        run.start,
        lag_s=LAG_S,
        **contestant.options,
    )


def score(contestant: Contestant, run: Drawn) -> "Score":
    """Run one estimator; judged every `JUDGED_EVERY_S` from `World.judged_from_s` on."""
    one = start_of(contestant, run)
    waiting = list(run.received)
    now_m2: dict[int, float] = {}
    ago_m2: dict[int, float] = {}
    nees: list[float] = []
    for k in range(1, round(run.world.duration_s / JUDGED_EVERY_S) + 1):
        now_ns = nanoseconds(k * JUDGED_EVERY_S)
        while waiting and waiting[0][0] <= now_ns:
            one.update(replace(waiting.pop(0)[1], loss=contestant.loss))
        one.advance(START_NS + now_ns)
        for squares, at_ns in (
            (now_m2, now_ns),
            (ago_m2, now_ns - nanoseconds(WAIT_S)),
        ):
            if at_ns < nanoseconds(run.world.judged_from_s):
                continue
            state = one.state_at(START_NS + at_ns)
            error = state.mean[:2] - run.truth[at_ns][:2]
            squares[at_ns] = float(error @ error)
            if at_ns == now_ns:
                nees.append(
                    float(error @ np.linalg.solve(state.covariance[:2, :2], error))
                )
    then_m2 = [now_m2[at_ns] for at_ns in ago_m2]
    return Score(
        *(
            math.sqrt(np.mean(of))
            for of in (list(now_m2.values()), then_m2, list(ago_m2.values()))
        ),
        np.mean(nees),
    )


@dataclass(frozen=True)
class Score:
    """One contestant in one run."""

    rmse_m: float
    """Of the position now."""
    then_rmse_m: float
    """The same at the stamps of `waited_rmse_m`."""
    waited_rmse_m: float
    """Of the position `WAIT_S` ago, as it is known now."""
    nees: float
    """Mean, of the position now; 2 if consistent."""


def scores(world: str, seed: int) -> dict[str, Score]:
    """All contestants on one run of `world`."""
    run = scene(WORLDS[world], np.random.default_rng([list(WORLDS).index(world), seed]))
    return {name: score(contestant, run) for name, contestant in CONTESTANTS.items()}


#: Scores by world, seed and contestant.
Scores = Mapping[str, Sequence[Mapping[str, Score]]]


def change(of: Iterable[float], to: Iterable[float]) -> Estimate:
    """Relative change in per cent from `to` to `of`, the geometric mean over paired runs, and its 95 % interval."""
    logs = paired([math.log(value) for value in of], [math.log(value) for value in to])
    mean, low, high = (
        100.0 * math.expm1(value) for value in (logs.mean, logs.low, logs.high)
    )
    return Estimate(mean, low, high, logs.count)


def table_of_errors(found: Scores) -> list[list[str]]:
    """A row for each world and contestant: errors, runs lost, consistency."""
    rows = []
    for world, runs in found.items():
        for name in CONTESTANTS:
            of = [run[name] for run in runs]
            kept = [one for one in of if one.rmse_m < LOST_M]
            rmse, waited, nees = (
                f"{average([getattr(one, what) for one in kept]):.3g}"
                for what in ("rmse_m", "waited_rmse_m", "nees")
            )
            lost = len(of) - len(kept)
            rows.append([world, name, rmse, waited, nees, f"{lost} of {len(of)}"])
    return rows


def table_of_steps(found: Scores) -> list[list[str]]:
    """A row for each step, a column for each world: by how much the position error changes, bold if significant."""
    rows = []
    for step, (before, after) in STEPS.items():
        of_worlds = [
            change(
                [run[after].rmse_m for run in runs],
                [run[before].rmse_m for run in runs],
            )
            for runs in found.values()
        ]
        rows.append([step, *(marked(one) for one in of_worlds)])
    before, after = STEPS[SMOOTHING]
    single = "EKF, initiated", "EKF, initiated, smoothing pass"
    waiting, smoothing, passing, graph = [], [], [], []
    for runs in found.values():
        waited = [run[before].waited_rmse_m for run in runs]
        waiting.append(
            marked(change(waited, [run[before].then_rmse_m for run in runs]))
        )
        smoothing.append(
            marked(change([run[after].waited_rmse_m for run in runs], waited))
        )
        filtered, passed = (
            [run[name].waited_rmse_m for run in runs] for name in single
        )
        passing.append(marked(change(passed, filtered)))
        graph.append(marked(change([run[after].waited_rmse_m for run in runs], passed)))
    return [
        *rows,
        [f"waiting {WAIT_S:g} s, filter", *waiting],
        [f"smoothing, {WAIT_S:g} s ago", *smoothing],
        [f"smoothing pass over the EKF, {WAIT_S:g} s ago", *passing],
        [f"smoother against that pass, {WAIT_S:g} s ago", *graph],
    ]


def marked(value: Estimate) -> str:
    """Per cent with the interval; bold where it excludes 0."""
    bold = "**" if value.is_significant else ""
    return f"{bold}{value.mean:+.1f}{bold} ({value.low:+.1f} to {value.high:+.1f})"


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder of the tables.")] = Path(
        "out/attribution"
    ),
    runs: Annotated[int, typer.Option(help="Runs of each world.")] = 30,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
    seed: int = 0,
) -> None:
    """Write scores.csv, errors.md and steps.md."""
    out.mkdir(parents=True, exist_ok=True)
    tasks = [(world, seed + k) for world in WORLDS for k in range(runs)]
    every = joblib.Parallel(n_jobs=jobs)(
        joblib.delayed(scores)(*task) for task in tasks
    )
    found = {
        world: [one for (of, _), one in zip(tasks, every, strict=True) if of == world]
        for world in WORLDS
    }
    with (out / "scores.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["world", "seed", "contestant", *(each.name for each in fields(Score))]
        )
        for (world, number), one in zip(tasks, every, strict=True):
            for name, of in one.items():
                writer.writerow([world, number, name, *astuple(of)])
    errors = markdown(
        [
            "world",
            "contestant",
            "now [m]",
            f"{WAIT_S:g} s ago [m]",
            "NEES now (2)",
            "lost",
        ],
        table_of_errors(found),
    )
    steps = markdown(["step", *WORLDS], table_of_steps(found))
    (out / "errors.md").write_text(errors)
    (out / "steps.md").write_text(steps)
    print(f"Position error, mean over the runs that kept the object\n\n{errors}")
    print(
        f"Change of the position error by each step [%], geometric mean over paired runs\n\n{steps}"
    )


if __name__ == "__main__":
    typer.run(main)
