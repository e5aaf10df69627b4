"""Files of a problem with several objects for a program: scans and queries in, tracks out."""

import csv
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import numpy as np

from fgtrack.ranking.crowds import CrowdProblem, Positions
from fgtrack.ranking.files import MEASUREMENTS, decimal, finite_number, require_columns

_VEHICLE = ("vehicle_x_m", "vehicle_y_m", "vehicle_yaw_rad")
_COLUMNS = (
    *("kind", "receipt_s", "stamp_s", "sensor"),
    *("x_m", "y_m", "std_x_m", "std_y_m"),
    *_VEHICLE,
    "query",
)
_TRACK_COLUMNS = ("query", "track_id", "x_m", "y_m")


def write_crowd(folder: Path, problem: CrowdProblem) -> Path:
    """Write `measurements.csv` and `problem.json` into `folder`; return the path of the table.

    Rows are in the order of receipt. Rows with equal receipt, stamp and sensor are one
    scan; a scan without detections is a row with empty `x_m`. A row of the kind `query`
    asks for all tracks at its stamp, from the rows above; the column `query` is its number.
    The pose of the vehicle with the sensors is empty if the sensors are at rest.
    """
    path = folder / MEASUREMENTS
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_COLUMNS)
        known = 0
        for number_of_query, query in enumerate(problem.queries):
            for number in range(known, query.num_known):
                writer.writerows(_rows(problem, number))
            known = max(known, query.num_known)
            receipt_ns = (
                problem.scans[known - 1].receipt_ns if known else query.stamp_ns
            )
            times = [decimal(receipt_ns - problem.start_ns)]
            times.append(decimal(query.stamp_ns - problem.start_ns))
            writer.writerow(
                ["query", *times, *[""] * (len(_COLUMNS) - 4), number_of_query]
            )
    (folder / "problem.json").write_text(
        json.dumps(described(problem), indent=2), encoding="utf-8"
    )
    return path


def described(problem: CrowdProblem) -> dict[str, object]:
    """Return scenario, motion and sensors as JSON values."""
    return {
        "scenario": problem.scenario,
        "motion": "cv",
        "parameters": {"velocity_density_m2ps3": problem.acceleration_density_m2ps3},
        "speed_std_mps": problem.speed_mps,
        "max_delay_s": problem.max_delay_s,
        "sensors": {name: asdict(each) for name, each in problem.sensors.items()},
    }


def _rows(problem: CrowdProblem, number: int) -> list[list[object]]:
    scan = problem.scans[number]
    std_m = problem.sensors[scan.sensor].std_m
    head = [
        "measurement",
        decimal(scan.receipt_ns - problem.start_ns),
        decimal(scan.stamp_ns - problem.start_ns),
        scan.sensor,
    ]
    pose = scan.pose.tolist() if problem.ego else [""] * len(_VEHICLE)
    if not len(scan.points_m):
        return [[*head, "", "", "", "", *pose, ""]]
    points_m = scan.points_m.tolist()
    return [[*head, x_m, y_m, std_m, std_m, *pose, ""] for x_m, y_m in points_m]


def read_tracks(path: Path, count: int) -> tuple[Positions, ...]:
    """Read the tracks of `count` queries; a row has the number of the query, a track's id and its position.

    Raises `ValueError` with the line for a value that is no number, a query that does not
    exist, or a track that is twice in a query, and `KeyError` for a missing column.
    """
    found: list[dict[int, np.ndarray]] = [{} for _ in range(count)]
    with path.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        require_columns(table, _TRACK_COLUMNS)
        for line, row in enumerate(table, start=2):
            query, track_id = _whole(row, "query", line), _whole(row, "track_id", line)
            if not 0 <= query < count:
                raise ValueError(
                    f"line {line}: query {query}: there are queries 0 to {count - 1}"
                )
            if track_id in found[query]:
                raise ValueError(
                    f"line {line}: track {track_id} is twice in query {query}"
                )
            found[query][track_id] = np.array(
                [finite_number(row[name], name, line) for name in ("x_m", "y_m")]
            )
    return tuple(found)


def _whole(row: Mapping[str, str], name: str, line: int) -> int:
    value = finite_number(row[name], name, line)
    if value != int(value):
        raise ValueError(f"line {line}: {name}: {row[name]!r} is not a whole number")
    return int(value)


def write_crowd_truth(folder: Path, problem: CrowdProblem) -> None:
    """Write `truth.csv` into `folder`: the true positions of the objects in view, by query and object."""
    with (folder / "truth.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("query", "object_id", "x_m", "y_m"))
        for number, positions in enumerate(problem.truth):
            for object_id, point_m in sorted(positions.items()):
                writer.writerow((number, object_id, *point_m.tolist()))
