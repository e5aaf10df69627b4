"""What does a late LiDAR cost, where a prompt camera overtakes it?

    python experiments/real_data/delayed.py --kitti KITTI -o out/delayed --jobs 2

KITTI is the folder of the tracking data set. Every list of PointRCNN is received 150 ms after it was sensed, the boxes
of RRC at once, so that one or two of them overtake each list. Ticks are those of a node at 20 Hz. The error is that of
the present positions, where all runs of a sequence, with and without the delay, track the same car at the same tick.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack.core.types import Message
from fgtrack.evaluation.matching import match
from fgtrack.evaluation.paired import average
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import ClockConfig, Config
from fgtrack.pipeline.shipped import read_config
from fgtrack.sim.delays import ConstantDelay
from fgtrack.sim.redelay import SensorDelays, redelay

SEQUENCES = ("0004", "0006", "0008", "0010", "0018")
ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
LATE = "pointrcnn_car"
NODE_HZ = 20.0

Squares = Mapping[tuple[int, int], float]
"""Squared position error by tick and object."""


def squares(source: Path, config: Config, delay_s: float) -> Squares:
    """Squared errors in m^2 of the present positions, with the LiDAR `delay_s` late."""
    read = open_input(source, config.input).messages
    delays = {LATE: SensorDelays(delay=ConstantDelay(delay_s))}
    messages: Sequence[Message] = list(redelay(read, delays, np.random.default_rng(0)))
    matching = match(fgtrack.replay(messages, config))
    assert matching is not None
    rows = np.flatnonzero(matching.paired)
    objects = matching.object_index[rows]
    found = matching.distances_m[rows, objects] ** 2
    now_ns = matching.now_ns[matching.tick_index[rows]]
    return dict(zip(zip(now_ns.tolist(), objects.tolist(), strict=True), found.tolist(), strict=True))


def main(
    kitti: Annotated[Path, typer.Option(help="Folder of the KITTI tracking data set.")],
    out: Annotated[Path, typer.Option("-o", help="Folder for the table.")] = Path("out/delayed"),
    sequences: Annotated[str, typer.Option(help="Sequences, separated by commas.")] = ",".join(SEQUENCES),
    delay_s: Annotated[float, typer.Option(help="Delay of the LiDAR.")] = 0.15,
    config_name: Annotated[str, typer.Option("-c", help="Configuration.")] = "kitti",
    jobs: Annotated[int, typer.Option(help="Replays at a time.")] = 1,
) -> None:
    """Replay all sequences with and without the delay, print delayed.csv."""
    out.mkdir(parents=True, exist_ok=True)
    base = replace(read_config(config_name), clock=ClockConfig(node_hz=NODE_HZ))
    names = sequences.split(",")
    tasks = [(name, each, late_s) for name in names for each in ESTIMATORS for late_s in (0.0, delay_s)]
    runs = Parallel(n_jobs=jobs)(
        delayed(squares)(kitti / "oxts" / f"{name}.txt", replace(base, estimator=each), late_s)
        for name, each, late_s in tasks
    )
    found = dict(zip(tasks, runs, strict=True))
    rows, costs = [], {each: list[float]() for each in ESTIMATORS}
    for name in names:
        common = sorted(set.intersection(*(set(found[task]) for task in tasks if task[0] == name)))
        for each in ESTIMATORS:
            prompt, late = (
                float(np.sqrt(np.mean([found[name, each, late_s][place] for place in common])))
                for late_s in (0.0, delay_s)
            )
            costs[each].append(late - prompt)
            rows.append([name, each, str(len(common)), f"{prompt:.3f}", f"{late:.3f}", f"{late - prompt:.3f}"])
    with (out / "delayed.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["sequence", "estimator", "samples", "prompt_m", "late_m", "cost_m"], *rows])
    print((out / "delayed.csv").read_text())
    baseline = np.array(costs[ESTIMATORS[-1]])
    for each in ESTIMATORS[:-1]:
        print(f"{each}: costs less than {ESTIMATORS[-1]} by {average(baseline - np.array(costs[each]))}")


if __name__ == "__main__":
    typer.run(main)
