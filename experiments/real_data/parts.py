"""What each part of the tracker gives on real recordings: off, one at a time.

    python experiments/real_data/parts.py --autoferry AUTOFERRY --kitti KITTI -o out/parts --jobs 2

`parts.csv`: MOTA and position RMSE of all recordings of a data set together, `ekf-replay`, the difference of a part off
from the shipped configuration with its 95 % interval, see `within_run`, and processor time.
"""

import csv
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed
from options import Jobs, OptionalAutoferry, OptionalKitti, Out, Scenarios, Sequences
from scores import SEQUENCES, autoferry_sources, kitti_sources

import fgtrack
from fgtrack import FloatArray
from fgtrack.evaluation import NO_TRACK, Matching, Statistic, match, within_run

SHIPPED = "shipped"
#: Visible at any time, as far as a number can say so.
ALWAYS = {"lifecycle.visible_share": 1.0 - 1e-15}
PARTS: Mapping[str, Mapping[str, Mapping[str, object]]] = {
    "autoferry": {
        SHIPPED: {},
        "visibility": ALWAYS,
        "second returns": {
            "sensors.lidar.second_returns": None,
            "sensors.radar.second_returns": None,
        },
        "jumps": {
            f"sensors.{name}.correlation.jump_probability": 0.0
            for name in ("lidar", "radar")
        },
        "correlation": {
            "sensors.lidar.correlation": None,
            "sensors.radar.correlation": None,
        },
    },
    "kitti": {
        SHIPPED: {},
        "visibility": ALWAYS,
        "score": {"sensors.pointrcnn_car.score": None},
        "ego": {"ego.position_std_m": 0.0, "ego.speed_std_mps": 0.0},
        "correlation": {
            "sensors.pointrcnn_car.correlation": None,
            "sensors.rrc_car.correlation": None,
        },
    },
}
HEADER = (
    "data",
    "part",
    "mota",
    "mota_difference",
    "rmse_m",
    "rmse_difference_m",
    "switches",
    "cpu_s",
)


class Judged(NamedTuple):
    """One recording with one setting."""

    ticks: FloatArray
    """Of each tick false tracks, missed objects, switches, objects, squared errors in m^2 and pairs, shape (n, 6)."""
    cpu_s: float


def counted(matching: Matching) -> FloatArray:
    """`Judged.ticks` of a matching."""
    paired, n = matching.paired, len(matching.now_ns)
    false, pairs = (
        np.bincount(matching.tick_index[rows], minlength=n)
        for rows in (~paired, paired)
    )
    x_m, y_m = matching.truth_of(paired)[:, :2].T
    tracks = matching.tracks.where(paired)
    distances_m = np.hypot(tracks["x_m"] - x_m, tracks["y_m"] - y_m)
    squared_m2 = np.bincount(matching.tick_index[paired], distances_m**2, minlength=n)
    found, switches = matching.track_ids != NO_TRACK, np.zeros(n)
    for ids, has in zip(matching.track_ids.T, found.T, strict=True):
        ticks = np.flatnonzero(has)
        switches[ticks[1:][np.diff(ids[ticks]) != 0]] += 1.0
    missed = (matching.present & ~found).sum(axis=1)
    return np.column_stack(
        [false, missed, switches, matching.present.sum(axis=1), squared_m2, pairs]
    )


def judged(source: Path, data: str, settings: Mapping[str, object]) -> Judged:
    """Replay `source` with the shipped configuration of `data` and `settings`."""
    start_s = time.process_time()
    run = fgtrack.replay(source, data, set=settings, estimator="ekf-replay")
    cpu_s, matching = time.process_time() - start_s, match(run)
    assert matching is not None
    return Judged(counted(matching), cpu_s)


def mota(sums: FloatArray) -> FloatArray:
    """MOTA in percent of sums in the order of `Judged.ticks`, shape (6, ...)."""
    return np.asarray(100.0 * (1.0 - sums[:3].sum(axis=0) / sums[3]))


def rmse_m(sums: FloatArray) -> FloatArray:
    """Position RMSE of the same."""
    return np.asarray(np.sqrt(sums[4] / sums[5]))


def row(one: Sequence[Judged], shipped: Sequence[Judged]) -> Iterator[str]:
    """Columns from `mota` on of all recordings with a setting, and as shipped."""
    ticks = np.hstack(
        [np.concatenate([each.ticks for each in runs]) for runs in (one, shipped)]
    )
    sums = ticks[:, :6].sum(axis=0)

    def less(value: Statistic) -> str:
        return (
            ""
            if one is shipped
            else f"{within_run(ticks, lambda S: value(S[:6]) - value(S[6:])):+.3f}"
        )

    yield from (
        f"{mota(sums):.1f}",
        less(mota),
        f"{rmse_m(sums):.3f}",
        less(rmse_m),
        f"{sums[2]:.0f}",
    )
    yield f"{np.mean([each.cpu_s for each in one]):.1f}"


def main(
    autoferry: OptionalAutoferry = None,
    kitti: OptionalKitti = None,
    out: Out = Path("out/parts"),
    scenarios: Scenarios = "",
    sequences: Sequences = SEQUENCES,
    jobs: Jobs = 1,
) -> None:
    """Switch off one part after the other, write and print parts.csv."""
    sources = {
        "autoferry": autoferry_sources(autoferry, scenarios) if autoferry else {},
        "kitti": kitti_sources(kitti, sequences) if kitti else {},
    }
    out.mkdir(parents=True, exist_ok=True)
    with (
        (out / "parts.csv").open("w", newline="") as file,
        Parallel(n_jobs=jobs) as parallel,
    ):
        writer, shipped = csv.writer(file), list[Judged]()
        writer.writerow(HEADER)
        for data, paths in sources.items():
            for part, settings in PARTS[data].items() if paths else ():
                found = parallel(
                    delayed(judged)(path, data, settings) for path in paths.values()
                )
                shipped = found if part == SHIPPED else shipped
                writer.writerow([data, part, *row(found, shipped)])
                file.flush()
    print((out / "parts.csv").read_text())


if __name__ == "__main__":
    typer.run(main)
