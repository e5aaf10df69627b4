"""Real recordings: how well are vessels and cars tracked, beside what the raw detections say?

    python experiments/real_data/real_data.py --autoferry AUTOFERRY --kitti KITTI -o out/real_data --jobs 2

AUTOFERRY holds a folder for each scenario, KITTI is the folder of the tracking data set (docs/recordings.md). All
scenarios are replayed with one configuration, all sequences with another. Two tables: `scores.csv` and `nis.csv`.
"""

import csv
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer
from joblib import Parallel, delayed

import fgtrack
from fgtrack.core.geometry import rotation
from fgtrack.core.types import DetectionList, EgoState, FloatArray, TrackStatus
from fgtrack.evaluation.matching import match, scenes
from fgtrack.evaluation.metrics import evaluate
from fgtrack.evaluation.multi_object import Clear
from fgtrack.io.run import Run, Table
from fgtrack.io.source import open_input
from fgtrack.pipeline.config import Config
from fgtrack.pipeline.shipped import read_config

SEQUENCES = ("0004", "0006", "0008", "0010", "0018")
HEADER = (
    "recording",
    "estimator",
    "mota_raw",
    "mota",
    "idf1",
    "hota",
    "gospa_m",
    "rmse_m",
    "false_tracks_per_object",
    "breaks",
    "id_switches",
)


class Scan(NamedTuple):
    """Positions that one list gives, and its stamp."""

    stamp_ns: int
    positions_m: FloatArray
    """Shape (m, 2), in the map."""
    scores: FloatArray
    """How sure the detector is of each, shape (m,); NaN where it does not say."""


class Found(NamedTuple):
    """What is said of one recording by one estimator."""

    scores: list[str]
    """In the order of `HEADER`."""
    nis: dict[str, float]
    """Mean over its expectation, by sensor."""


def scans(source: Path, config: Config) -> Iterator[Scan]:
    """What each list of positions shows by itself; sensors without positions, and ignored ones, say nothing."""
    ego = None
    for message in open_input(source, config.input).messages():
        if isinstance(message, EgoState):
            ego = message
        elif isinstance(message, DetectionList) and "x_m" in getattr(config.sensors.get(message.sensor), "std", {}):
            points_m = np.array([(one.x_m, one.y_m) for one in message.objects], dtype=np.float64).reshape(-1, 2)
            if message.frame != "map":
                assert ego is not None
                points_m = points_m @ rotation(ego.yaw_rad).T + [ego.x_m, ego.y_m]
            scores = np.array([one.score for one in message.objects], dtype=np.float64)
            yield Scan(message.stamp_ns, points_m, scores)


def raw(run: Run, seen: Sequence[Scan]) -> Run:
    """`run` with the detections of `seen` in place of its tracks, numbered through."""
    stamps_ns = np.array([scan.stamp_ns for scan in seen])
    tick = np.repeat(np.arange(len(seen)), [len(scan.positions_m) for scan in seen])
    x_m, y_m = np.concatenate([scan.positions_m for scan in seen]).T
    status = np.full(len(tick), TrackStatus.CONFIRMED.value)
    tracks = {"tick": tick, "stamp_ns": stamps_ns[tick], "track_id": np.arange(len(tick)), "x_m": x_m, "y_m": y_m}
    tracks |= {"num_measured": np.full(len(tick), 99), "status": status}
    timing = Table({"tick": np.arange(len(seen)), "now_ns": stamps_ns})
    return replace(run, tracks=Table(tracks), timing=timing)


def raw_mota(source: Path, config: Config, run: Run) -> float:
    """MOTA of the detections themselves, each scan for itself: no miss filled, nothing suppressed, no identity."""
    found = raw(run, list(scans(source, config)))
    matching = match(found, config.evaluation)
    assert matching is not None
    clear = Clear.of(scenes(found, matching), config.evaluation.gate_m)
    return 1.0 - (clear.misses + clear.false_positives) / (clear.pairs + clear.misses)


def judged(name: str, source: Path, config: Config) -> Found:
    """Scores of one recording, `name`."""
    run = fgtrack.replay(source, config)
    metrics = evaluate(run)
    truth, scores = metrics.truth, metrics.multi_object
    assert truth is not None
    assert scores is not None
    values = (
        100.0 * raw_mota(source, config, run),
        100.0 * scores.clear.mota,
        100.0 * scores.identity.idf1,
        100.0 * scores.hota.hota,
        scores.gospa.rms_m,
        truth.overall.errors["position_m"].rmse,
        truth.false_tracks / len(truth.objects),
    )
    counts = truth.overall.breaks, truth.overall.id_switches
    nis = {sensor: found.mean / found.dof for sensor, found in metrics.consistency.nis.items() if found.count}
    return Found([name, config.estimator, *(f"{value:.2f}" for value in values), *map(str, counts)], nis)


def summary(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Median and mean of every column of `rows`, for each estimator."""
    found = []
    for estimator in dict.fromkeys(row[1] for row in rows):
        columns = list(zip(*(map(float, row[2:]) for row in rows if row[1] == estimator), strict=True))
        for label, of in (("median", statistics.median), ("mean", statistics.fmean)):
            found.append([label, estimator, *(f"{of(column):.2f}" for column in columns)])
    return found


def main(
    autoferry: Annotated[Path | None, typer.Option(help="Folder with a folder per scenario.")] = None,
    kitti: Annotated[Path | None, typer.Option(help="Folder of the KITTI tracking data set.")] = None,
    out: Annotated[Path, typer.Option("-o", help="Folder for the tables.")] = Path("out/real_data"),
    estimators: Annotated[str, typer.Option(help="Estimators, separated by commas.")] = "ekf-replay,smoother",
    sequences: Annotated[str, typer.Option(help="Sequences of KITTI.")] = ",".join(SEQUENCES),
    scenarios: Annotated[str, typer.Option(help="Scenarios of Autoferry, all if empty.")] = "",
    autoferry_config: Annotated[str, typer.Option(help="Configuration for Autoferry.")] = "autoferry",
    kitti_config: Annotated[str, typer.Option(help="Configuration for KITTI.")] = "kitti",
    jobs: Annotated[int, typer.Option(help="Replays at a time.")] = 1,
) -> None:
    """Replay all recordings, print scores.csv and nis.csv."""
    out.mkdir(parents=True, exist_ok=True)
    groups: list[tuple[str, Config, list[Path]]] = []
    if autoferry is not None:
        names = scenarios.split(",") if scenarios else sorted(each.name for each in autoferry.glob("scenario*"))
        groups.append(("autoferry", read_config(autoferry_config), [autoferry / name for name in names]))
    if kitti is not None:
        files = [kitti / "oxts" / f"{sequence}.txt" for sequence in sequences.split(",")]
        groups.append(("kitti", read_config(kitti_config), files))
    for group, config, sources in groups:
        tasks = [(each, replace(config, estimator=name)) for name in estimators.split(",") for each in sources]
        found = Parallel(n_jobs=jobs)(delayed(judged)(each.stem, each, one) for each, one in tasks)
        rows = [one.scores for one in found]
        _write(out / f"{group}_scores.csv", HEADER, [*rows, *summary(rows)])
        nis = [[*one.scores[:2], sensor, f"{ratio:.2f}"] for one in found for sensor, ratio in one.nis.items()]
        _write(out / f"{group}_nis.csv", ("recording", "estimator", "sensor", "nis_over_expected"), nis)


def _write(file: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    with file.open("w", newline="") as opened:
        csv.writer(opened).writerows([header, *rows])
    print(f"{file.name}\n{file.read_text()}")


if __name__ == "__main__":
    typer.run(main)
