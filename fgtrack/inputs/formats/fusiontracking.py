"""Logs of the published tracker TUMFTM/FusionTracking: the inputs of its node, tick by tick.

`data_logs.csv` contains a row for each tick with a JSON value in every cell.
Conventions that the logs do not specify:

- A row is written at the end of its tick: `time_ns` is the receipt of its messages, an upper bound.
- Objects are in the ego frame, unless the configuration names another frame.
- The published yaw is 0 along +y: pi/2 is added to the yaw of the ego and of objects in the map frame.
"""

import json
import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fgtrack.core.files import open_file
from fgtrack.core.geometry import wrap_angle
from fgtrack.core.types import Detection, DetectionList, EgoState, Frame, Message
from fgtrack.inputs.formats.common import reported_as
from fgtrack.inputs.source import FileFormat

LOG_NAME = "data_logs.csv"
_COLUMNS = ("time_ns", "detection_input", "ego_state")
_NAMES = {"x": "x_m", "y": "y_m", "yaw": "yaw_rad", "v": "speed_mps"}
Json = Any
"""Parsed JSON, checked while it is read."""


def read_log(folder: Path, frames: Mapping[str, Frame]) -> Iterator[Message]:
    """Yield the messages of the log in `folder` in receipt order, the ego before the detections of its tick.

    `frames` contains the frames of sensors whose objects are not in the ego frame.
    Raises `DataError` after the rows before a break.
    """
    file = folder / LOG_NAME
    with open_file(file) as lines:
        header = next(lines, b"").decode(errors="replace").rstrip("\n").split(";")
        last_ego_ns: int | None = None
        for number, line in enumerate(lines, 2):
            with reported_as(f"{file}:{number}: is not a row of a FusionTracking log"):
                row = dict(
                    zip(header, line.decode().rstrip("\n").split(";"), strict=True)
                )
                receipt_ns, detections, ego = (
                    json.loads(row[name]) for name in _COLUMNS
                )
                messages: list[Message] = list(
                    _lists(detections or {}, receipt_ns, frames)
                )
                if "state" in ego and ego["t"] != last_ego_ns:
                    last_ego_ns = ego["t"]
                    messages.insert(0, _ego(ego, receipt_ns))
            yield from messages


FORMAT = FileFormat(
    f"a FusionTracking log folder ({LOG_NAME})",
    lambda path: (path / LOG_NAME).is_file(),
    lambda path, config: partial(
        read_log,
        path,
        {
            sensor: item.frame
            for sensor, item in config.detections.items()
            if item.frame is not None and item.frame != "optical"
        },
    ),
)


def _ego(ego: Json, receipt_ns: int) -> EgoState:
    x, y, yaw, speed, yaw_rate, accel = map(float, ego["state"])
    return EgoState(
        int(ego["t"]),
        receipt_ns,
        x_m=x,
        y_m=y,
        yaw_rad=wrap_angle(yaw + 0.5 * math.pi),
        speed_mps=speed,
        yaw_rate_radps=yaw_rate,
        accel_mps2=accel,
        in_pit=ego.get("in_pit"),
    )


def _lists(
    detections: Json, receipt_ns: int, frames: Mapping[str, Frame]
) -> Iterator[DetectionList]:
    for sensor, (objects, stamp_ns) in sorted(
        detections.items(), key=lambda item: item[1][1]
    ):
        frame = frames.get(sensor, "ego")
        yield DetectionList(
            sensor,
            int(stamp_ns),
            receipt_ns,
            [_object(item, frame) for item in objects],
            frame,
        )


def _object(item: Json, frame: Frame) -> Detection:
    keys = item["keys"]
    state = item["state"]
    # The published tracker adds the yaw from the map after logging.
    if len(state) == len(keys) - 1:
        keys = [key for key in keys if key != "yaw"]
    values: dict[str, Any] = {
        _NAMES[key]: float(value)
        for key, value in zip(keys, state, strict=True)
        if key in _NAMES
    }
    if frame == "map" and "yaw_rad" in values:
        values["yaw_rad"] = wrap_angle(values["yaw_rad"] + 0.5 * math.pi)
    return Detection(**values)
