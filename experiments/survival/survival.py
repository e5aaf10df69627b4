"""Which share of the RADAR updates does the backward-forward step wipe?

    python experiments/survival/survival.py -o out/survival

A LiDAR update that arrives after a RADAR update and was measured before it starts from the state before both, so the
RADAR update is gone. Runs of the tracker over LiDAR delays and rates, counted in their updates.csv.
The tracker ticks at every message: between ticks it sorts what came in, and a tick of 20 ms saves as much delay.
"""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer

from fgtrack import Config, FloatArray, Run, replay, simulate
from fgtrack.config import ClockConfig
from fgtrack.sim import ConstantDelay, Scenario, SimulatedSensor, TrackVehicle

RADAR_DELAY_S = 0.062
LIDAR_DELAYS_S = (0.062, 0.08, 0.1, 0.12, 0.151, 0.2)
LIDAR_RATES_HZ = (5.0, 10.0, 20.0)


def scenario(lidar_delay_s: float, lidar_rate_hz: float, duration_s: float) -> Scenario:
    """One car ahead, always seen by both sensors; the RADAR's stamps are spread over its period."""
    lidar = SimulatedSensor(
        "lidar_cluster",
        {"x_m": 0.3, "y_m": 0.3},
        rate_hz=lidar_rate_hz,
        delay=ConstantDelay(lidar_delay_s),
    )
    radar = SimulatedSensor(
        "radar",
        {"x_m": 1.0, "y_m": 1.0, "speed_mps": 0.2},
        rate_hz=20.0,
        jitter_s=0.049,
        delay=ConstantDelay(RADAR_DELAY_S),
    )
    ego = TrackVehicle(arc_m=100.0, speed=((0.0, 65.0), (duration_s, 65.0)))
    return Scenario(
        ego,
        (replace(ego, arc_m=140.0),),
        (lidar, radar),
        duration_s=duration_s,
        detection_origin_x_m=-1.74,
    )


def expected_share(
    lidar_delay_s: FloatArray | float, lidar_rate_hz: float
) -> FloatArray:
    """min(1, (d_LiDAR - d_RADAR) f_LiDAR): how often a scan falls into the time by which the LiDAR is later."""
    return np.minimum(1.0, (np.asarray(lidar_delay_s) - RADAR_DELAY_S) * lidar_rate_hz)


def wiped_share(run: Run) -> float:
    """Share of the RADAR updates that a later update of the same track, with an older stamp, has wiped."""
    fused = run.tables["updates"].where(
        np.isin(
            run.tables["updates"]["disposition"], ["in_sequence", "out_of_sequence"]
        )
    )
    wiped: list[bool] = []
    for track_id in np.unique(fused["track_id"]):
        own = fused.where(fused["track_id"] == track_id)
        oldest_after_ns = np.minimum.accumulate(own["stamp_ns"][::-1])[::-1]
        lost = oldest_after_ns[1:] < own["stamp_ns"][:-1]
        wiped += lost[own["sensor"][:-1] == "radar"].tolist()
    return float(np.mean(wiped))


def main(
    out: Annotated[
        Path, typer.Option("-o", help="Folder for the table and the figure.")
    ] = Path("out/survival"),
    duration_s: float = 30.0,
    seed: int = 0,
) -> None:
    """Run the tracker over all delays and rates, write survival.csv and survival.png."""
    out.mkdir(parents=True, exist_ok=True)
    config = Config.from_yaml("karle2023")
    config = replace(
        config,
        map=replace(config.map, track="oval", pit="oval"),
        clock=ClockConfig(node_hz=None),
    )
    rows = []
    for rate_hz in LIDAR_RATES_HZ:
        for delay_s in LIDAR_DELAYS_S:
            messages = simulate(scenario(delay_s, rate_hz, duration_s), seed=seed)
            measured = wiped_share(replay(messages, config))
            rows.append(
                (rate_hz, delay_s, measured, float(expected_share(delay_s, rate_hz)))
            )
    with (out / "survival.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["lidar_hz", "lidar_delay_s", "wiped", "expected"])
        writer.writerows(
            (f"{rate:g}", f"{delay:g}", f"{m:.3f}", f"{e:.3f}")
            for rate, delay, m, e in rows
        )
    figure, axis = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    for index, rate_hz in enumerate(LIDAR_RATES_HZ):
        some = [row for row in rows if row[0] == rate_hz]
        delays_s = np.linspace(
            RADAR_DELAY_S, LIDAR_DELAYS_S[-1], 500
        )  # dense: the line has a kink
        axis.plot(
            1e3 * delays_s, 100.0 * expected_share(delays_s, rate_hz), color=f"C{index}"
        )
        label = f"LiDAR {rate_hz:g} Hz"
        axis.plot(
            [1e3 * row[1] for row in some],
            [100.0 * row[2] for row in some],
            "o",
            color=f"C{index}",
            label=label,
        )
    axis.set(xlabel="LiDAR delay [ms] (RADAR: 62 ms)", ylabel="RADAR updates wiped [%]")
    axis.grid(alpha=0.3)
    axis.legend(
        title="dots: measured\nlines: min(1, (d_L - d_R) f_L)",
        fontsize=8,
        title_fontsize=8,
    )
    figure.savefig(out / "survival.png", dpi=150)
    plt.close(figure)
    largest = max(abs(measured - expected) for *_, measured, expected in rows)
    print(
        f"{(out / 'survival.csv').read_text()}largest difference: {100.0 * largest:.1f} points"
    )
    print(f"figure: {out / 'survival.png'}")


if __name__ == "__main__":
    typer.run(main)
