"""What do bursts of late or lost lists cost, over the share of the time and their length?

    python experiments/bursts/bursts.py -o out/bursts

Draws the table of the sweep configs/sweeps/bursts.yaml in the folder; where there is none the sweep is run first.
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
from fgtrack.show import style_of

SWEEP = Path(__file__).parents[2] / "configs/sweeps/bursts.yaml"
QUICK_SEEDS = 2
ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward", "drop")
RMSE = "truth.overall.errors.position_m.rmse"
FUSED = tuple(
    f"sensors.lidar_cluster.dispositions.{name}"
    for name in ("in_sequence", "out_of_sequence", "beyond_window")
)
BAD = ("late", "lost")

#: By what becomes of a list in a burst, share of the time in bursts, their mean length in s, and estimator: a value for
#: each seed, in their order.
Found = Mapping[tuple[str, float, float, str], FloatArray]


def values(rows: list[dict[str, str]], columns: tuple[str, ...]) -> Found:
    """Sums of `columns`."""
    found: dict[tuple[str, float, float, str], list[float]] = {}
    for row in rows:
        share, length_s = (float(part) for part in row["burst"].split(" x "))
        found.setdefault((row["bad"], share, length_s, row["estimator"]), []).append(
            sum(float(row[column]) for column in columns)
        )
    return {point: np.array(some) for point, some in found.items()}


def draw(axis: Axes, found: Found, bad: str, length_s: float) -> None:
    """Position RMSE of each estimator over the share of the time, for bursts of one length."""
    points = sorted(
        {point[1:3] for point in found if point[1] == 0.0 or point[2] == length_s}
    )
    for index, name in enumerate(ESTIMATORS):
        some = [found[bad, *point, name] for point in points]
        shares = np.array([share for share, _ in points])
        axis.errorbar(
            100.0 * shares + 0.6 * (index - 1.5),  # so that bars do not hide each other
            [seeds.mean() for seeds in some],
            yerr=[seeds.std(ddof=1) / np.sqrt(len(seeds)) for seeds in some],
            color=style_of(name).colour,
            ls="--" if name == "ekf-replay" else "-",
            marker="os^v"[index],
            ms=4,
            lw=1.2,
            elinewidth=0.8,
            label=name,
        )
    axis.grid(alpha=0.3)


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder of the sweep and the figure.")
    ] = Path("out/bursts"),
    quick: Annotated[
        bool,
        typer.Option(
            help=f"Run {QUICK_SEEDS} seeds only, where there is no sweep yet."
        ),
    ] = False,
) -> None:
    """Write bursts.csv and bursts.png beside sweep.csv."""
    rows = fgtrack.sweep(SWEEP, out, num_seeds=QUICK_SEEDS if quick else None).to_dict(
        "records"
    )
    found, fused = values(rows, (RMSE,)), values(rows, FUSED)
    lengths_s = sorted({length_s for _, share, length_s, _ in found if share > 0.0})
    with (out / "bursts.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        header = [f"{name}_{what}" for name in ESTIMATORS for what in ("m", "error_m")]
        writer.writerow(["bad", "share", "length_s", "fused", *header])
        for bad, share, length_s in dict.fromkeys(point[:3] for point in found):
            some = [found[bad, share, length_s, name] for name in ESTIMATORS]
            lists = fused[bad, share, length_s, ESTIMATORS[0]].mean()
            line = [
                value
                for seeds in some
                for value in (seeds.mean(), seeds.std(ddof=1) / np.sqrt(len(seeds)))
            ]
            writer.writerow(
                [
                    bad,
                    f"{share:g}",
                    f"{length_s:g}",
                    f"{lists:.0f}",
                    *(f"{value:.3f}" for value in line),
                ]
            )
    figure, axes = plt.subplots(
        2,
        len(lengths_s),
        figsize=(12.0, 6.0),
        sharex=True,
        sharey=True,
        layout="constrained",
    )
    for row, bad in enumerate(BAD):
        for column, length_s in enumerate(lengths_s):
            draw(axes[row, column], found, bad, length_s)
            axes[0, column].set(title=f"bursts of {length_s:g} s")
            axes[1, column].set(xlabel="share of the time in bursts [%]")
        axes[row, 0].set(ylabel=f"LiDAR lists {bad}: position RMSE [m]")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(out / "bursts.png", dpi=150)
    plt.close(figure)
    print(
        (out / "bursts.csv").read_text()
        + f"seeds: {min(map(len, found.values()))}\nfigure: {out / 'bursts.png'}"
    )


if __name__ == "__main__":
    typer.run(main)
