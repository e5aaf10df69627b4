"""How good are final trajectories on the literature's benchmark with late scans?

    python experiments/oos_mtt/oos_mtt.py SCENE.txt.gz... -o out/oos_mtt
    python experiments/oos_mtt/oos_mtt.py --draw 5 -o out/oos_mtt      # scenes of our own, from the same model

The model of the scenes is given to every tracker, and nothing is tuned.
"""

import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from hypotheses import trajectories
from scenes import (
    MODEL,
    SENSOR,
    Scene,
    Trajectory,
    draw_scene,
    nanoseconds,
    read_scene,
    squared_per_scan,
)

import fgtrack
from fgtrack import Config, FloatArray, Run

LONGEST_S = 60.0
"""Window of the estimators. The latest scans are some 10 s late."""
REFERENCE = "hypotheses"
NUM_HYPOTHESES = 10
CARTESIAN = ("x_m", "y_m", "vx_mps", "vy_mps")
#: Estimator and order of the scans, by label.
METHODS: Mapping[str, tuple[str, bool]] = {
    "drop": ("drop", False),
    "smoother-banded": ("smoother-banded", False),
    "smoother": ("smoother", False),
    "smoother-banded-in-order": ("smoother-banded", True),
}
LABELS = (*METHODS, REFERENCE)
PARTS = ("localisation_m2", "missed_m2", "false_m2", "switches_m2")


def configuration(estimator: str) -> Config:
    """Return the model of the scenes as a configuration."""
    return Config.from_dict(
        {
            "estimator": estimator,
            "sensors": {
                SENSOR: {
                    "std": {"x_m": MODEL.std_m, "y_m": MODEL.std_m},
                    "detection_probability": MODEL.detection_probability,
                    "clutter_per_m2": MODEL.clutter_per_m2,
                    "field_of_view_rad": 2.0 * np.pi,
                    "max_delay_s": LONGEST_S,
                }
            },
            "clock": {"node_hz": None},
            "motion": {
                "kind": "cv",
                "std_per_s": {"velocity": 10.0 * MODEL.acceleration_density_m2ps3**0.5},
            },
            "association": {"kind": "hypotheses", "most": NUM_HYPOTHESES},
            "birth": {
                "appearances_per_s": MODEL.appearances_per_s,
                "mean": dict(zip(CARTESIAN, MODEL.birth_mean, strict=True)),
                "std": dict(zip(CARTESIAN, MODEL.birth_std, strict=True)),
            },
            "lifecycle": {
                "delete_probability": 1e-4,
                "lifetime_s": 1.0 / MODEL.deaths_per_s,
                "visible_share": 0.99,
                "out_of_view_s": LONGEST_S,
                "hidden_s": LONGEST_S,
                "memory_s": LONGEST_S,
            },
            "filter": {"storage_s": LONGEST_S},
            "smoother": {"lag_s": LONGEST_S},
        }
    )


def final_trajectories(scene: Scene, run: Run) -> list[Trajectory]:
    """Return the final trajectory of each track that probably existed, from its first to its last detection."""
    tracks, smoothed, ended = run.tracks, run.smoothed, run.final_tracks
    found = []
    for track_id, first_ns, last_ns in ended[ended["probability"] > 0.5][
        ["track_id", "first_stamp_ns", "last_stamp_ns"]
    ].itertuples(index=False):
        final = smoothed[
            (smoothed["track_id"] == track_id) & (smoothed["kind"] == "final")
        ]
        states = final if len(final) else tracks[tracks["track_id"] == track_id]
        known = {
            int(stamp_ns): np.array([x_m, y_m, speed_mps, yaw_rad])
            for stamp_ns, x_m, y_m, speed_mps, yaw_rad in states[
                ["stamp_ns", "x_m", "y_m", "speed_mps", "yaw_rad"]
            ].itertuples(index=False)
        }
        if known:
            found.append(_at_times(scene, known, int(first_ns), int(last_ns)))
    return found


def _at_times(
    scene: Scene, known: Mapping[int, FloatArray], first_ns: int, last_ns: int
) -> Trajectory:
    """Return the positions at the times of the truth between two stamps.

    Between two smoothed states the mean of the motion model is the cubic polynomial with
    their positions and velocities.
    """
    stamps_ns = np.array(sorted(known))
    path: dict[int, FloatArray] = {}
    for index, time_s in enumerate(scene.times_s.tolist()):
        stamp_ns = nanoseconds(time_s)
        if not first_ns <= stamp_ns <= last_ns:
            continue
        after = min(int(np.searchsorted(stamps_ns, stamp_ns)), len(stamps_ns) - 1)
        before = max(after - 1, 0)
        path[index] = _cubic(
            stamp_ns,
            *((int(stamps_ns[k]), known[int(stamps_ns[k])]) for k in (before, after)),
        )
    return path


def _cubic(
    stamp_ns: int, before: tuple[int, FloatArray], after: tuple[int, FloatArray]
) -> FloatArray:
    (before_ns, first), (after_ns, second) = before, after
    length_s = (after_ns - before_ns) / fgtrack.NS_PER_S
    if not length_s:
        return second[:2]
    share = (stamp_ns - before_ns) / (after_ns - before_ns)
    velocities = [
        state[2] * np.array([np.cos(state[3]), np.sin(state[3])])
        for state in (first, second)
    ]
    rest = 1.0 - share
    return np.asarray(
        (1.0 + 2.0 * share) * rest**2 * first[:2]
        + share * rest**2 * length_s * velocities[0]
        + share**2 * (3.0 - 2.0 * share) * second[:2]
        - share**2 * rest * length_s * velocities[1]
    )


def write_trajectories(path: Path, found: list[Trajectory]) -> None:
    """Write `track_id,scan,x_m,y_m`; `scan` is the index of the time of the truth, from 1."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("track_id", "scan", "x_m", "y_m"))
        for track_id, trajectory in enumerate(found):
            for index, (x_m, y_m) in sorted(trajectory.items()):
                writer.writerow(
                    (track_id, index + 1, repr(float(x_m)), repr(float(y_m)))
                )


def judged(
    name: str, scene: Scene, out: Path, labels: Sequence[str] = LABELS
) -> Iterator[tuple[str, Mapping[str, float]]]:
    """Yield label, score and CPU time of each method on a scene; writes the trajectories."""
    for label, (estimator, in_order) in METHODS.items():
        if label not in labels:
            continue
        started_s = time.process_time()
        replayed = scene.in_order() if in_order else scene
        run = fgtrack.replay(list(replayed.messages()), configuration(estimator))
        found = final_trajectories(scene, run)
        cpu_s = time.process_time() - started_s
        write_trajectories(out / name / label / "trajectories.csv", found)
        yield label, {**squared_per_scan(scene, found), "cpu_s": cpu_s}
    if REFERENCE not in labels:
        return
    started_s = time.process_time()
    found = trajectories(scene, NUM_HYPOTHESES)
    cpu_s = time.process_time() - started_s
    write_trajectories(out / name / REFERENCE / "trajectories.csv", found)
    yield REFERENCE, {**squared_per_scan(scene, found), "cpu_s": cpu_s}


def main(
    scenes: Annotated[
        list[Path] | None, typer.Argument(help="Files of scenes.")
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder.")] = Path("out"),
    draw: Annotated[int, typer.Option(help="Number of scenes that are drawn.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the first drawn scene.")] = 1,
    methods: Annotated[
        str, typer.Option(help=f"Of {', '.join(LABELS)}, with commas.")
    ] = ",".join(LABELS),
) -> None:
    """Print T-GOSPA squared per scan of the methods, and write the trajectories."""
    every = {path.name.partition(".")[0]: read_scene(path) for path in scenes or ()}
    for number in range(seed, seed + draw):
        every[f"drawn{number}"] = draw_scene(np.random.default_rng(number))
    scores: dict[str, list[Mapping[str, float]]] = {}
    for name, scene in every.items():
        for label, score in judged(name, scene, out, methods.split(",")):
            scores.setdefault(label, []).append(score)
            typer.echo(f"{name} {label}: {_row(score)}")
    for label, of_scenes in scores.items():
        mean = {
            key: float(np.mean([score[key] for score in of_scenes]))
            for key in of_scenes[0]
        }
        typer.echo(f"mean {label}: {_row(mean)}")
        totals = [score["total_m2"] for score in of_scenes]
        shares = np.quantile(totals, [0.0, 0.05, 0.25, 0.5, 0.75, 0.95, 1.0]).tolist()
        texts = ", ".join(f"{value:.1f}" for value in shares)
        typer.echo(
            f"{label}: quantiles 0, 5, 25, 50, 75, 95, 100 % of {len(totals)} totals: {texts} m^2"
        )


def _row(score: Mapping[str, float]) -> str:
    parts = ", ".join(f"{name.removesuffix('_m2')} {score[name]:.2f}" for name in PARTS)
    return f"{score['total_m2']:.2f} m^2 ({parts}), {score['cpu_s']:.1f} s of CPU"


if __name__ == "__main__":
    typer.run(main)
