"""How soon does a new object have a good position and velocity, when nothing is known of its heading and speed?

    python experiments/births/births.py -o out/births

One object at a time drives off in a random direction; only its position is measured. Association is known.
"""

import csv
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from joblib import Parallel, delayed
from matplotlib.ticker import LogFormatter

import fgtrack
from fgtrack import (
    CTRV,
    CV,
    NS_PER_S,
    FloatArray,
    Measurement,
    MotionModel,
    Start,
    measurement_model,
)
from fgtrack.evaluation import Estimate
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
STEP_S = 0.05
STD_M = 0.3
NUM_STEPS = 40
GOOD_M, GOOD_MPS = 0.5, 2.0
DRAWS = 1000
TRUTH = CTRV()


#: By label: name of the estimator, its motion model and its options. The last one shows what a linear model does.
ESTIMATORS: dict[str, tuple[str, MotionModel, dict[str, str]]] = {
    "smoother, regression": ("smoother", TRUTH, {"initiation": "regression"}),
    "smoother, one-point": ("smoother", TRUTH, {"initiation": "one-point"}),
    "ekf-replay, one-point": ("ekf-replay", TRUTH, {"initiation": "one-point"}),
    "ekf-replay, two-point": ("ekf-replay", TRUTH, {"initiation": "two-point"}),
    "ekf-replay, regression": ("ekf-replay", TRUTH, {"initiation": "regression"}),
    "ekf-replay, CV": ("ekf-replay", CV(25.0), {}),
}


def errors(label: str, rng: np.random.Generator) -> FloatArray:
    """Errors of position and velocity after each detection of one object, shape (NUM_STEPS, 2)."""
    name, motion, options = ESTIMATORS[label]
    x = np.array(
        [
            0.0,
            0.0,
            rng.uniform(-np.pi, np.pi),
            rng.uniform(20.0, 70.0),
            rng.uniform(-0.1, 0.1),
        ]
    )
    z = x[:2] + STD_M * rng.standard_normal(2)
    R = STD_M**2 * np.eye(2)
    start = Start(
        stamp_ns=START_NS,
        position_m=z,
        position_covariance=R,
        yaw_std_rad=np.pi,
        speed_std_mps=40.0,
        yaw_rate_std_radps=0.3,
    )
    estimator = fgtrack.estimator(name, motion, start, lag_s=1.0, **options)
    model = measurement_model(("x_m", "y_m"), motion)
    found = []
    for k in range(1, NUM_STEPS + 1):
        stamp_ns = START_NS + round(k * STEP_S * NS_PER_S)
        x = draw_states(TRUTH, x, STEP_S, rng)
        estimator.update(
            Measurement(stamp_ns, model, x[:2] + STD_M * rng.standard_normal(2), R)
        )
        state = estimator.state_at(stamp_ns)
        mean = motion.kinematic(state.mean, state.covariance)[0]
        found.append(
            [np.hypot(*(mean - x)[:2]), np.hypot(*(velocity(mean) - velocity(x)))]
        )
    return np.array(found)


def velocity(x: FloatArray) -> FloatArray:
    return np.asarray(x[3] * np.array([np.cos(x[2]), np.sin(x[2])]))


def reached_s(error: FloatArray) -> tuple[float, float]:
    """When both errors are good for the first time, and from when on they stay so; infinite where never."""
    good = (error[:, 0] <= GOOD_M) & (error[:, 1] <= GOOD_MPS)
    first = np.flatnonzero(good)
    bad = np.flatnonzero(~good)
    settled = bad[-1] + 1 if len(bad) else 0
    return (
        (first[0] + 1) * STEP_S if len(first) else float("inf"),
        float("inf") if settled == len(error) else (settled + 1) * STEP_S,
    )


def draw(results: dict[str, FloatArray], file: Path) -> None:
    """Median and 90 % quantile of both errors over the time since birth."""
    time_s = STEP_S * np.arange(1, NUM_STEPS + 1)
    figure, axes = plt.subplots(
        1, 2, figsize=(9.0, 3.6), sharex=True, layout="constrained"
    )
    for axis, column, label, good in zip(
        axes,
        range(2),
        ("position error [m]", "velocity error [m/s]"),
        (GOOD_M, GOOD_MPS),
        strict=True,
    ):
        for index, (name, found) in enumerate(results.items()):
            axis.plot(
                time_s,
                np.median(found[:, :, column], axis=0),
                color=f"C{index}",
                label=name,
            )
            axis.plot(
                time_s,
                np.quantile(found[:, :, column], 0.9, axis=0),
                color=f"C{index}",
                ls=":",
            )
        axis.axhline(good, color="0.5", lw=0.8)
        axis.set(xlabel="time since birth [s]", ylabel=label, yscale="log")
        for which in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
            which(LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
        axis.grid(alpha=0.3)
    axes[0].legend(title="solid: median, dotted: 90 %", fontsize=8, title_fontsize=8)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def quantile(values: FloatArray, share: float, rng: np.random.Generator) -> Estimate:
    """The quantile `share` of `values` (n,), and its 95 % interval, by a bootstrap over the objects."""
    resampled = rng.choice(values, (DRAWS, len(values)))
    found = np.quantile(resampled, share, axis=1, method="higher")
    low, high = np.quantile(found, [0.025, 0.975], method="nearest").tolist()
    return Estimate(
        float(np.quantile(values, share, method="higher")), low, high, len(values)
    )


def root_mean(values: FloatArray, rng: np.random.Generator) -> Estimate:
    """Root of the mean of `values` (n,), which are squares, and its 95 % interval, by the same bootstrap."""
    found = np.sqrt(rng.choice(values, (DRAWS, len(values))).mean(axis=1))
    return Estimate(
        float(np.sqrt(values.mean())),
        *np.quantile(found, [0.025, 0.975]).tolist(),
        len(values),
    )


def table(results: dict[str, FloatArray], rng: np.random.Generator) -> str:
    """Times until heading and speed are good, and the errors 0.2 s and 2 s after birth, as Markdown."""
    lines = [
        "| | good after, median [s] | 90 % [s] | stays good after, median [s] "
        "| velocity RMSE after 0.2 s [m/s] | after 2 s [m/s] |",
        "|---|---|---|---|---|---|",
    ]
    for label, found in results.items():
        first_s, settled_s = np.array([reached_s(error) for error in found]).T
        cells = [
            quantile(first_s, 0.5, rng),
            quantile(first_s, 0.9, rng),
            quantile(settled_s, 0.5, rng),
        ]
        cells += [
            root_mean(found[:, round(at_s / STEP_S) - 1, 1] ** 2, rng)
            for at_s in (0.2, 2.0)
        ]
        lines.append(
            f"| {label} | " + " | ".join(f"{cell:.2f}" for cell in cells) + " |"
        )
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for the table and the figure.")
    ] = Path("out/births"),
    objects: Annotated[int, typer.Option(help="Number of objects.")] = 400,
    seed: int = 0,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Draw objects, track each with every estimator, write births.csv, births.md and births.png."""
    out.mkdir(parents=True, exist_ok=True)
    cases = [
        (label, np.random.default_rng([seed, i]))
        for label in ESTIMATORS
        for i in range(objects)
    ]
    found = iter(Parallel(n_jobs=jobs)(delayed(errors)(*case) for case in cases))
    results = {
        label: np.array([next(found) for _ in range(objects)]) for label in ESTIMATORS
    }
    with (out / "births.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["estimator", "object", "first_s", "stays_s"])
        for label, each in results.items():
            writer.writerows(
                [label, number, *reached_s(error)] for number, error in enumerate(each)
            )
    (out / "births.md").write_text(table(results, np.random.default_rng(seed)))
    draw(results, out / "births.png")
    print((out / "births.md").read_text() + f"figure: {out / 'births.png'}")


if __name__ == "__main__":
    typer.run(main)
