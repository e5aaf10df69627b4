"""One long hull or two ships: how long until the tracks show it?

    python experiments/side_by_side/side_by_side.py -o out/side_by_side --seeds 5

One or two ships sail side by side. A LiDAR gives one to five returns of each hull in a list.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

import fgtrack
from fgtrack import NS_PER_S, Config, Detection, DetectionList, FloatArray

LENGTH_S = 60.0
PERIOD_S = 0.5
SPEED_MPS = 4.0
HULL_M = 14.0
NOISE_M = 0.5
DETECTED = 0.95
FALSE_PER_LIST = 1.0
SIDE_M = 150.0
#: Distances between the centre lines of both ships; None for one ship.
DISTANCES_M: tuple[float | None, ...] = (None, 8.0, 15.0, 25.0, 35.0)
#: Largest number of returns of a hull in a list.
RETURNS = (1, 2, 5)
NEAR_M = 10.0


class Row(NamedTuple):
    """Result of one scene."""

    distance_m: float | None
    """Distance between both ships; None for one ship."""
    returns: int
    """Largest number of returns of a hull in a list."""
    seed: int
    found_s: float
    """Time after which each ship has a confirmed track for the first time; infinite if one never has."""
    tracked: float
    """Share of the time after this in which each ship has a track of its own."""
    extra_s: float
    """Longest time with more confirmed tracks than ships."""


def lists(
    distance_m: float | None, returns: int, seed: int
) -> tuple[list[DetectionList], FloatArray]:
    """Return the lists of a scene, and the centres of the ships at each list, shape (lists, ships, 2)."""
    rng = np.random.default_rng(seed)
    course_rad = rng.uniform(0.0, 2.0 * np.pi)
    ahead = np.array([np.cos(course_rad), np.sin(course_rad)])
    aside = np.array([-ahead[1], ahead[0]])
    offsets_m = [0.0] if distance_m is None else [-0.5 * distance_m, 0.5 * distance_m]
    found, centres = [], []
    for k in range(round(LENGTH_S / PERIOD_S)):
        time_s = k * PERIOD_S
        own = [
            ahead * SPEED_MPS * (time_s - 0.5 * LENGTH_S) + aside * offset_m
            for offset_m in offsets_m
        ]
        centres.append(own)
        seen = [
            centre
            + ahead * rng.uniform(-0.5, 0.5) * HULL_M
            + rng.normal(0.0, NOISE_M, 2)
            for centre in own
            if rng.random() < DETECTED
            for _ in range(rng.integers(1, returns + 1))
        ]
        number = rng.poisson(FALSE_PER_LIST)
        seen += list(rng.uniform(-SIDE_M, SIDE_M, (number, 2)))
        stamp_ns = round(time_s * NS_PER_S)
        objects = [Detection(x_m=float(x), y_m=float(y)) for x, y in seen]
        found.append(
            DetectionList("lidar", stamp_ns, stamp_ns + 1_000_000, objects, frame="map")
        )
    return found, np.array(centres)


def measured(config: Config, distance_m: float | None, returns: int, seed: int) -> Row:
    """Return the result of one scene."""
    messages, centres = lists(distance_m, returns, seed)
    run = fgtrack.replay(messages, config)
    times_s = np.asarray(run.tracks["stamp_ns"]) / NS_PER_S
    confirmed = np.asarray(run.tracks["status"]) != "tentative"
    x_m = np.column_stack([run.tracks["x_m"], run.tracks["y_m"]])
    complete, extra = [], []
    stamps_s = np.arange(len(centres)) * PERIOD_S
    for time_s, own in zip(stamps_s, centres, strict=True):
        here = confirmed & (np.abs(times_s - time_s) < 0.5 * PERIOD_S)
        if here.any():
            here &= times_s == times_s[here].max()
        distances_m = np.linalg.norm(x_m[here][:, None] - own[None], axis=2)
        near = distances_m < HULL_M
        nearest = {int(k) for k in distances_m.argmin(axis=1)[near.any(axis=1)]}
        complete.append(len(nearest) == len(own))
        extra.append(int(near.any(axis=1).sum()) > len(own))
    first = next((k for k, holds in enumerate(complete) if holds), None)
    longest = run_length = 0
    for holds in extra:
        run_length = run_length + 1 if holds else 0
        longest = max(longest, run_length)
    return Row(
        distance_m,
        returns,
        seed,
        np.inf if first is None else float(stamps_s[first]),
        0.0 if first is None else float(np.mean(complete[first:])),
        longest * PERIOD_S,
    )


def configuration(sets: Mapping[str, Any]) -> Config:
    """Return the shipped configuration for ships with the keys `sets`."""
    return Config.from_yaml("autoferry").replace(dict(sets))


def main(
    output: Annotated[Path, typer.Option("-o", help="Folder of the table.")],
    seeds: Annotated[int, typer.Option(help="Number of scenes of each kind.")] = 5,
) -> None:
    """Print and write the table."""
    output.mkdir(parents=True, exist_ok=True)
    rows = []
    for distance_m in DISTANCES_M:
        for returns in RETURNS:
            own = [
                measured(configuration({}), distance_m, returns, seed)
                for seed in range(seeds)
            ]
            rows += own
            print(
                f"{'one ship' if distance_m is None else f'{distance_m:g} m'}, {returns} returns:"
                f" found after {max(each.found_s for each in own):g} s,"
                f" tracked {100 * np.mean([each.tracked for each in own]):.0f} %,"
                f" one track too many for {max(each.extra_s for each in own):g} s"
            )
    with (output / "side_by_side.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)


if __name__ == "__main__":
    typer.run(main)
