"""What is said of tracks on a real recording, and of the detections that they are made of."""

import csv
import statistics
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fgtrack import (
    Config,
    DetectionList,
    EgoState,
    FloatArray,
    Message,
    Run,
    TrackStatus,
    open_input,
    rotation,
)
from fgtrack.evaluation import Columns, EvaluatedRun, clear, match, scenes

SEQUENCES = "0004,0006,0008,0010,0018"
"""Of the KITTI tracking data set."""
HEADER = (
    *(
        "recording",
        "estimator",
        "mota_raw",
        "mota",
        "idf1",
        "hota",
        "gospa_m",
        "rmse_m",
        "false_tracks_per_object",
    ),
    *("breaks", "id_switches"),
)
NIS_HEADER = ("recording", "estimator", "sensor", "nis_over_expected")


def kitti_sources(kitti: Path, sequences: str) -> dict[str, Path]:
    """The inputs of `sequences`, separated by commas, by name."""
    return {name: kitti / "oxts" / f"{name}.txt" for name in sequences.split(",")}


def autoferry_sources(autoferry: Path, scenarios: str) -> dict[str, Path]:
    """The inputs of `scenarios`, separated by commas, or of all, by name."""
    names = (
        scenarios.split(",")
        if scenarios
        else sorted(each.name for each in autoferry.glob("scenario*"))
    )
    return {name: autoferry / name for name in names}


class Scan(NamedTuple):
    """Positions that one list gives."""

    sensor: str
    stamp_ns: int
    ego_m: FloatArray
    """Where the ego is, shape (2,)."""
    positions_m: FloatArray
    """Shape (m, 2), in the map."""
    scores: FloatArray
    """How sure the detector is of each, shape (m,); NaN where it does not say."""


class Found(NamedTuple):
    """What is said of one recording by one estimator."""

    scores: list[str]
    """In the order of `HEADER`."""
    nis: dict[str, float]
    """As `nis_ratios`."""


def scans(messages: Iterable[Message], config: Config) -> Iterator[Scan]:
    """What each list of positions shows by itself; sensors without positions say nothing."""
    ego = None
    for message in messages:
        if isinstance(message, EgoState):
            ego = message
        elif isinstance(message, DetectionList) and "x_m" in getattr(
            config.sensors.get(message.sensor), "std", {}
        ):
            assert ego is not None
            ego_m = np.array([ego.x_m, ego.y_m])
            points_m = np.array(
                [(one.x_m, one.y_m) for one in message.objects], dtype=np.float64
            ).reshape(-1, 2)
            if message.frame != "map":
                points_m = points_m @ rotation(ego.yaw_rad).T + ego_m
            scores = np.array([one.score for one in message.objects], dtype=np.float64)
            yield Scan(message.sensor, message.stamp_ns, ego_m, points_m, scores)


def raw(run: Run, seen: Sequence[Scan]) -> Run:
    """`run` with the detections of `seen` in place of its tracks, numbered through."""
    stamps_ns = np.array([scan.stamp_ns for scan in seen])
    tick = np.repeat(np.arange(len(seen)), [len(scan.positions_m) for scan in seen])
    x_m, y_m = np.concatenate([scan.positions_m for scan in seen]).T
    status = np.full(len(tick), TrackStatus.CONFIRMED.value)
    tracks = {
        "tick": tick,
        "stamp_ns": stamps_ns[tick],
        "track_id": np.arange(len(tick)),
        "x_m": x_m,
        "y_m": y_m,
    }
    tracks |= {"num_measured": np.full(len(tick), 99), "status": status}
    timing = Columns({"tick": np.arange(len(seen)), "now_ns": stamps_ns})
    return run.with_tables(tracks=Columns(tracks), timing=timing)


def raw_mota(source: Path, config: Config, run: Run) -> float:
    """MOTA of the detections themselves, each scan for itself: no miss filled, nothing suppressed, no identity."""
    found = raw(run, list(scans(open_input(source, config.input).messages(), config)))
    matching = match(found, config.evaluation)
    assert matching is not None
    counts = clear(scenes(found, matching), config.evaluation.gate_m)
    return 1.0 - (counts["misses"] + counts["false_positives"]) / (
        counts["pairs"] + counts["misses"]
    )


def nis_ratios(run: EvaluatedRun) -> dict[str, float]:
    """Mean NIS over its expectation, by sensor."""
    nis = run.metrics.consistency.nis
    return {
        sensor: found.mean / found.dof for sensor, found in nis.items() if found.count
    }


def scored(name: str, source: Path, config: Config, run: EvaluatedRun) -> Found:
    """Scores of `run`, of the recording `name` at `source` with `config`."""
    truth, scores = run.metrics.truth, run.metrics.multi_object
    assert truth is not None
    assert scores is not None
    values = (
        100.0 * raw_mota(source, config, run.run),
        100.0 * scores.clear["mota"],
        100.0 * scores.identity["idf1"],
        100.0 * scores.hota["hota"],
        scores.gospa["rms_m"],
        truth.overall.errors["position_m"].rmse,
        truth.false_tracks / len(truth.objects),
    )
    counts = truth.overall.breaks, truth.overall.id_switches
    return Found(
        [
            name,
            config.estimator,
            *(f"{value:.2f}" for value in values),
            *map(str, counts),
        ],
        nis_ratios(run),
    )


def summary(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Median and mean of every column of `rows`, for each estimator."""
    found = []
    for estimator in dict.fromkeys(row[1] for row in rows):
        columns = list(
            zip(
                *(map(float, row[2:]) for row in rows if row[1] == estimator),
                strict=True,
            )
        )
        for label, of in (("median", statistics.median), ("mean", statistics.fmean)):
            found.append(
                [label, estimator, *(f"{of(column):.2f}" for column in columns)]
            )
    return found


def write(file: Path, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a table and print it; makes its folder."""
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as opened:
        csv.writer(opened).writerows([header, *rows])
    print(f"{file.name}\n{file.read_text()}")


def write_scores(out: Path, found: Sequence[Found], prefix: str = "") -> None:
    """`scores.csv`, with averages, and `nis.csv`."""
    rows = [one.scores for one in found]
    write(out / f"{prefix}scores.csv", HEADER, [*rows, *summary(rows)])
    nis = [
        [*one.scores[:2], sensor, f"{ratio:.2f}"]
        for one in found
        for sensor, ratio in one.nis.items()
    ]
    write(out / f"{prefix}nis.csv", NIS_HEADER, nis)
