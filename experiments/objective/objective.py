"""Which objective of the smoother is nearer the truth where the process noise follows the state?

    python experiments/objective/objective.py -o out/objective

One object moves by CTRV and its own noise; its position is measured at a steady rate. The smoother is solved to
convergence with each objective, the whole track in its window.
"""

import csv
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import SPEED, YAW, FloatArray
from fgtrack.estimation.base import Measurement, Start
from fgtrack.estimation.birth import initial_state
from fgtrack.estimation.factor_graph.smoother import FixedLagSmoother
from fgtrack.evaluation.paired import average
from fgtrack.models.measurement import measurement_model
from fgtrack.models.motion import CTRV
from fgtrack.sim.draw import drawn

START_NS = 1_790_000_000 * NS_PER_S
STD_M = 0.3
NUM_STAMPS = 20
#: Process noise: of the paper, as fitted to the default scenario (configs/tuned.yaml), and of an object that turns
#: quickly and hardly slides, where Q follows the speed most.
NOISE = {
    "paper": CTRV(),
    "fitted": CTRV.from_std_per_step({"position": 0.2, "yaw": 0.034, "speed": 6.55, "yaw_rate": 0.667}, 100.0),
    "agile": CTRV.from_std_per_step({"position": 0.05, "yaw": 3.0, "speed": 3.0, "yaw_rate": 3.0}, 100.0),
}
#: Noise, speed in m/s and rate in Hz.
CASES = (
    *product(("paper", "fitted"), ((65.0, 20.0), (12.0, 2.0), (1.5, 2.0))),
    *product(("agile",), ((12.0, 10.0), (12.0, 2.0), (5.0, 2.0), (1.5, 2.0))),
)
OBJECTIVES = ("reweighted", "map")


class Outcome(NamedTuple):
    """Of one track and one objective."""

    means: FloatArray
    """Shape (NUM_STAMPS, 5)."""
    sigma: FloatArray
    """Standard deviations, shape (NUM_STAMPS, 5)."""
    squared_m2: FloatArray
    """Squared position error, shape (NUM_STAMPS,)."""
    speed_mps: FloatArray
    """Error of the speed, shape (NUM_STAMPS,)."""
    nees: FloatArray
    """Normalised squared error of all five entries, shape (NUM_STAMPS,)."""


def track(noise: str, speed_mps: float, rate_hz: float, seed: int) -> dict[str, Outcome]:
    """Both objectives on one track."""
    motion, rng = NOISE[noise], np.random.default_rng([seed, round(10 * speed_mps), round(rate_hz)])
    start = Start(
        stamp_ns=START_NS,
        yaw_rad=0.4,
        yaw_std_rad=0.2,
        speed_mps=speed_mps,
        speed_std_mps=0.2 * speed_mps,
        yaw_rate_std_radps=0.1,
    )
    mean, covariance = initial_state(motion, start)
    x = mean + np.linalg.cholesky(covariance) @ rng.standard_normal(5)
    model, R, truth, measurements = measurement_model(("x_m", "y_m"), motion), STD_M**2 * np.eye(2), [], []
    for k in range(1, NUM_STAMPS + 1):
        x = drawn(motion, x, 1.0 / rate_hz, rng)
        truth.append(x)
        stamp_ns = START_NS + round(k * NS_PER_S / rate_hz)
        measurements.append(Measurement(stamp_ns, model, x[:2] + STD_M * rng.standard_normal(2), R))
    return {objective: _outcome(motion, objective, start, measurements, np.array(truth)) for objective in OBJECTIVES}


def _outcome(motion: CTRV, objective: str, start: Start, measurements: list[Measurement], truth: FloatArray) -> Outcome:
    estimator = fgtrack.estimator("smoother", motion, start, lag_s=1e3, objective=objective)
    assert isinstance(estimator, FixedLagSmoother)
    for measurement in measurements:
        estimator.update(measurement)
    estimator.converge(100)
    states = [estimator.state_at(measurement.stamp_ns) for measurement in measurements]
    means = np.array([state.mean for state in states])
    e = means - truth
    e[:, YAW] = np.remainder(e[:, YAW] + np.pi, 2.0 * np.pi) - np.pi
    nees = [float(each @ np.linalg.solve(state.covariance, each)) for each, state in zip(e, states, strict=True)]
    sigma = np.sqrt([np.diag(state.covariance) for state in states])
    return Outcome(means, sigma, np.sum(e[:, :2] ** 2, axis=1), e[:, SPEED], np.array(nees))


def interval(values: FloatArray) -> tuple[float, float]:
    """Mean of `values` (runs,) and half of its 95 % interval."""
    found = average(values)
    return found.mean, found.high - found.mean


def summary(speed_mps: float, rate_hz: float, runs: list[dict[str, Outcome]]) -> dict[str, float]:
    """A row of the table; differences are `map` minus `reweighted`, paired."""
    both = [(run["reweighted"], run["map"]) for run in runs]
    gaps = np.array([(np.abs(b.means - a.means) / a.sigma).max() for a, b in both])
    row = {"speed_mps": speed_mps, "rate_hz": rate_hz, "runs": len(runs)}
    row["gap_median_sd"], row["gap_90_sd"] = np.quantile(gaps, [0.5, 0.9]).tolist()
    for place, which in ((slice(-1, None), "newest"), (slice(None), "smoothed")):
        squared = np.array([[one.squared_m2[place].mean() for one in pair] for pair in both])
        speed = np.array([[one.speed_mps[place].mean() for one in pair] for pair in both])
        speed2 = np.array([[np.square(one.speed_mps[place]).mean() for one in pair] for pair in both])
        nees = np.array([[one.nees[place].mean() for one in pair] for pair in both])
        for name, values in (("mse_m2", squared), ("speed_bias_mps", speed), ("speed_mse", speed2), ("nees", nees)):
            for column, objective in enumerate(OBJECTIVES):
                row[f"{which}_{name}_{objective}"], row[f"{which}_{name}_{objective}_pm"] = interval(values[:, column])
            row[f"{which}_{name}_difference"], row[f"{which}_{name}_difference_pm"] = interval(
                values[:, 1] - values[:, 0]
            )
    return row


def table(rows: Sequence[tuple[str, dict[str, float]]], which: str) -> str:
    """Markdown: RMSE, NEES and speed of both objectives, and paired differences with 95 % intervals."""
    lines = [
        f"{which} state | gap, median (90 %) [sd] | position RMSE [m] reweighted, map | MSE ratio - 1 [%] "
        "| speed RMSE [m/s] | speed bias [m/s] | NEES (expected 5) | NEES difference",
        "|".join(["---"] * 8),
    ]
    for noise, row in rows:

        def pair(name: str, root: bool = False, row: dict[str, float] = row) -> str:
            found = [row[f"{which}_{name}_{objective}"] for objective in OBJECTIVES]
            return ", ".join(f"{np.sqrt(value) if root else value:.3f}" for value in found)

        def change(name: str, scale: float, row: dict[str, float] = row) -> str:
            difference = (row[f"{which}_{name}_difference{end}"] / scale for end in ("", "_pm"))
            return "{:+.2f} +- {:.2f}".format(*difference)

        lines.append(
            f"{noise}, {row['speed_mps']:g} m/s, {row['rate_hz']:g} Hz "
            f"| {row['gap_median_sd']:.3f} ({row['gap_90_sd']:.3f}) "
            f"| {pair('mse_m2', True)} | {change('mse_m2', row[f'{which}_mse_m2_reweighted'] / 100.0)} "
            f"| {pair('speed_mse', True)} | {pair('speed_bias_mps')} | {pair('nees')} | {change('nees', 1.0)}"
        )
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def main(
    out: Annotated[Path, typer.Option("-o", "--out")] = Path("out/objective"),
    runs: Annotated[int, typer.Option(help="Tracks per case.")] = 60,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
    seed: int = 1,
) -> None:
    """Write the rows (CSV) and the two tables (Markdown)."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for noise, (speed_mps, rate_hz) in CASES:
        tasks = (delayed(track)(noise, speed_mps, rate_hz, seed + k) for k in range(runs))
        rows.append((noise, summary(speed_mps, rate_hz, Parallel(jobs)(tasks))))
    with (out / "objective.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["noise", *rows[0][1]])
        writer.writerows([noise, *row.values()] for noise, row in rows)
    text = "\n".join(table(rows, which) for which in ("newest", "smoothed"))
    (out / "objective.md").write_text(text)
    print(text)


if __name__ == "__main__":
    typer.run(main)
