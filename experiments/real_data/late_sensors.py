"""What does each estimator lose where one sensor of a real recording is late?

    python experiments/real_data/late_sensors.py --kitti KITTI --autoferry AUTOFERRY -o out/late_sensors --jobs 2

KITTI is the folder of the tracking data set, AUTOFERRY holds a folder for each scenario. One sensor at a time gets a
constant delay behind its stamps, the others stay as recorded. The configurations are the shipped ones; where a camera
of Autoferry is late, both cameras take part.

`late_sensors.csv`: position RMSE of the present where the runs track the same object at the same tick, all recordings
of a data set together, and the difference to `ekf-backward-forward` with the 95 % interval of `compare`. `drop`
is compared with it alone, for it tracks nothing where the late sensor alone starts tracks.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from joblib import Parallel, delayed
from options import Jobs, OptionalAutoferry, OptionalKitti, Out

import fgtrack
from fgtrack import Config, FloatArray, open_input
from fgtrack.evaluation import EvaluatedRun, comparisons, within_run
from fgtrack.sim import ConstantDelay, SensorDelays, redelay

REFERENCE = "ekf-backward-forward"
GROUPS = (
    (REFERENCE, "rewind-forget", "ekf-replay", "smoother-banded"),
    (REFERENCE, "drop"),
)
SENSORS = {
    "kitti": ("pointrcnn_car", "rrc_car"),
    "autoferry": ("lidar", "radar", "infrared", "daylight"),
}
CAMERAS = ("infrared", "daylight")
SEQUENCES = ("0004", "0006", "0008", "0010", "0018")
HEADER = (
    "data",
    "late",
    "delay_s",
    "estimator",
    "rmse_m",
    "less_backward_forward_m",
    "samples",
)
QUANTITY = "position_rmse_m"


def settings(data: str, sensor: str) -> Config:
    """The shipped configuration, of Autoferry with the cameras where one of them is `sensor`."""
    config = Config.from_yaml(data)
    config = replace(config, evaluation=replace(config.evaluation, multi_object=False))
    return replace(config, ignore_sensors=()) if sensor in CAMERAS else config


def sums_of(runs: list[EvaluatedRun]) -> Mapping[str, FloatArray]:
    """Sums of the comparison of runs of one recording; none if they track nothing in common."""
    return next((one.sums for one in comparisons(runs)), {})


def sums(source: Path, config: Config, sensor: str, delay_s: float) -> list[FloatArray]:
    """Of each of `GROUPS` squared errors of every run and their count, by stamp, shape (n, runs + 1)."""
    delays = {sensor: SensorDelays(ConstantDelay(delay_s))}
    messages = list(
        redelay(
            open_input(source, config.input).messages(),
            delays,
            np.random.default_rng(0),
        )[0]
    )
    names = dict.fromkeys(name for group in GROUPS for name in group)
    runs = {
        name: EvaluatedRun(
            name, fgtrack.replay(messages, replace(config, estimator=name))
        )
        for name in names
    }
    compared = [sums_of([runs[name] for name in group]) for group in GROUPS]
    nothing = [np.zeros((0, len(group) + 1)) for group in GROUPS]
    return [
        found.get(QUANTITY, empty)
        for found, empty in zip(compared, nothing, strict=True)
    ]


def rows(recordings: Sequence[Sequence[FloatArray]]) -> Iterator[list[str]]:
    """Estimator, RMSE, difference and samples, of the sums of all recordings."""
    for k, group in enumerate(GROUPS):
        ticks = np.concatenate([each[k] for each in recordings])
        for column, name in enumerate(group):
            if name == REFERENCE and k:
                continue
            if not ticks[:, -1].any():
                yield [name, "", "", "0"]
                continue
            less = within_run(
                ticks[:, [column, 0, -1]],
                lambda S: np.sqrt(S[0] / S[2]) - np.sqrt(S[1] / S[2]),
            )
            rmse_m = np.sqrt(ticks[:, column].sum() / ticks[:, -1].sum())
            yield [
                name,
                f"{rmse_m:.3f}",
                f"{less:.3f}" if name != REFERENCE else "",
                f"{ticks[:, -1].sum():.0f}",
            ]


def main(
    kitti: OptionalKitti = None,
    autoferry: OptionalAutoferry = None,
    out: Out = Path("out/late_sensors"),
    late: Annotated[
        str, typer.Option(help="Sensors to delay, separated by commas, all if empty.")
    ] = "",
    recordings: Annotated[
        str, typer.Option(help="Recordings, separated by commas, all if empty.")
    ] = "",
    delays_s: Annotated[
        str, typer.Option(help="Delays, separated by commas.")
    ] = "0.15,0.3,1",
    jobs: Jobs = 1,
) -> None:
    """Delay one sensor after the other, write late_sensors.csv."""
    sources: Mapping[str, list[Path]] = {
        "kitti": [kitti / "oxts" / f"{name}.txt" for name in SEQUENCES]
        if kitti
        else [],
        "autoferry": sorted(autoferry.glob("scenario*")) if autoferry else [],
    }
    out.mkdir(parents=True, exist_ok=True)
    with (
        (out / "late_sensors.csv").open("w", newline="") as file,
        Parallel(n_jobs=jobs) as parallel,
    ):
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for data, paths in sources.items():
            chosen = [
                path
                for path in paths
                if not recordings or path.stem in recordings.split(",")
            ]
            for sensor in SENSORS[data] if chosen else ():
                if late and sensor not in late.split(","):
                    continue
                for delay_s in map(float, delays_s.split(",")):
                    config = settings(data, sensor)
                    found = parallel(
                        delayed(sums)(path, config, sensor, delay_s) for path in chosen
                    )
                    writer.writerows(
                        [data, sensor, f"{delay_s:g}", *row] for row in rows(found)
                    )
                    file.flush()
    print((out / "late_sensors.csv").read_text())


if __name__ == "__main__":
    typer.run(main)
