"""What do outliers cost, and what do a robust loss and a larger covariance save, in a filter and in a smoother?

    python experiments/outliers/outliers.py -o out/outliers

One object drawn from the motion model; some of its detections have ten times the assumed standard deviation,
and none is gated. Association is known. Every estimator sees the same detections in the same order.
"""

import csv
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack import (
    CTRV,
    NS_PER_S,
    FloatArray,
    Measurement,
    RobustLoss,
    Start,
    measurement_model,
)
from fgtrack.evaluation import paired
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
STEP_S = 0.05
STD_M = 0.3
FACTOR = 10.0
NUM_STEPS = 200
SHARES = (0.1,)
LATEST_S = 0.3
LOST_M = 3.0
MOTION = CTRV()
MODEL = measurement_model(("x_m", "y_m"), MOTION)
HUBER, CAUCHY, TUKEY = (
    RobustLoss("huber", 1.5),
    RobustLoss("cauchy", 2.0),
    RobustLoss("tukey", 4.7),
)


class Variant(NamedTuple):
    """An estimator, and what it does about outliers."""

    name: str
    loss: RobustLoss | None = None
    inflated: bool = False
    """Whether R is the covariance of all detections, outliers included: their share is known."""


VARIANTS = {
    "ekf-replay, Gaussian": Variant("ekf-replay"),
    "ekf-replay, inflated R": Variant("ekf-replay", inflated=True),
    "ekf-replay, Huber 1.5": Variant("ekf-replay", HUBER),
    "ekf-replay, Cauchy 2": Variant("ekf-replay", CAUCHY),
    "ekf-replay, Tukey 4.7": Variant("ekf-replay", TUKEY),
    "smoother-banded, Gaussian": Variant("smoother-banded"),
    "smoother-banded, Huber 1.5": Variant("smoother-banded", HUBER),
    "smoother-banded, Cauchy 2": Variant("smoother-banded", CAUCHY),
    "smoother-banded, Tukey 4.7": Variant("smoother-banded", TUKEY),
}


def start(x: FloatArray) -> Start:
    """What is known of an object that starts at `x`."""
    x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = x.tolist()
    return Start(
        stamp_ns=START_NS,
        position_m=(x_m, y_m),
        position_std_m=STD_M,
        yaw_rad=yaw_rad,
        yaw_std_rad=0.3,
        speed_mps=speed_mps,
        speed_std_mps=2.0,
        yaw_rate_radps=yaw_rate_radps,
        yaw_rate_std_radps=0.1,
    )


def rmse_m(label: str, share: float, seed: int, run: int) -> float:
    """RMSE of the present position along one run: at each stamp, from what has arrived by then."""
    rng, variant = np.random.default_rng([seed, run]), VARIANTS[label]
    x = np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi), 60.0, 0.03])
    options = (
        {"lagged_s": (), "final": False} if variant.name == "smoother-banded" else {}
    )
    estimator = fgtrack.estimator(variant.name, MOTION, start(x), lag_s=1.0, **options)
    variance = STD_M**2 * (1.0 + share * (FACTOR**2 - 1.0) if variant.inflated else 1.0)
    waiting: list[tuple[int, Measurement]] = []
    squared_m2 = np.empty(NUM_STEPS)
    for k in range(NUM_STEPS):
        x = draw_states(MOTION, x, STEP_S, rng)
        std_m = STD_M * (FACTOR if rng.random() < share else 1.0)
        z = x[:2] + std_m * rng.standard_normal(2)
        now_ns = START_NS + round((k + 1) * STEP_S * NS_PER_S)
        receipt_ns = now_ns + round(LATEST_S * rng.random() * NS_PER_S)
        waiting.append(
            (
                receipt_ns,
                Measurement(now_ns, MODEL, z, variance * np.eye(2), loss=variant.loss),
            )
        )
        waiting.sort(key=lambda each: each[0])
        while waiting and waiting[0][0] <= now_ns:
            estimator.update(waiting.pop(0)[1])
        squared_m2[k] = np.sum((estimator.state_at(now_ns).mean[:2] - x[:2]) ** 2)
    return float(np.sqrt(squared_m2.mean()))


def table(rmse: dict[tuple[str, float], FloatArray]) -> str:
    """Mean RMSE over the runs, and its paired difference to the Gaussian EKF, as Markdown."""
    lines = ["| | " + " | ".join(f"{share:.0%} outliers" for share in SHARES) + " |"]
    lines.append("|---" * (1 + len(SHARES)) + "|")
    reference = next(iter(VARIANTS))
    for label in VARIANTS:
        cells = []
        for share in SHARES:
            found = rmse[label, share]
            lost = int((found > LOST_M).sum())
            gain = (
                ""
                if label == reference
                else f"; {paired(found, rmse[reference, share]):+.3f}"
            )
            cells.append(
                f"lost in {lost} of {len(found)}"
                if lost
                else f"{found.mean():.3f}{gain}"
            )
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(
    out: Annotated[Path, typer.Option("-o", help="Folder for the tables.")] = Path(
        "out/outliers"
    ),
    runs: Annotated[int, typer.Option(help="Runs per share of outliers.")] = 10,
    seed: int = 0,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Run every variant over every share of outliers, write outliers.csv and outliers.md."""
    out.mkdir(parents=True, exist_ok=True)
    cases = [(label, share) for label in VARIANTS for share in SHARES]
    found = Parallel(n_jobs=jobs)(
        delayed(rmse_m)(*case, seed, run) for case in cases for run in range(runs)
    )
    rmse = dict(zip(cases, np.reshape(found, (len(cases), runs)), strict=True))
    with (out / "outliers.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["estimator", "share", "run", "rmse_m"])
        for case, values in rmse.items():
            writer.writerows(
                [*case, run, f"{value:.4f}"]
                for run, value in enumerate(values.tolist())
            )
    (out / "outliers.md").write_text(table(rmse))
    print((out / "outliers.md").read_text())


if __name__ == "__main__":
    typer.run(main)
