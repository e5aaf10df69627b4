"""Simulates scenarios, whose vehicles may follow the paths of recorded objects."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fgtrack.core.errors import DataError
from fgtrack.core.time import NS_PER_S
from fgtrack.core.types import EGO_ID, EgoState, Message, TruthState
from fgtrack.meaning.draft import opened
from fgtrack.sim.roads import RecordedVehicle, TimedPath, csv_path, timed_path
from fgtrack.sim.scenario import Scenario
from fgtrack.sim.simulate import message_stream


def simulated(scenario: Scenario, rng: np.random.Generator) -> Iterator[Message]:
    """Return the messages of `scenario`, see `fgtrack.sim.simulate.message_stream`.

    Raises `DataError` also if a recording cannot be read, or has no path of the object.
    """
    return message_stream(scenario, rng, recorded_path)


def path_files(scenario: Scenario) -> list[str]:
    """Return the files and folders with the roads and the paths of the vehicles of `scenario`."""
    vehicles = (scenario.ego, *scenario.opponents)
    files = [getattr(vehicle, "file", None) for vehicle in vehicles]
    return list(dict.fromkeys(file for file in files if file is not None))


def recorded_path(vehicle: RecordedVehicle) -> TimedPath:
    """Return the path of `vehicle` from its CSV file, or from the truth of its recording.

    Time 0 is the first stamp of the truth; without truth it is the first stamp of the
    ego. Raises `DataError` if the file cannot be read, or has no path of the object.
    """
    if Path(vehicle.file).suffix.lower() == ".csv":
        return csv_path(vehicle)
    messages = list(opened(vehicle.file).source.messages())
    truth = [
        one for one in messages if isinstance(one, TruthState) and one.outline_m is None
    ]
    ids = sorted({one.object_id for one in truth})
    poses: list[TruthState] | list[EgoState] = truth
    if vehicle.object_id == EGO_ID and EGO_ID not in ids:
        poses = [one for one in messages if isinstance(one, EgoState)]
    elif vehicle.object_id not in ids:
        known = f"one of {', '.join(map(str, ids))}" if ids else "-1, it has no truth"
        raise DataError(
            f"{vehicle.file}: `object_id` must be {known}, is {vehicle.object_id}"
        )
    rows = np.array(
        [
            (one.stamp_ns, one.x_m, one.y_m, getattr(one, "object_id", EGO_ID))
            for one in poses
        ],
        dtype=object,
    ).reshape(-1, 4)
    if not len(rows):
        raise DataError(f"{vehicle.file}: has no poses of the ego")
    stamps_ns = rows[:, 0].astype(np.int64)
    times_s = (stamps_ns - stamps_ns.min()) / NS_PER_S
    mine = rows[:, 3] == vehicle.object_id
    return timed_path(vehicle, times_s[mine], rows[mine, 1:3].astype(np.float64))
