"""The Autoferry data set: object lists and bearings of a ferry, with the GNSS truth of two vessels.

Helgesen, Vasstein, Brekke, Stahl, "Heterogeneous multi-sensor tracking for an
autonomous surface vehicle in a littoral environment", 2022;
github.com/Autoferry/sensor_fusion_dataset. Conventions that the data set does not
specify:

- The receipt is the newest stamp up to the record in the file, a lower bound. So each sensor alone is in order.
- Scans are aligned to the north: the yaw of the ego frame is 0. The ego's speed along this yaw is set to 0.
- An own-ship position that is older than an earlier delivered position is not delivered.
- LiDAR and RADAR points are shifted by the own ship's position into the map frame. Bearings stay in the ego frame.
"""

import math
from collections.abc import Iterator
from decimal import Decimal
from functools import partial
from heapq import merge
from pathlib import Path

import numpy as np

from fgtrack.core.checks import LARGEST_NS
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection, DetectionList, EgoState, Message, TruthState
from fgtrack.inputs.formats.common import exact_ns, json_values, reported_as
from fgtrack.inputs.source import FileFormat

SENSORS = {1: "lidar", 2: "radar", 3: "infrared", 4: "daylight"}
_CAMERAS = {3, 4}
_DETECTIONS = "*_detections.json"


def read_scenario(folder: Path) -> Iterator[Message]:
    """Yield the messages of the scenario in `folder` in receipt order.

    At equal receipts the truth comes first, then the ego, then the detections.
    """
    file = min(folder.glob(_DETECTIONS))
    truth = file.with_name(file.name.replace("_detections", "_groundTruth"))
    states = _truth(truth) if truth.exists() else []
    return merge(states, _measured(file), key=lambda message: message.receipt_ns)


FORMAT = FileFormat(
    "an Autoferry scenario folder (*_detections.json)",
    lambda path: path.is_dir() and any(path.glob(_DETECTIONS)),
    lambda path, config: partial(read_scenario, path),
)


def _measured(file: Path) -> Iterator[EgoState | DetectionList]:
    """Yield own-ship positions and object lists.

    Points are relative to the own ship: `[[north...], [east...]]` or `[north, east]`.
    Bearings are measured clockwise from the north.
    """
    newest_ns = -LARGEST_NS
    for index, record in enumerate(json_values(file, parse_float=Decimal)):
        with reported_as(
            f"{file}: record {index} does not have the form of the data set"
        ):
            stamp_ns = exact_ns(record["time"])
            north_m, east_m = map(float, record["ownshipPosition"])
            is_camera = record["sensorID"] in _CAMERAS
            name = SENSORS[record["sensorID"]]
            values = np.array(record["measurement"], dtype=np.float64)
            if is_camera:
                objects = [
                    Detection(bearing_rad=wrap_angle(0.5 * math.pi - each))
                    for each in values.ravel().tolist()
                ]
            else:
                norths_m, easts_m = values.reshape(2, -1).tolist()
                objects = [
                    Detection(east_m + x, north_m + y)
                    for x, y in zip(easts_m, norths_m, strict=True)
                ]
        receipt_ns = max(stamp_ns, newest_ns)
        if stamp_ns > newest_ns:
            yield EgoState(
                stamp_ns,
                receipt_ns,
                x_m=east_m,
                y_m=north_m,
                yaw_rad=0.0,
                speed_mps=0.0,
            )
        yield DetectionList(
            name, stamp_ns, receipt_ns, objects, "ego" if is_camera else "map"
        )
        newest_ns = receipt_ns


def _truth(file: Path) -> list[TruthState]:
    """Return the GNSS fixes of the vessels without repetitions: the file repeats the nearest fix at every record."""
    states: dict[tuple[int, int], TruthState] = {}
    for index, fixes in enumerate(json_values(file, parse_float=Decimal)):
        with reported_as(
            f"{file}: record {index} does not have the form of the data set"
        ):
            for fix in fixes if isinstance(fixes, list) else [fixes]:
                stamp_ns = exact_ns(fix["time"])
                target = int(fix["targetID"])
                north_m, east_m = map(float, fix["position"][:2])
                state = TruthState(stamp_ns, stamp_ns, target, x_m=east_m, y_m=north_m)
                states.setdefault((stamp_ns, target), state)
    return [states[key] for key in sorted(states)]
