"""How soon does a new object have a good position and velocity, when nothing is known of its heading and speed?

    python experiments/births/births.py -o out/births

One object at a time drives off in a random direction; only its position is measured. Association is known.
"""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from matplotlib.ticker import LogFormatter

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.factor_graph import FixedLagSmoother, SmootherSettings
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV, CV, MotionModel

START_NS = 1_790_000_000 * NS_PER_S
STEP_S = 0.05
STD_M = 0.3
NUM_STEPS = 40
GOOD_M, GOOD_MPS = 0.5, 2.0
TRUTH = CTRV()


def smoother(prior: Start) -> Estimator:
    settings = SmootherSettings(lag_s=1.0, lagged_s=(), final=False)
    return FixedLagSmoother(TRUTH, prior, settings)


#: By name: the motion model of the estimator, and how it starts. The last one shows what a linear model does.
ESTIMATORS: dict[str, tuple[MotionModel, Callable[[Start], Estimator]]] = {
    "smoother (CTRV)": (TRUTH, smoother),
    "ekf-replay (CTRV)": (TRUTH, lambda prior: ReplayEkf(TRUTH, prior, 1.0)),
    "ekf-replay (CV)": (CV(25.0), lambda prior: ReplayEkf(CV(25.0), prior, 1.0)),
}


def errors(motion: MotionModel, start: Callable[[Start], Estimator], rng: np.random.Generator) -> FloatArray:
    """Errors of position and velocity after each detection of one object, shape (NUM_STEPS, 2)."""
    x = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi), rng.uniform(20.0, 70.0), rng.uniform(-0.1, 0.1)])
    z = x[:2] + STD_M * rng.standard_normal(2)
    R = STD_M**2 * np.eye(2)
    estimator = start(
        Start(
            stamp_ns=START_NS,
            position_m=z,
            position_covariance=R,
            yaw_rad=None,
            yaw_std_rad=np.pi,
            speed_mps=0.0,
            speed_std_mps=40.0,
            yaw_rate_std_radps=0.3,
        )
    )
    model = measurement_model(("x_m", "y_m"), motion)
    found = []
    for k in range(1, NUM_STEPS + 1):
        stamp_ns = START_NS + round(k * STEP_S * NS_PER_S)
        Q = TRUTH.process_noise(x, STEP_S)
        x = TRUTH.predict(x, STEP_S) + np.linalg.cholesky(Q) @ rng.standard_normal(5)
        estimator.update(Measurement(stamp_ns, model, x[:2] + STD_M * rng.standard_normal(2), R))
        state = estimator.state_at(stamp_ns)
        mean = motion.kinematic(state.mean, state.covariance)[0]
        found.append([np.hypot(*(mean - x)[:2]), np.hypot(*(velocity(mean) - velocity(x)))])
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
    figure, axes = plt.subplots(1, 2, figsize=(9.0, 3.6), sharex=True, layout="constrained")
    for axis, column, label, good in zip(
        axes, range(2), ("position error [m]", "velocity error [m/s]"), (GOOD_M, GOOD_MPS), strict=True
    ):
        for index, (name, found) in enumerate(results.items()):
            axis.plot(time_s, np.median(found[:, :, column], axis=0), color=f"C{index}", label=name)
            axis.plot(time_s, np.quantile(found[:, :, column], 0.9, axis=0), color=f"C{index}", ls=":")
        axis.axhline(good, color="0.5", lw=0.8)
        axis.set(xlabel="time since birth [s]", ylabel=label, yscale="log")
        for which in (axis.yaxis.set_major_formatter, axis.yaxis.set_minor_formatter):
            which(LogFormatter(labelOnlyBase=False, minor_thresholds=(2, 0.5)))
        axis.grid(alpha=0.3)
    axes[0].legend(title="solid: median, dotted: 90 %", fontsize=8, title_fontsize=8)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the table and the figure.")] = Path("out/births"),
    objects: Annotated[int, typer.Option(help="Number of objects.")] = 200,
    seed: int = 0,
) -> None:
    """Draw objects, track each with every estimator, write births.csv and births.png."""
    out.mkdir(parents=True, exist_ok=True)
    results = {
        name: np.array([errors(motion, start, np.random.default_rng([seed, i])) for i in range(objects)])
        for name, (motion, start) in ESTIMATORS.items()
    }
    with (out / "births.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["estimator", "first_median_s", "first_q90_s", "stays_median_s", "stays_q90_s"])
        for name, found in results.items():
            times_s = np.array([reached_s(error) for error in found])
            quantiles_s = np.quantile(times_s, [0.5, 0.9], axis=0, method="higher").T.ravel()
            writer.writerow([name, *(f"{value:.2f}" for value in quantiles_s)])
    draw(results, out / "births.png")
    print((out / "births.csv").read_text() + f"figure: {out / 'births.png'}")


if __name__ == "__main__":
    typer.run(main)
