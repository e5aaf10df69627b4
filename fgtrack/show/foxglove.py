"""Writer of MCAP files for Foxglove and Lichtblick.

The log time of a message is the time at which its content was available; the publish
time is its stamp.
"""

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foxglove import messages as sdk
from mcap.writer import Writer

from fgtrack.core.errors import DataError
from fgtrack.core.output import new_file
from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import EgoState
from fgtrack.inputs.geodetic import latitudes_longitudes_deg
from fgtrack.show.shapes import Entity, Point, Scene, Shape, ViewerMessage

_LONGEST_HEAD_M = 1.5
_SOLIDS = {
    "cube": sdk.CubePrimitive,
    "cylinder": sdk.CylinderPrimitive,
    "sphere": sdk.SpherePrimitive,
}
#: Schema of the rows of `updates.csv`, for which Foxglove has no message type.
_OUTCOME = {
    "title": "fgtrack.Outcome",
    "type": "object",
    "properties": {
        "header": {
            "type": "object",
            "properties": {"stamp": {"type": "object", "title": "time"}},
        },
        **{name: {"type": "string"} for name in ("sensor", "disposition")},
        **{name: {"type": "integer"} for name in ("index", "track_id")},
        **{name: {"type": "number"} for name in ("delay_s", "nis")},
    },
}


def write_foxglove(
    path: Path,
    messages: Iterable[ViewerMessage],
    overwrite: bool = False,
    origin_deg: tuple[float, float] | None = None,
) -> dict[str, int]:
    """Write `messages`, in order of log times, to the MCAP file `path`; return their number by topic.

    With `origin_deg`, positions are also written as fixes for map panels. The file
    appears when it is complete. Equal messages give equal bytes. Raises `CallError` if
    `path` exists, and `DataError` if the disk is full or a time lies before 1970.
    """
    channels: dict[str, int] = {}
    counts: Counter[str] = Counter()
    with new_file(path, overwrite) as file:
        writer = Writer(file)
        writer.start(library="fgtrack")
        for message in messages:
            if (early_ns := min(message.log_ns, message.stamp_ns)) < 0:
                raise DataError(
                    f"the time {early_ns} ns lies before 1970, which an MCAP file cannot contain"
                )
            for topic, value in values(message, origin_deg):
                is_own = isinstance(value, dict)
                if topic not in channels:
                    name = "fgtrack.Outcome"
                    encoding = "jsonschema"
                    schema = json.dumps(_OUTCOME).encode()
                    if not is_own:
                        given = value.get_schema()
                        name = given.name
                        encoding = given.encoding
                        schema = given.data
                    schema_id = writer.register_schema(name, encoding, schema)
                    channels[topic] = writer.register_channel(
                        topic, "json" if is_own else "protobuf", schema_id
                    )
                data = (
                    json.dumps(value, allow_nan=False).encode()
                    if is_own
                    else value.encode()
                )
                writer.add_message(
                    channels[topic],
                    message.log_ns,
                    data,
                    message.stamp_ns,
                    counts[topic],
                )
                counts[topic] += 1
        writer.finish()  # type: ignore[no-untyped-call]  # as mcap has it
    return dict(counts)


def values(
    message: ViewerMessage, origin_deg: tuple[float, float] | None = None
) -> Iterator[tuple[str, Any]]:  # Any: messages of Foxglove, which share no type
    """Yield each topic of `message` with the Foxglove message for it."""
    topic = message.topic
    sec, nsec = divmod(message.stamp_ns, NS_PER_S)
    time = sdk.Timestamp(sec, nsec)
    match message.content:
        case Scene(entities, removed):
            shown = [
                _entity(item, time, message.log_ns - message.stamp_ns)
                for item in entities
            ]
            deletions = [
                sdk.SceneEntityDeletion(timestamp=time, id=name) for name in removed
            ]
            yield topic, sdk.SceneUpdate(deletions=deletions, entities=shown)
        case EgoState() as ego:
            position = _vector(ego.x_m, ego.y_m)
            turn = _turn(ego.yaw_rad)
            frames = {"parent_frame_id": "map", "child_frame_id": "ego"}
            yield (
                "/tf",
                sdk.FrameTransform(
                    timestamp=time, translation=position, rotation=turn, **frames
                ),
            )
            pose = sdk.Pose(position=position, orientation=turn)
            yield (
                f"{topic}/pose",
                sdk.PoseInFrame(timestamp=time, frame_id="map", pose=pose),
            )
            for fix in _fixes([(ego.x_m, ego.y_m)], time, origin_deg):
                yield f"{topic}/fix", fix
        case tuple() as states:
            points_m = [(item.x_m or 0.0, item.y_m or 0.0) for item in states]
            poses = [
                _pose(at_m, 0.0, item.yaw_rad or 0.0)
                for at_m, item in zip(points_m, states, strict=True)
            ]
            yield (
                f"{topic}/poses",
                sdk.PosesInFrame(timestamp=time, frame_id="map", poses=poses),
            )
            if fixes := _fixes(points_m, time, origin_deg):
                yield f"{topic}/fixes", sdk.LocationFixes(fixes=fixes)
        case outcome:
            known = {
                name: value for name, value in outcome.items() if value is not None
            }
            yield topic, {"header": {"stamp": {"sec": sec, "nsec": nsec}}, **known}


def _entity(entity: Entity, time: sdk.Timestamp, late_ns: int) -> sdk.SceneEntity:
    """Return the Foxglove entity.

    The schema counts a lifetime from the stamp, but viewers count it from the log time.
    The lifetime is long enough for both.
    """
    lists: dict[str, list[Any]] = {}  # Any: primitives share no type
    lifetime_ns = (
        0
        if entity.lifetime_s is None
        else max(late_ns + nanoseconds(entity.lifetime_s), 1)
    )
    for shape in entity.shapes:
        lists.setdefault(f"{shape.kind}s", []).append(_primitive(shape))
    return sdk.SceneEntity(
        timestamp=time,
        frame_id=entity.frame,
        id=entity.name,
        lifetime=sdk.Duration(*divmod(lifetime_ns, NS_PER_S)),
        frame_locked=entity.frame == "ego",
        **lists,
    )


def _primitive(shape: Shape) -> Any:  # Any: primitives share no type
    common: dict[str, Any] = {  # Any: keywords of different types
        "pose": _pose(shape.at_m, shape.height_m, shape.yaw_rad),
        "color": sdk.Color(**dict(zip("rgba", shape.colour, strict=True))),
    }
    length_m, width_m, letter_m = shape.size_m
    match shape.kind:
        case "arrow":
            head_m = min(_LONGEST_HEAD_M, 0.4 * length_m)
            common |= {"shaft_length": length_m - head_m, "shaft_diameter": width_m}
            return sdk.ArrowPrimitive(
                head_length=head_m, head_diameter=2.5 * width_m, **common
            )
        case "line":
            points = [sdk.Point3(x=x, y=y) for x, y in shape.points_m]
            return sdk.LinePrimitive(thickness=length_m, points=points, **common)
        case "text":
            return sdk.TextPrimitive(
                text=shape.text, font_size=letter_m, billboard=True, **common
            )
        case "cylinder":
            common |= {"bottom_scale": 1.0, "top_scale": 1.0}
    return _SOLIDS[shape.kind](size=_vector(*shape.size_m), **common)


def _fixes(
    points_m: Sequence[Point],
    time: sdk.Timestamp,
    origin_deg: tuple[float, float] | None,
) -> list[sdk.LocationFix]:
    """Return the positions as fixes on Earth; empty without an origin."""
    if origin_deg is None or not points_m:
        return []
    pairs = zip(
        *latitudes_longitudes_deg(origin_deg, *np.array(points_m).T), strict=True
    )
    return [
        sdk.LocationFix(timestamp=time, frame_id="map", latitude=a, longitude=b)
        for a, b in pairs
    ]


def _pose(at_m: Point, z_m: float, yaw_rad: float) -> sdk.Pose:
    return sdk.Pose(position=_vector(*at_m, z_m), orientation=_turn(yaw_rad))


def _turn(yaw_rad: float) -> sdk.Quaternion:
    return sdk.Quaternion(z=math.sin(0.5 * yaw_rad), w=math.cos(0.5 * yaw_rad))


def _vector(x: float, y: float, z: float = 0.0) -> sdk.Vector3:
    return sdk.Vector3(x=x, y=y, z=z)
