"""Where does backward-forward become worse than dropping what is late?

    python experiments/delay_sweep/delay_sweep.py -o out/delay

Draws the table of the sweep configs/sweeps/delay.yaml in the folder; where there is none the sweep is run first.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from matplotlib.axes import Axes
from scipy.stats import t

import fgtrack
from fgtrack import FloatArray
from fgtrack.show import log_axis

SWEEP = Path(__file__).parents[2] / "configs/sweeps/delay.yaml"
QUICK_SEEDS = 2
ESTIMATORS = (
    "smoother",
    "ekf-replay",
    "ekf-backward-forward",
    "drop",
    "reorder-buffer",
    "as-current",
)
POSITION, SPEED = (
    f"truth.overall.errors.{name}.rmse" for name in ("position_m", "speed_mps")
)
SHOWN_HZ = 20.0
RATIOS, ERRORS_M = (0.3, 5.0), (0.15, 12.0)  # of the figure

#: RMSE by delay of the LiDAR in s, rate in Hz and estimator: one for each seed, in their order.
Errors = Mapping[tuple[float, float, str], FloatArray]


def errors(rows: list[dict[str, str]], column: str) -> Errors:
    found: dict[tuple[float, float, str], list[float]] = {}
    for row in rows:
        point = float(row["lidar_delay_s"]), float(row["rate_hz"]), row["estimator"]
        found.setdefault(point, []).append(float(row[column]))
    return {point: np.array(values) for point, values in found.items()}


def ratio(of: FloatArray, to: FloatArray) -> tuple[float, float, float]:
    """Geometric mean over the seeds of `of / to`, which are paired, and its 95 % interval."""
    logs = np.log(of / to)
    half = t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    low, middle, high = np.exp(logs.mean() + np.array([-half, 0.0, half])).tolist()
    return middle, low, high


def crossing_s(delays_s: list[float], ratios: list[float]) -> float:
    """Delay at which the ratio rises through 1 for the last time, NaN where it ends below; lines between the points."""
    logs = np.log(ratios)
    last = max(np.flatnonzero(logs <= 0.0), default=-1)
    if not 0 <= last < len(logs) - 1:
        return np.nan
    return float(np.interp(0.0, logs[last : last + 2], delays_s[last : last + 2]))


def draw_ratio(axis: Axes, found: Errors, what: str) -> None:
    """RMSE of backward-forward over that of dropping: a line for each rate."""
    rates_hz = sorted({rate_hz for _, rate_hz, _ in found})
    delays_s = sorted({delay_s for delay_s, _, _ in found})
    for index, rate_hz in enumerate(rates_hz):
        points = [
            (found[d, rate_hz, "ekf-backward-forward"], found[d, rate_hz, "drop"])
            for d in delays_s
        ]
        middle, low, high = np.array([ratio(*point) for point in points]).T
        shift_ms = 2.0 * (
            index - (len(rates_hz) - 1) / 2
        )  # so that bars do not hide each other
        axis.errorbar(
            1e3 * np.array(delays_s) + shift_ms,
            middle,
            yerr=(middle - low, high - middle),
            color=plt.get_cmap("viridis")(0.9 * index / max(len(rates_hz) - 1, 1)),
            marker="os^vD"[index % 5],
            ms=4,
            lw=1.2,
            elinewidth=0.8,
            label=f"{rate_hz:g} Hz",
        )
    axis.axhline(1.0, color="black", lw=1.0)
    axis.set(
        xlabel="mean delay of the LiDAR [ms]",
        yscale="log",
        ylim=RATIOS,
        title=f"{what}: backward-forward / drop",
    )
    log_axis(axis.yaxis)
    axis.legend(
        title="both sensors at",
        fontsize=8,
        title_fontsize=8,
        ncols=2,
        loc="lower right",
    )


def draw_errors(axis: Axes, found: Errors) -> None:
    """Position RMSE of every estimator over the delay, at one rate."""
    delays_s = sorted({delay_s for delay_s, _, _ in found})
    for index, name in enumerate(ESTIMATORS):
        rmse_m = [found[delay_s, SHOWN_HZ, name].mean() for delay_s in delays_s]
        axis.plot(
            1e3 * np.array(delays_s),
            rmse_m,
            marker="os^vDP"[index],
            ms=4,
            ls="--" if index == 1 else "-",
            label=name,
        )
    axis.set(
        xlabel="mean delay of the LiDAR [ms]",
        yscale="log",
        ylim=ERRORS_M,
        title=f"position RMSE at {SHOWN_HZ:g} Hz [m]",
    )
    log_axis(axis.yaxis)
    axis.legend(fontsize=8, ncols=2, loc="upper left")


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder of the sweep and the figure.")
    ] = Path("out/delay"),
    quick: Annotated[
        bool,
        typer.Option(
            help=f"Run {QUICK_SEEDS} seeds only, where there is no sweep yet."
        ),
    ] = False,
) -> None:
    """Write ratios.csv and delay.png beside sweep.csv."""
    rows = fgtrack.sweep(SWEEP, out, num_seeds=QUICK_SEEDS if quick else None).to_dict(
        "records"
    )
    position, speed = errors(rows, POSITION), errors(rows, SPEED)
    rates_hz = sorted({rate_hz for _, rate_hz, _ in position})
    delays_s = sorted({delay_s for delay_s, _, _ in position})
    seeds = min(len(values) for values in position.values())
    names = ("ekf-backward-forward", "ekf-replay", "smoother")
    with (out / "ratios.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        header = [
            f"{name}_{what}"
            for name in names
            for what in ("position", "low", "high", "speed")
        ]
        writer.writerow(["rate_hz", "delay_s", "drop_m", "drop_mps", *header])
        for rate_hz in rates_hz:
            for delay_s in delays_s:
                to, to_speed = (
                    position[delay_s, rate_hz, "drop"],
                    speed[delay_s, rate_hz, "drop"],
                )
                line = [to.mean(), to_speed.mean()]
                for name in names:
                    of, of_speed = (
                        position[delay_s, rate_hz, name],
                        speed[delay_s, rate_hz, name],
                    )
                    line += [*ratio(of, to), ratio(of_speed, to_speed)[0]]
                writer.writerow(
                    [
                        f"{rate_hz:g}",
                        f"{delay_s:g}",
                        *(f"{value:.2f}" for value in line),
                    ]
                )
    figure, axes = plt.subplots(1, 3, figsize=(13.0, 4.2), layout="constrained")
    draw_ratio(axes[0], position, "position RMSE")
    draw_ratio(axes[1], speed, "speed RMSE")
    draw_errors(axes[2], position)
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(out / "delay.png", dpi=150)
    plt.close(figure)
    print((out / "ratios.csv").read_text() + f"seeds: {seeds}")
    print("position: backward-forward is worse than dropping from [ms]")
    for rate_hz in rates_hz:
        points = [
            (position[d, rate_hz, "ekf-backward-forward"], position[d, rate_hz, "drop"])
            for d in delays_s
        ]
        found_ms = 1e3 * crossing_s(delays_s, [ratio(*point)[0] for point in points])
        print(f"{rate_hz:g} Hz: {found_ms:.0f}")
    print(f"figure: {out / 'delay.png'}")


if __name__ == "__main__":
    typer.run(main)
