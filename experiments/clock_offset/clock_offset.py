"""How well is the clock offset of a sensor known, after how long, and who has to move for it?

    python experiments/clock_offset/clock_offset.py -o out/clock_offset

The LiDAR's stamps are shifted by a known offset; it is estimated against the RADAR from ever longer beginnings of two
recordings: the default scenario, and one with its sensors in which the ego overtakes slow cars.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from joblib import Parallel, delayed

from fgtrack import Config, estimate_offsets, nanoseconds, read_scenario, simulate
from fgtrack.sim import OffsetClock, Scenario, TrackVehicle

WRONG, REFERENCE = "lidar_cluster", "radar"
OFFSETS_S = (-0.04, 0.0, 0.04)
LENGTHS_S = {"default": (20.0, 40.0, 60.0), "traffic": (5.0, 10.0, 20.0, 40.0)}
EGO_MPS, SLOW_MPS, GAP_M = 60.0, 30.0, 90.0


def scenario(name: str, offset_s: float) -> Scenario:
    made = read_scenario("default")
    sensors = tuple(
        replace(one, clock=(OffsetClock(offset_s),) if one.name == WRONG else ())
        for one in made.sensors
    )
    made = replace(made, sensors=sensors, duration_s=max(LENGTHS_S[name]))
    if name == "default":
        return made
    count = int((EGO_MPS - SLOW_MPS) * made.duration_s / GAP_M) + 1
    slow = tuple(
        TrackVehicle(
            arc_m=150.0 + GAP_M * i,
            lateral_m=2.5 if i % 2 else 4.5,
            speed=((0.0, SLOW_MPS),),
        )
        for i in range(count)
    )
    ego = TrackVehicle(arc_m=100.0, lateral_m=-2.0, speed=((0.0, EGO_MPS),))
    return replace(made, ego=ego, opponents=slow)


def configuration() -> Config:
    """The smoother's, with what the simulated sensors are really like."""
    config = Config.from_yaml("configs/smoother.yaml").replace(
        {"map.track": "oval", "map.pit": "oval"}
    )
    std = {one.name: one.std for one in read_scenario("default").sensors}
    return replace(
        config,
        sensors={
            name: replace(sensor, std=std.get(name, sensor.std))
            for name, sensor in config.sensors.items()
        },
    )


@dataclass(frozen=True)
class Row:
    recording: str
    true_s: float
    seed: int
    length_s: float
    offset_s: float
    std_s: float
    known: bool


def rows(
    name: str, true_s: float, seed: int, lengths_s: tuple[float, ...]
) -> Iterator[Row]:
    """An estimate for each length of one recording; NaN where there is none."""
    made = scenario(name, true_s)
    messages = list(simulate(made, seed=seed))
    for length_s in lengths_s:
        end_ns = made.start_ns + nanoseconds(length_s)
        report = estimate_offsets(
            [one for one in messages if one.receipt_ns <= end_ns],
            configuration(),
            REFERENCE,
        )
        found = next(one for one in report.sensors if one.sensor == WRONG)
        offset_s, std_s = (
            np.nan if value is None else value
            for value in (found.offset_s, found.std_s)
        )
        yield Row(name, true_s, seed, length_s, offset_s, std_s, found.is_known)


def draw(found: list[Row], file: Path) -> None:
    """Estimates with two standard deviations over the length, one panel for each recording."""
    figure, axes = plt.subplots(
        1, len(LENGTHS_S), figsize=(9.0, 3.8), sharey=True, layout="constrained"
    )
    seed = min(row.seed for row in found)
    for axis, name in zip(axes, LENGTHS_S, strict=True):
        for index, true_s in enumerate(OFFSETS_S):
            mine = [
                row
                for row in found
                if (row.recording, row.true_s, row.seed) == (name, true_s, seed)
            ]
            axis.axhline(1e3 * true_s, color=f"C{index}", lw=0.8, ls="--")
            axis.errorbar(
                [row.length_s for row in mine],
                [1e3 * row.offset_s for row in mine],
                [2e3 * row.std_s for row in mine],
                color=f"C{index}",
                marker="o",
                ms=4,
                capsize=3,
                label=f"true offset {1e3 * true_s:+.0f} ms",
            )
        axis.set(title=f"{name} recording", xlabel="length of the recording [s]")
        axis.grid(alpha=0.3)
    axes[0].set(ylabel="estimated offset, 2 std [ms]", ylim=(-100.0, 100.0))
    axes[-1].legend(fontsize=8)
    figure.savefig(file, dpi=150)
    plt.close(figure)


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for the table and the figure.")
    ] = Path("out/clock_offset"),
    seeds: Annotated[
        int,
        typer.Option(help="Seeds at the full length; all lengths for the first one."),
    ] = 1,
    jobs: Annotated[int, typer.Option(help="Processes.")] = 1,
) -> None:
    """Estimate all offsets, write clock_offset.csv and clock_offset.png."""
    out.mkdir(parents=True, exist_ok=True)
    calls = [
        (name, true_s, seed, lengths_s if seed == 0 else lengths_s[-1:])
        for name, lengths_s in LENGTHS_S.items()
        for true_s in OFFSETS_S
        for seed in range(seeds)
    ]
    found = [
        row
        for part in Parallel(jobs)(delayed(listed)(*call) for call in calls)
        for row in part
    ]
    with (out / "clock_offset.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["recording", "true_ms", "seed", "length_s", "offset_ms", "std_ms", "known"]
        )
        for row in found:
            numbers = (f"{1e3 * value:.2f}" for value in (row.offset_s, row.std_s))
            writer.writerow(
                [
                    row.recording,
                    f"{1e3 * row.true_s:.0f}",
                    row.seed,
                    row.length_s,
                    *numbers,
                    row.known,
                ]
            )
    draw(found, out / "clock_offset.png")
    print(
        (out / "clock_offset.csv").read_text() + f"figure: {out / 'clock_offset.png'}"
    )


def listed(
    name: str, true_s: float, seed: int, lengths_s: tuple[float, ...]
) -> list[Row]:
    return list(rows(name, true_s, seed, lengths_s))


if __name__ == "__main__":
    typer.run(main)
