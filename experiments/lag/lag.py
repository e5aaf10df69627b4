"""Error and consistency against lag, and what a longer window costs.

    python experiments/lag/lag.py -o out/lag

One object drawn from the motion model, seen by the paper's sensors with their delays; association is known.
"""

import csv
import time
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from scipy.stats import chi2

import fgtrack
from fgtrack import (
    CTRV,
    NS_PER_S,
    Estimator,
    FloatArray,
    Measurement,
    Start,
    measurement_model,
)
from fgtrack.sim import draw_states

START_NS = 1_790_000_000 * NS_PER_S
STEP_S = 0.025
SENSORS = (
    (0, 0.151, {"x_m": 0.3, "y_m": 0.3}),
    (1, 0.062, {"x_m": 3.0, "y_m": 3.0, "speed_mps": 0.5}),
)
LAGS_S = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0, 1.5)
WINDOWS_S = (0.2, 0.3, 0.5, 1.0, 2.0, 3.0)
MOTION = CTRV()
PRIOR_STD = np.array([0.3, 0.3, 0.1, 2.0, 0.1])


class Run:
    """A drawn object and what is received of it, in order of receipt."""

    def __init__(self, rng: np.random.Generator, duration_s: float) -> None:
        self.start = np.array([0.0, 0.0, 0.3, 65.0, 0.05])
        states = [self.start + PRIOR_STD * rng.standard_normal(5)]
        received: list[tuple[float, int, Measurement]] = []
        for k in range(1, round(duration_s / STEP_S) + 1):
            states.append(draw_states(MOTION, states[-1], STEP_S, rng))
            phase, delay_s, std = SENSORS[k % 2]
            model = measurement_model(tuple(std), MOTION)
            stds = np.array(list(std.values()))
            z = model.predict(states[-1]) + stds * rng.standard_normal(len(stds))
            received.append(
                (
                    k * STEP_S + delay_s,
                    phase,
                    Measurement(stamp(k), model, z, np.diag(stds**2)),
                )
            )
        self.truth = np.array(states)
        self.received = sorted(received, key=lambda item: item[:2])


def stamp(k: int) -> int:
    return START_NS + round(k * STEP_S * NS_PER_S)


def smoother(start: FloatArray, lag_s: float) -> Estimator:
    x_m, y_m, yaw_rad, speed_mps, yaw_rate_radps = start.tolist()
    prior = Start(
        stamp_ns=START_NS,
        position_m=(x_m, y_m),
        position_std_m=PRIOR_STD[0],
        yaw_rad=yaw_rad,
        yaw_std_rad=PRIOR_STD[2],
        speed_mps=speed_mps,
        speed_std_mps=PRIOR_STD[3],
        yaw_rate_radps=yaw_rate_radps,
        yaw_rate_std_radps=PRIOR_STD[4],
    )
    return fgtrack.estimator("smoother", MOTION, prior, lag_s=lag_s)


def judged(run: Run, lag_s: float) -> tuple[FloatArray, FloatArray, float]:
    """Squared position error and NEES at LAGS_S before the end, shape (lags,), and the median time of an update."""
    estimator = smoother(run.start, lag_s)
    now_s = (len(run.truth) - 1) * STEP_S
    times_s = []
    for receipt_s, _, measurement in run.received:
        if receipt_s <= now_s:
            before = time.perf_counter()
            estimator.update(measurement)
            times_s.append(time.perf_counter() - before)
    squared, nees = [], []
    for back_s in LAGS_S:
        if back_s > lag_s:
            break
        k = len(run.truth) - 1 - round(back_s / STEP_S)
        state = estimator.state_at(stamp(k))
        error = state.mean - run.truth[k]
        squared.append(float(error[:2] @ error[:2]))
        nees.append(float(error @ np.linalg.solve(state.covariance, error)))
    return np.array(squared), np.array(nees), float(np.median(times_s))


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for the tables and the figure.")
    ] = Path("out/lag"),
    runs: Annotated[int, typer.Option(help="Drawn objects.")] = 100,
    duration_s: float = 4.0,
    seed: int = 0,
) -> None:
    """Smooth drawn objects, write lag.csv, window.csv and lag.png."""
    out.mkdir(parents=True, exist_ok=True)
    drawn = [Run(np.random.default_rng([seed, i]), duration_s) for i in range(runs)]
    found = [judged(run, 2.0) for run in drawn]
    rmse_m = np.sqrt(np.mean([squared for squared, _, _ in found], axis=0))
    nees = np.mean([values for _, values, _ in found], axis=0)
    low, high = chi2.ppf([0.025, 0.975], 5 * runs) / runs
    windows = [
        [judged(run, window_s) for run in drawn[: runs // 4]] for window_s in WINDOWS_S
    ]
    present_m = [
        np.sqrt(np.mean([squared[0] for squared, _, _ in some])) for some in windows
    ]
    update_ms = [
        1e3 * float(np.median([time_s for _, _, time_s in some])) for some in windows
    ]
    write(
        out / "lag.csv",
        ["lag_s", "rmse_m", "nees"],
        zip(LAGS_S, rmse_m, nees, strict=True),
    )
    write(
        out / "window.csv",
        ["window_s", "rmse_m", "update_ms"],
        zip(WINDOWS_S, present_m, update_ms, strict=True),
    )
    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.4), layout="constrained")
    axes[0].plot(LAGS_S, rmse_m, "o-")
    axes[0].set(xlabel="lag [s]", ylabel="position RMSE [m]", ylim=(0.0, None))
    axes[1].plot(LAGS_S, nees, "o-")
    axes[1].axhspan(low, high, color="0.85", label="95 % band")
    axes[1].set(xlabel="lag [s]", ylabel="NEES (5 if consistent)")
    axes[1].legend()
    axes[2].plot(WINDOWS_S, update_ms, "o-")
    axes[2].set(
        xlabel="length of the window [s]",
        ylabel="median time of an update [ms]",
        ylim=(0.0, None),
    )
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(out / "lag.png", dpi=150)
    plt.close(figure)
    print(
        (out / "lag.csv").read_text()
        + (out / "window.csv").read_text()
        + f"NEES band: {low:.2f} to {high:.2f}"
    )
    print(f"figure: {out / 'lag.png'}")


def write(path: Path, header: list[str], rows: zip) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([f"{value:.4g}" for value in row] for row in rows)


if __name__ == "__main__":
    typer.run(main)
