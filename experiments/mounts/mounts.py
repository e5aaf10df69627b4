"""Coverage and width of the intervals of mounts, over simulated drives."""

import argparse
import csv
import time
from pathlib import Path

import numpy as np
from drives import NEWCOMER, bound, drive

import fgtrack

COMPONENTS = ("yaw_rad", "x_m", "y_m")
NORMAL = 1.96


def rows_of(seed: int) -> list[dict[str, object]]:
    """Return error, interval and bound of each component of each sensor."""
    one = drive(seed, NEWCOMER)
    start_s = time.process_time()
    mounts = fgtrack.mounts(one.messages)
    cpu_s = time.process_time() - start_s
    rows: list[dict[str, object]] = []
    for sensor, stds in zip(one.sensors[1:], bound(one), strict=True):
        item = mounts[sensor.name]
        for component, half, std_bound in zip(
            COMPONENTS, item.half_widths, stds, strict=True
        ):
            error = getattr(item, component) - getattr(sensor, component)
            rows.append(
                {
                    "seed": seed,
                    "sensor": sensor.name,
                    "component": component,
                    "error": error,
                    "half_width": half,
                    "bound": NORMAL * std_bound,
                    "cpu_s": cpu_s,
                }
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", type=Path, default=Path("out/mounts"))
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed in range(options.first, options.first + options.seeds):
        rows += rows_of(seed)
    with (options.o / "mounts.csv").open("w", newline="") as out:
        writer = csv.DictWriter(out, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    for component in COMPONENTS:
        mine = [row for row in rows if row["component"] == component]
        error, half, best = (
            np.array([float(row[key]) for row in mine])
            for key in ("error", "half_width", "bound")
        )  # type: ignore[arg-type]
        covered = float(np.mean(np.abs(error) < half))
        ratio = half / best
        rms = float(np.sqrt(np.mean((NORMAL * error / best) ** 2)))
        print(
            f"{component}: {covered:.1%} of {len(mine)} intervals contain the mount; "
            "width over the bound: "
            f"median {np.median(ratio):.2f}, 90 % below {np.quantile(ratio, 0.9):.2f}; "
            f"rms error over the bound {rms:.2f}"
        )
    print(
        f"processor time of a drive: {np.mean([float(row['cpu_s']) for row in rows]):.2f} s"
    )  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
