"""Cameras on vessels: how do their bearings err, and what do tracks gain from them?

    python experiments/real_data/bearings.py AUTOFERRY -o out/bearings --jobs 2

AUTOFERRY holds a folder for each scenario. Two tables:

- `bearings.csv`: the errors of the bearings against interpolated truth: how large they are, what of them is constant
  over a scenario, how long they last, and whether two vessels that are seen at once have the same.
- `gains.csv`: tracks without cameras, and with cameras whose errors are taken for white or for lasting; differences in
  pairs, with the interval of `compare` along each scenario.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed
from options import Jobs, Out, Scenarios
from scores import autoferry_sources, nis_ratios, write

import fgtrack
from fgtrack import (
    Config,
    FloatArray,
    IntArray,
    Message,
    Run,
    SensorModel,
    open_input,
)
from fgtrack.config import Correlation, Filter
from fgtrack.evaluation import (
    UNKNOWN,
    Estimate,
    EvaluatedRun,
    comparisons,
    ego_states,
    true_paths,
    within_run,
)

CAMERAS = ("infrared", "daylight")
FARTHEST_RAD = 0.15  # a bearing farther off is of something else
APART_RAD = 0.3  # vessels that are nearer to each other cannot be told apart
LAGS_S = (1.0, 5.0, 20.0)
SAME_S = 0.15  # times that differ by less are the same
STD_RAD = 0.06
ERRORS = {"white": None, "lasting": Correlation(share=0.9, time_s=5.0)}
QUANTITIES = ("gospa_in_view_rms_m", "position_rmse_m")
OF_BEARINGS = (
    *("recording", "camera", "bearings", "rms_rad", "mean_rad"),
    *(f"lasts_{lag_s:g}_s" for lag_s in LAGS_S),
    "common",
)
OF_GAINS = (
    *("recording", "cameras", "gospa_m", "gospa_change_m", "gospa_low", "gospa_high"),
    *(
        "rmse_m",
        "rmse_change_m",
        "rmse_low",
        "rmse_high",
        "mota",
        "idf1",
        "breaks",
        "false_tracks",
    ),
    *(f"nis_{camera}" for camera in CAMERAS),
)


class Series(NamedTuple):
    """Errors of one camera's bearings of one vessel."""

    stamps_ns: IntArray
    """Rising, shape (n,)."""
    errors_rad: FloatArray
    """Shape (n,)."""


def wrapped(angles_rad: FloatArray) -> FloatArray:
    """Angles in [-pi, pi), any shape."""
    return np.mod(angles_rad + np.pi, 2.0 * np.pi) - np.pi


def with_cameras(config: Config, errors: str) -> Config:
    """`config` with the cameras, whose `errors` are one of `ERRORS`; `none`: received like that, but not used."""
    camera = SensorModel(std={"bearing_rad": STD_RAD}, correlation=ERRORS.get(errors))
    if errors == "none":
        camera = replace(camera, filters={"bearing_rad": Filter(max=-10.0)})
    ignored = tuple(name for name in config.ignore_sensors if name not in CAMERAS)
    return replace(
        config,
        sensors={**config.sensors, **dict.fromkeys(CAMERAS, camera)},
        ignore_sensors=ignored,
    )


def errors_of(run: Run, camera: str) -> list[Series]:
    """Of every vessel the bearings next to it, while no other vessel is near the line of sight."""
    seen = run.tables["detections"].where(run.tables["detections"]["sensor"] == camera)
    stamps_ns = seen["stamp_ns"]
    poses = ego_states(run.tables["ego"], stamps_ns)
    places_m = (
        np.stack(
            [path.at(stamps_ns)[:, :2] for path in true_paths(run.tables["truth"])]
        )
        - poses[:, :2]
    )
    true_rad = np.arctan2(places_m[..., 1], places_m[..., 0]) - poses[:, 2]
    found = []
    for place, own_rad in enumerate(true_rad):
        error_rad = wrapped(seen["bearing_rad"] - own_rad)
        others = np.abs(wrapped(np.delete(true_rad, place, axis=0) - own_rad))
        alone = (np.nan_to_num(others, nan=math.pi) > APART_RAD).all(axis=0)
        rows = np.flatnonzero(alone & (np.abs(error_rad) < FARTHEST_RAD))
        rows = rows[np.lexsort((np.abs(error_rad[rows]), stamps_ns[rows]))]
        _, first = np.unique(stamps_ns[rows], return_index=True)
        found.append(Series(stamps_ns[rows[first]], error_rad[rows[first]]))
    return found


def product(one: Series, other: Series, lag_s: float) -> tuple[float, int]:
    """Sum of the products of errors of `one` and, `lag_s` later, of `other`, and their number."""
    if not len(one.stamps_ns) or not len(other.stamps_ns):
        return 0.0, 0
    wanted_ns = one.stamps_ns + round(lag_s * 1e9)
    after = np.searchsorted(other.stamps_ns, wanted_ns).clip(
        1, len(other.stamps_ns) - 1 or 1
    )
    near = np.array([after - 1, np.minimum(after, len(other.stamps_ns) - 1)])
    offsets_ns = np.abs(other.stamps_ns[near] - wanted_ns)
    nearest = np.take_along_axis(near, offsets_ns.argmin(axis=0)[None], axis=0)[0]
    rows = offsets_ns.min(axis=0) <= SAME_S * 1e9
    return float((one.errors_rad * other.errors_rad[nearest])[rows].sum()), int(
        rows.sum()
    )


def bearings(name: str, run: Run) -> Iterator[list[str]]:
    """A row of `OF_BEARINGS` for each camera; correlations are of the errors as they are, the mean included."""
    for camera in CAMERAS:
        series = errors_of(run, camera)
        every = np.concatenate([one.errors_rad for one in series])
        if not len(every):
            continue
        power = float(np.square(every).mean())
        row = [math.sqrt(power), float(every.mean())]
        pairs = [[(one, one, lag_s) for one in series] for lag_s in LAGS_S]
        pairs.append(
            [
                (one, other, 0.0)
                for k, one in enumerate(series)
                for other in series[k + 1 :]
            ]
        )
        for asked in pairs:
            sums, counts = zip(*(product(*each) for each in asked), strict=True)
            row.append(sum(sums) / sum(counts) / power if sum(counts) else math.nan)
        yield [name, camera, str(len(every)), *(f"{value:.3f}" for value in row)]


def beginning(source: Path, seconds: float) -> list[Message]:
    """The messages of the first `seconds`."""
    messages = list(open_input(source).messages())
    return [
        one
        for one in messages
        if one.receipt_ns - messages[0].receipt_ns <= seconds * 1e9
    ]


def measured(
    source: Path, config: Config, seconds: float
) -> tuple[list[list[str]], list[list[str]]]:
    """Rows of both tables of one recording."""
    messages = beginning(source, seconds)
    runs = {
        errors: EvaluatedRun(
            errors, fgtrack.replay(messages, with_cameras(config, errors))
        )
        for errors in ("none", *ERRORS)
    }
    rows = []
    for errors, run in runs.items():
        changes = [
            UNKNOWN if errors == "none" else change(runs["none"], run, quantity)
            for quantity in QUANTITIES
        ]
        metrics = run.metrics
        assert metrics.truth is not None
        assert metrics.multi_object is not None
        nis = nis_ratios(run)
        values = (
            *(metrics.multi_object.gospa["in_view_rms_m"], *bounds(changes[0])),
            *(metrics.truth.overall.errors["position_m"].rmse, *bounds(changes[1])),
            *(
                100.0 * metrics.multi_object.clear["mota"],
                100.0 * metrics.multi_object.identity["idf1"],
            ),
            *(metrics.truth.overall.breaks, metrics.truth.false_tracks),
            *(nis.get(camera, math.nan) for camera in CAMERAS),
        )
        rows.append([source.name, errors, *(f"{value:.2f}" for value in values)])
    return list(bearings(source.name, runs["none"].run)), rows


def bounds(one: Estimate) -> tuple[float, float, float]:
    """Value and interval."""
    return one.mean, one.low, one.high


def change(without: EvaluatedRun, run: EvaluatedRun, quantity: str) -> Estimate:
    """What the cameras change, less is better."""
    ticks = comparisons([without, run])[0].sums[quantity]
    return within_run(ticks, lambda S: np.sqrt(S[1] / S[2]) - np.sqrt(S[0] / S[2]))


def main(
    autoferry: Annotated[
        Path, typer.Argument(help="Folder with a folder per scenario.")
    ],
    out: Out = Path("out/bearings"),
    scenarios: Scenarios = "",
    configuration: Annotated[
        str, typer.Option(help="Configuration without cameras.")
    ] = "autoferry",
    seconds: Annotated[float, typer.Option(help="How much of each.")] = 1e6,
    jobs: Jobs = 1,
) -> None:
    """Replay all scenarios without and with cameras, print both tables."""
    config = Config.from_yaml(configuration)
    found = Parallel(n_jobs=jobs)(
        delayed(measured)(source, config, seconds)
        for source in autoferry_sources(autoferry, scenarios).values()
    )
    write(out / "bearings.csv", OF_BEARINGS, [row for rows, _ in found for row in rows])
    write(out / "gains.csv", OF_GAINS, [row for _, rows in found for row in rows])


if __name__ == "__main__":
    typer.run(main)
