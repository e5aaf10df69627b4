"""Are the final tracks of late lists those of lists in order?

    python experiments/any_order/any_order.py -o out/any_order --seeds 10 --jobs 2

Twelve objects in clutter are seen by a LiDAR and a RADAR. The lists arrive in order, or with delays.
"""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack import NS_PER_S, Config, Detection, DetectionList, FloatArray, Run

NUM_OBJECTS = 12
LENGTH_S = 20.0
SIDE_M = 200.0
FALSE_PER_LIST = 4.0
PERIOD_S = 0.1
SPEED_STD_MPS = 6.0
STDS_M: Mapping[str, float] = {"lidar": 0.3, "radar": 0.8}
DETECTED: Mapping[str, float] = {"lidar": 0.85, "radar": 0.7}
OFFSETS_S: Mapping[str, float] = {"lidar": 0.013, "radar": 0.041}
#: Delays of the sensors, by label.
DELAYS_S: Mapping[str, Mapping[str, float]] = {
    "of the paper": {"lidar": 0.151, "radar": 0.062},
    "LiDAR 0.5 s": {"lidar": 0.5, "radar": 0.062},
    "LiDAR 1 s": {"lidar": 1.0, "radar": 0.062},
}
#: Associations, by label.
ASSOCIATIONS: Mapping[str, str] = {
    "decided once": "mahalanobis",
    "hypotheses": "hypotheses",
}
NEAR_M = 0.05


class Row(NamedTuple):
    """Result of one stream."""

    decisions: str
    delays: str
    seed: int
    share: float
    """Share of the final states of the stream in order that the late stream has too."""
    tracks: int
    """Number of confirmed tracks."""
    revised: int
    """Number of detections whose track late data has changed."""


def lists(seed: int) -> list[tuple[str, int, list[Detection]]]:
    """Return sensor, stamp and detections of all lists."""
    rng = np.random.default_rng(seed)
    first_m = rng.uniform(-0.5 * SIDE_M, 0.5 * SIDE_M, (NUM_OBJECTS, 2))
    velocities_mps = rng.normal(0.0, SPEED_STD_MPS, (NUM_OBJECTS, 2))
    begins_s = rng.uniform(0.0, 0.5 * LENGTH_S, NUM_OBJECTS)
    begins_s[: NUM_OBJECTS // 2] = 0.0
    ends_s = begins_s + rng.uniform(0.25, 1.0, NUM_OBJECTS) * LENGTH_S
    found = []
    for sensor, offset_s in OFFSETS_S.items():
        for time_s in np.arange(offset_s, LENGTH_S, PERIOD_S).tolist():
            seen = [
                first_m[k]
                + velocities_mps[k] * (time_s - begins_s[k])
                + rng.normal(0.0, STDS_M[sensor], 2)
                for k in range(NUM_OBJECTS)
                if begins_s[k] <= time_s < ends_s[k] and rng.random() < DETECTED[sensor]
            ]
            number = rng.poisson(FALSE_PER_LIST)
            seen += list(rng.uniform(-0.5 * SIDE_M, 0.5 * SIDE_M, (number, 2)))
            objects = [Detection(x_m=float(x), y_m=float(y)) for x, y in seen]
            found.append((sensor, round(time_s * NS_PER_S), objects))
    return sorted(found, key=lambda each: each[1])


def configuration(association: str) -> Config:
    """Return the tracker of the scene."""
    return Config.from_dict(
        {
            "estimator": "smoother-banded",
            "association": {"kind": association},
            "sensors": {
                name: {
                    "std": {"x_m": std_m, "y_m": std_m},
                    "detection_probability": DETECTED[name],
                    "clutter_per_m2": FALSE_PER_LIST / SIDE_M**2,
                }
                for name, std_m in STDS_M.items()
            },
            "motion": {"kind": "cv", "std_per_s": {"velocity": 5.0}},
            "birth": {"speed_std_mps": 10.0},
            "clock": {"node_hz": 50.0},
            "filter": {"storage_s": 3.0},
            "smoother": {"lag_s": 3.0},
        }
    )


def replayed(seed: int, delays_s: Mapping[str, float], association: str) -> Run:
    """Return the run of a scene whose lists arrive with these delays."""
    messages = [
        DetectionList(
            sensor,
            stamp_ns,
            stamp_ns + round(delays_s[sensor] * NS_PER_S),
            objects,
            frame="map",
        )
        for sensor, stamp_ns, objects in lists(seed)
    ]
    messages.sort(key=lambda each: each.receipt_ns)
    return fgtrack.replay(messages, configuration(association))


def final_states(run: Run) -> dict[int, FloatArray]:
    """Return the final positions (m, 2) of confirmed tracks, by stamp."""
    tracks, smoothed = run.tracks, run.smoothed
    confirmed = set(tracks["track_id"][tracks["status"] != "tentative"])
    final = smoothed[
        (smoothed["kind"] == "final") & smoothed["track_id"].isin(confirmed)
    ]
    found: dict[int, list[tuple[float, float]]] = {}
    for stamp_ns, x_m, y_m in final[["stamp_ns", "x_m", "y_m"]].itertuples(index=False):
        found.setdefault(int(stamp_ns), []).append((x_m, y_m))
    return {stamp_ns: np.array(points) for stamp_ns, points in found.items()}


def share(expected: Mapping[int, FloatArray], found: Mapping[int, FloatArray]) -> float:
    """Return the share of `expected` states with a state of `found` at the same stamp, at most 5 cm away."""
    total = equal = 0
    for stamp_ns, points in expected.items():
        total += len(points)
        others = found.get(stamp_ns)
        if others is not None:
            apart_m = np.linalg.norm(points[:, None] - others[None], axis=2)
            equal += int((apart_m.min(axis=1) <= NEAR_M).sum())
    return equal / max(total, 1)


def judged(seed: int, label: str) -> list[Row]:
    """Return the rows of one scene with one kind of decisions."""
    none = dict.fromkeys(OFFSETS_S, 0.0)
    expected = final_states(replayed(seed, none, ASSOCIATIONS[label]))
    rows = []
    for delays, delays_s in DELAYS_S.items():
        run = replayed(seed, delays_s, ASSOCIATIONS[label])
        tracks = run.tracks
        confirmed = set(tracks["track_id"][tracks["status"] != "tentative"])
        own = share(expected, final_states(run))
        rows.append(Row(label, delays, seed, own, len(confirmed), len(run.revisions)))
    return rows


def main(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder.")] = Path("out"),
    seeds: Annotated[int, typer.Option(help="Number of scenes.")] = 10,
    jobs: Annotated[int, typer.Option(help="Number of processes.")] = 1,
) -> None:
    """Print the share of equal final states for each kind of decisions and delays, and write all rows."""
    tasks = [(seed, label) for label in ASSOCIATIONS for seed in range(seeds)]
    found = Parallel(n_jobs=jobs)(delayed(judged)(*task) for task in tasks)
    rows = [row for of_task in found for row in of_task]
    out.mkdir(parents=True, exist_ok=True)
    with (out / "any_order.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(Row._fields)
        writer.writerows(rows)
    for label in ASSOCIATIONS:
        for delays in DELAYS_S:
            own = [
                row for row in rows if (row.decisions, row.delays) == (label, delays)
            ]
            shares = np.array([row.share for row in own])
            revised = np.mean([row.revised for row in own])
            typer.echo(
                f"{label}, delays {delays}: {100.0 * shares.mean():.2f} % of the final states as in order "
                f"(least {100.0 * shares.min():.2f} %), {revised:.0f} detections revised"
            )


if __name__ == "__main__":
    typer.run(main)
