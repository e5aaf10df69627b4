"""What does a delay of 150 ms cost, where another sensor overtakes the late one?

    python experiments/real_data/delayed.py --kitti KITTI -o out/delayed --jobs 2

KITTI is the folder of the tracking data set, whose detections come ten times a second. Three arrangements of the same
detections; in each all lists of the prompt sensor between two arrivals are overtaken by a late one, so that
backward-forward forgets them all (experiments/survival):

- `late lidar`: PointRCNN is late, the boxes of RRC are prompt. What is forgotten are bearings, which say nothing of the
  distance, where the error is, and err for a second: no difference is expected.
- `late camera`: RRC is late, PointRCNN is prompt. What is forgotten are all positions: a difference is expected.
- `halves`: every second list of PointRCNN is late, as of a second sensor alike; RRC is left out. Half of the positions
  are forgotten: a difference is expected.

Ticks are those of a node at 20 Hz. `costs.csv`: of the position now and 0.5 and 1 s ahead (constant turn rate and
speed, ten times a second), where all runs of a sequence, with and without the delay, track the same car, and of GOSPA
at all ticks. `scores.csv`: MOTA and switches of all ticks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, NamedTuple

import costs
import typer
from joblib import Parallel, delayed
from options import Jobs, Kitti, Out, Sequences
from scores import SEQUENCES, kitti_sources, write

import fgtrack
from fgtrack import Config, DetectionList, Message, open_input
from fgtrack.config import ClockConfig
from fgtrack.evaluation import EvaluatedRun

ESTIMATORS = ("smoother", "ekf-replay", "ekf-backward-forward")
LIDAR, CAMERA, SECOND = "pointrcnn_car", "rrc_car", "second_lidar"
LATE = {"late lidar": LIDAR, "late camera": CAMERA, "halves": SECOND}
"""The late sensor of each arrangement."""
NODE_HZ = 20.0
HORIZONS_S = (0.5, 1.0)
OF_SCORES = (
    "arrangement",
    "estimator",
    "mota_prompt",
    "mota_late",
    "switches_prompt",
    "switches_late",
)


class Found(NamedTuple):
    """What is said of one sequence in one arrangement."""

    compared: costs.Sums
    scores: list[list[float]]
    """Of each estimator MOTA and switches, as in `OF_SCORES`."""


def halves(messages: Iterable[Message]) -> Iterator[Message]:
    """Every second list of the LiDAR as one of `SECOND`."""
    count = 0
    for one in messages:
        if isinstance(one, DetectionList) and one.sensor == LIDAR:
            count += 1
            yield one if count % 2 else replace(one, sensor=SECOND)
        else:
            yield one


def arranged(arrangement: str, config: Config) -> Config:
    """`config` with the sensors of the arrangement."""
    if arrangement != "halves":
        return config
    sensors = {**config.sensors, SECOND: config.sensors[LIDAR]}
    return replace(
        config, sensors=sensors, ignore_sensors=(*config.ignore_sensors, CAMERA)
    )


def judged(arrangement: str, source: Path, config: Config, delay_s: float) -> Found:
    """Replay a sequence with all estimators, without and with the delay."""
    config = arranged(arrangement, config)
    messages = list(open_input(source, config.input).messages())
    if arrangement == "halves":
        messages = list(halves(messages))
    prompt, late = (
        [
            EvaluatedRun(
                each, fgtrack.replay(received, replace(config, estimator=each))
            )
            for each in ESTIMATORS
        ]
        for received in (messages, costs.late(messages, LATE[arrangement], delay_s))
    )
    scores = []
    for pair in zip(prompt, late, strict=True):
        clear = [
            one.metrics.multi_object.clear
            for one in pair
            if one.metrics.multi_object is not None
        ]
        scores.append(
            [
                *(100.0 * one["mota"] for one in clear),
                *(float(one["id_switches"]) for one in clear),
            ]
        )
    return Found(costs.sums(prompt, late, HORIZONS_S), scores)


def main(
    kitti: Kitti,
    out: Out = Path("out/delayed"),
    sequences: Sequences = SEQUENCES,
    arrangements: Annotated[
        str, typer.Option(help="Arrangements, separated by commas.")
    ] = ",".join(LATE),
    delay_s: Annotated[float, typer.Option(help="Delay of the late sensor.")] = 0.15,
    config_name: Annotated[str, typer.Option("-c", help="Configuration.")] = "kitti",
    jobs: Jobs = 1,
) -> None:
    """Replay all sequences with and without the delay, print costs.csv and scores.csv."""
    config = replace(Config.from_yaml(config_name), clock=ClockConfig(node_hz=NODE_HZ))
    sources, names = kitti_sources(kitti, sequences), arrangements.split(",")
    tasks = [(name, source) for name in names for source in sources.values()]
    found = Parallel(n_jobs=jobs)(
        delayed(judged)(*task, config, delay_s) for task in tasks
    )
    cost_rows, score_rows = [], []
    for name in names:
        mine = [one for task, one in zip(tasks, found, strict=True) if task[0] == name]
        cost_rows += [
            [name, *row]
            for row in costs.rows([one.compared for one in mine], ESTIMATORS)
        ]
        for k, estimator in enumerate(ESTIMATORS):
            columns = zip(*(one.scores[k] for one in mine), strict=True)
            score_rows.append(
                [name, estimator, *(f"{fmean(column):.1f}" for column in columns)]
            )
    write(out / "costs.csv", ["arrangement", *costs.HEADER], cost_rows)
    write(out / "scores.csv", OF_SCORES, score_rows)


if __name__ == "__main__":
    typer.run(main)
