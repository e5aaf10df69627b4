"""What do outliers cost a Gaussian estimator, and what does each robust loss save?

    python experiments/outliers/outliers.py -o out/outliers

One object drawn from the motion model; some of its detections have ten times the assumed standard deviation,
and none is gated. Association is known.
"""

import csv
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer

from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import FloatArray
from fgtrack.estimation.base import Estimator, Measurement, Start
from fgtrack.estimation.factor_graph import FixedLagSmoother, SmootherSettings
from fgtrack.estimation.replay import ReplayEkf
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.models.sensors import RobustLoss

START_NS = 1_790_000_000 * NS_PER_S
STEP_S = 0.05
STD_M = 0.3
FACTOR = 10.0
NUM_STEPS = 300
SHARES = (0.0, 0.05, 0.1, 0.2)
MOTION = CTRV()
MODEL = measurement_model(("x_m", "y_m"), MOTION)

LOSSES: dict[str, RobustLoss | None] = {
    "ekf-replay": None,
    "smoother, Gaussian": None,
    "smoother, Huber 1.5": RobustLoss("huber", 1.5),
    "smoother, Cauchy 2": RobustLoss("cauchy", 2.0),
    "smoother, Geman-McClure 2": RobustLoss("geman_mcclure", 2.0),
    "smoother, DCS 2": RobustLoss("dcs", 2.0),
    "smoother, Tukey 4.7": RobustLoss("tukey", 4.7),
}


def start(name: str, loss: RobustLoss | None, x: FloatArray) -> Estimator:
    """The estimator `name` of an object that starts at `x`."""
    x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = x.tolist()
    position, R = np.array([x_m, y_m]), STD_M**2 * np.eye(2)
    prior = Start(
        stamp_ns=START_NS,
        position_m=position,
        position_covariance=R,
        yaw_rad=yaw_rad,
        yaw_std_rad=0.3,
        speed_mps=speed_mps,
        speed_std_mps=2.0,
        yaw_rate_radps=yaw_rate_radps,
        yaw_rate_std_radps=0.1,
    )
    if name == "ekf-replay":
        return ReplayEkf(MOTION, prior, 1.0)
    settings = SmootherSettings(lag_s=1.0, lagged_s=(), final=False)
    return FixedLagSmoother(MOTION, prior, settings)


def squared_errors(name: str, share: float, rng: np.random.Generator) -> FloatArray:
    """Squared position errors of the present state along one run, shape (NUM_STEPS,)."""
    x = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi), 60.0, 0.03])
    loss = LOSSES[name]
    estimator = start(name, loss, x)
    found = np.empty(NUM_STEPS)
    for k in range(NUM_STEPS):
        Q = MOTION.process_noise(x, STEP_S)
        x = MOTION.predict(x, STEP_S) + np.linalg.cholesky(Q) @ rng.standard_normal(5)
        std_m = STD_M * (FACTOR if rng.random() < share else 1.0)
        z = x[:2] + std_m * rng.standard_normal(2)
        stamp_ns = START_NS + round((k + 1) * STEP_S * NS_PER_S)
        estimator.update(Measurement(stamp_ns, MODEL, z, STD_M**2 * np.eye(2), loss=loss))
        found[k] = np.sum((estimator.state_at(stamp_ns).mean[:2] - x[:2]) ** 2)
    return found


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the table and the figure.")] = Path("out/outliers"),
    runs: Annotated[int, typer.Option(help="Runs per share of outliers.")] = 20,
    seed: int = 0,
) -> None:
    """Run every loss over every share of outliers, write outliers.csv and outliers.png."""
    out.mkdir(parents=True, exist_ok=True)
    rmse = {
        name: [
            np.sqrt(np.mean([squared_errors(name, share, np.random.default_rng([seed, run])) for run in range(runs)]))
            for share in SHARES
        ]
        for name in LOSSES
    }
    with (out / "outliers.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["estimator", *(f"rmse_m_{share:g}" for share in SHARES)])
        writer.writerows([name, *(f"{value:.3f}" for value in values)] for name, values in rmse.items())
    figure, axis = plt.subplots(figsize=(6.5, 4.0), layout="constrained")
    for index, (name, values) in enumerate(rmse.items()):
        axis.plot([100.0 * share for share in SHARES], values, marker="os^vDPX"[index], label=name)
    axis.set(xlabel="share of outliers [%]", ylabel="position RMSE of the present state [m]", yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    figure.savefig(out / "outliers.png", dpi=150)
    plt.close(figure)
    print((out / "outliers.csv").read_text() + f"figure: {out / 'outliers.png'}")


if __name__ == "__main__":
    typer.run(main)
