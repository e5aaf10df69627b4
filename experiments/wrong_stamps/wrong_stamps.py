"""How wrong may the stamps of a sensor be before they cost more than delay compensation wins?

    python experiments/wrong_stamps/wrong_stamps.py -o out/wrong_stamps

Draws the table of the sweep configs/sweeps/wrong_stamps.yaml in the folder; where there is none the sweep is run first.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from matplotlib.axes import Axes

import fgtrack
from fgtrack import FloatArray
from fgtrack.show import PALETTE, log_axis

SWEEP = Path(__file__).parents[2] / "configs/sweeps/wrong_stamps.yaml"
QUICK_SEEDS = 2
ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
RMSE = "truth.overall.errors.position_m.rmse"
NIS = "consistency.nis.lidar_cluster.mean"
NEES = "consistency.position_nees.mean"
RIGHT, ARRIVAL = "right", "arrival"
EFFECTS = ("jitter", "quantised", "drift", "offset, late", "offset, early")

#: Root mean square of the stamps' error over the number in the label: steps and drifts are uniform from 0 to theirs.
RMS = {
    "jitter": 1.0,
    "quantised": 1.0 / np.sqrt(3.0),
    "drift": 1.0 / np.sqrt(3.0),
    "offset": 1.0,
}

#: By label of the clock and estimator: a value for each seed, in their order.
Found = Mapping[tuple[str, str], FloatArray]


def values(rows: list[dict[str, str]], column: str) -> Found:
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        found.setdefault((row["clock"], row["estimator"]), []).append(
            float(row[column])
        )
    return {key: np.array(some) for key, some in found.items()}


def effects(labels: list[str]) -> dict[str, list[tuple[float, str]]]:
    """By effect: root mean square error of the stamps in ms, ascending, and the label."""
    found: dict[str, list[tuple[float, str]]] = {name: [] for name in EFFECTS}
    for label in labels:
        kind, _, size = label.partition(" ")
        if kind in RMS:
            name = (
                kind
                if kind != "offset"
                else "offset, early"
                if size.startswith("-")
                else "offset, late"
            )
            found[name].append((RMS[kind] * abs(float(size)), label))
    return {name: sorted(steps) for name, steps in found.items()}


def break_even(steps: list[tuple[float, str]], rmse: Found, estimator: str) -> str:
    """Error of the stamps from which the estimator is worse than with receipts for stamps."""
    excess = [
        float(np.mean(rmse[label, estimator] - rmse[ARRIVAL, estimator]))
        for _, label in steps
    ]
    for (before_ms, _), (after_ms, _), before, after in zip(
        steps, steps[1:], excess, excess[1:], strict=False
    ):
        if before <= 0.0 < after:
            return f"{np.interp(0.0, [before, after], [before_ms, after_ms]):.0f} ms"
    return f"not up to {steps[-1][0]:.0f} ms"


def draw(
    axis: Axes, found: Found, estimator: str, shown: dict[str, list[tuple[float, str]]]
) -> None:
    for index, (name, steps) in enumerate(shown.items()):
        some = [found[label, estimator] for _, label in steps]
        axis.errorbar(
            [ms for ms, _ in steps],
            [seeds.mean() for seeds in some],
            yerr=[seeds.std(ddof=1) / np.sqrt(len(seeds)) for seeds in some],
            color=PALETTE[index],
            marker="os^vD"[index],
            ms=4,
            lw=1.2,
            elinewidth=0.8,
            label=name,
        )
    axis.axhline(
        found[ARRIVAL, estimator].mean(),
        color="black",
        ls="--",
        lw=1.0,
        label="receipt as stamp",
    )
    axis.axhline(
        found[RIGHT, estimator].mean(),
        color="black",
        ls=":",
        lw=1.2,
        label="right clock",
    )
    axis.set(xscale="log")
    log_axis(axis.xaxis)
    axis.grid(alpha=0.3)


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder of the sweep and the figure.")
    ] = Path("out/wrong_stamps"),
    quick: Annotated[
        bool,
        typer.Option(
            help=f"Run {QUICK_SEEDS} seeds only, where there is no sweep yet."
        ),
    ] = False,
) -> None:
    """Write stamps.csv and stamps.png beside sweep.csv."""
    rows = fgtrack.sweep(SWEEP, out, num_seeds=QUICK_SEEDS if quick else None).to_dict(
        "records"
    )
    rmse, nis, nees = (values(rows, column) for column in (RMSE, NIS, NEES))
    labels = list(dict.fromkeys(label for label, _ in rmse))
    shown = effects(labels)
    header = [
        f"{name}_{what}"
        for name in ESTIMATORS
        for what in ("m", "more_m", "error_m", "nis", "nees")
    ]
    with (out / "stamps.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["clock", *header])
        for label in labels:
            line = []
            for name in ESTIMATORS:
                key = label, name
                more_m = rmse[key] - rmse[RIGHT, name]
                error_m = more_m.std(ddof=1) / np.sqrt(len(more_m))
                line += [
                    rmse[key].mean(),
                    more_m.mean(),
                    error_m,
                    nis[key].mean(),
                    nees[key].mean(),
                ]
            writer.writerow([label, *(f"{value:.3f}" for value in line)])
    figure, axes = plt.subplots(
        2, 3, figsize=(12.0, 6.4), sharex=True, sharey="row", layout="constrained"
    )
    for column, name in enumerate(ESTIMATORS):
        draw(axes[0, column], rmse, name, shown)
        draw(axes[1, column], nis, name, shown)
        axes[0, column].set(title=name)
        axes[1, column].set(
            xlabel="root mean square error of the LiDAR's stamps [ms]", yscale="log"
        )
    axes[0, 0].set(ylabel="position RMSE [m]")
    axes[1, 0].set(ylabel="NIS of the LiDAR (2 if consistent)")
    log_axis(axes[1, 0].yaxis)
    axes[0, 0].legend(fontsize=8)
    figure.savefig(out / "stamps.png", dpi=150)
    plt.close(figure)
    print((out / "stamps.csv").read_text() + f"seeds: {min(map(len, rmse.values()))}")
    for name in ESTIMATORS:
        if rmse[RIGHT, name].mean() >= rmse[ARRIVAL, name].mean():
            print(f"{name}: right clocks are worse than receipts for stamps")
            continue
        limits = ", ".join(
            f"{effect} {break_even(steps, rmse, name)}"
            for effect, steps in shown.items()
        )
        print(
            f"{name} is worse than with receipts for stamps from (root mean square error): {limits}"
        )
    print(f"figure: {out / 'stamps.png'}")


if __name__ == "__main__":
    typer.run(main)
