"""Foxglove messages as JSON values, which Foxglove and Lichtblick show."""

import math
from collections.abc import Iterator
from typing import Any

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.viewers.schemas import FRAME_TRANSFORM, OUTCOME, POSE_IN_FRAME, POSES_IN_FRAME, SCENE_UPDATE
from fgtrack.viewers.shapes import (
    Arrow,
    Box,
    Colour,
    Dot,
    EgoMotion,
    Ellipse,
    Entity,
    Facts,
    Label,
    Line,
    Objects,
    Point,
    Scene,
    Shape,
    ViewerMessage,
)

Json = dict[str, Any]  # Any: JSON

_ELLIPSE_HEIGHT_M = 0.02
_LETTER_M = 1.2
_LONGEST_HEAD_M = 1.5
#: What an entity holds none of must be there all the same.
_NO_SHAPES: Json = {
    name: [] for name in ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
}


def foxglove_messages(message: ViewerMessage) -> Iterator[tuple[str, str, Json]]:
    """Topic, name of the schema and value of what shows `message`."""
    time = _time(message.stamp_ns)
    match message:
        case Scene():
            yield message.topic, SCENE_UPDATE, scene_update(message)
        case Objects():
            poses = [
                _pose((one.x_m, one.y_m), 0.0, one.yaw_rad or 0.0)
                for one in message.objects.objects
                if one.x_m is not None and one.y_m is not None
            ]
            yield f"{message.topic}/poses", POSES_IN_FRAME, {"timestamp": time, "frame_id": "map", "poses": poses}
        case EgoMotion():
            pose = _pose((message.ego.x_m, message.ego.y_m), 0.0, message.ego.yaw_rad)
            transform = {
                "timestamp": time,
                "parent_frame_id": "map",
                "child_frame_id": "ego",
                "translation": pose["position"],
                "rotation": pose["orientation"],
            }
            yield "/tf", FRAME_TRANSFORM, transform
            yield "/ego/pose", POSE_IN_FRAME, {"timestamp": time, "frame_id": "map", "pose": pose}
        case Facts():
            known = {name: value for name, value in message.values.items() if value is not None}
            yield message.topic, OUTCOME, {"header": {"stamp": time}, **known}


def scene_update(scene: Scene) -> Json:
    """`foxglove.SceneUpdate`.

    By the schema a lifetime counts from the stamp, in viewers from the log time: it is long enough for both.
    """
    time, late_ns = _time(scene.stamp_ns), scene.log_ns - scene.stamp_ns
    return {
        "deletions": [{"timestamp": time, "type": 0, "id": name} for name in scene.removed],
        "entities": [_entity(one, time, late_ns) for one in scene.entities],
    }


def _entity(entity: Entity, time: Json, late_ns: int) -> Json:
    lifetime_ns = 0 if entity.lifetime_s is None else max(late_ns + nanoseconds(entity.lifetime_s), 1)
    found: Json = {
        "timestamp": time,
        "frame_id": entity.frame,
        "id": entity.name,
        "lifetime": _time(lifetime_ns),
        "frame_locked": entity.frame == "ego",
        "metadata": [{"key": key, "value": value} for key, value in entity.facts.items()],
        **_NO_SHAPES,
    }
    for shape in entity.shapes:
        kind, value = _primitive(shape)
        found[kind] = [*found[kind], value]
    return found


def _primitive(shape: Shape) -> tuple[str, Json]:
    """The list of an entity in which `shape` stands, and what it is there."""
    colour = _colour(shape.colour)
    match shape:
        case Box():
            pose = _pose(shape.centre_m, shape.size_m[2] / 2.0, shape.yaw_rad)
            return "cubes", {"pose": pose, "size": _vector(*shape.size_m), "color": colour}
        case Ellipse():
            size = _vector(*shape.axes_m, _ELLIPSE_HEIGHT_M)
            pose = _pose(shape.centre_m, shape.height_m, shape.yaw_rad)
            return "cylinders", {"pose": pose, "size": size, "bottom_scale": 1.0, "top_scale": 1.0, "color": colour}
        case Arrow():
            length_m, yaw_rad = _reach(shape)
            head_m = min(_LONGEST_HEAD_M, 0.4 * length_m)
            return "arrows", {
                "pose": _pose(shape.tail_m, shape.width_m, yaw_rad),
                "shaft_length": _short(length_m - head_m),
                "shaft_diameter": shape.width_m,
                "head_length": _short(head_m),
                "head_diameter": _short(2.5 * shape.width_m),
                "color": colour,
            }
        case Line():
            return "lines", {
                "type": 0,
                "pose": _pose((0.0, 0.0), 0.0, 0.0),
                "thickness": shape.width_m,
                "scale_invariant": False,
                "points": [_vector(x_m, y_m, 0.0) for x_m, y_m in shape.points_m],
                "color": colour,
                "colors": [],
                "indices": [],
            }
        case Dot():
            size = _vector(shape.diameter_m, shape.diameter_m, shape.diameter_m)
            pose = _pose(shape.centre_m, shape.diameter_m / 2.0, 0.0)
            return "spheres", {"pose": pose, "size": size, "color": colour}
        case Label():
            return "texts", {
                "pose": _pose(shape.point_m, shape.height_m, 0.0),
                "billboard": True,
                "font_size": _LETTER_M,
                "scale_invariant": False,
                "color": colour,
                "text": shape.text,
            }


def _reach(arrow: Arrow) -> tuple[float, float]:
    """Length and direction of an arrow."""
    dx_m, dy_m = arrow.tip_m[0] - arrow.tail_m[0], arrow.tip_m[1] - arrow.tail_m[1]
    return math.hypot(dx_m, dy_m), math.atan2(dy_m, dx_m)


def _time(time_ns: int) -> Json:
    sec, nsec = divmod(time_ns, NS_PER_S)
    return {"sec": sec, "nsec": nsec}


def _pose(point_m: Point, z_m: float, yaw_rad: float) -> Json:
    orientation = {"x": 0.0, "y": 0.0, "z": _fine(math.sin(0.5 * yaw_rad)), "w": _fine(math.cos(0.5 * yaw_rad))}
    return {"position": _vector(*point_m, z_m), "orientation": orientation}


def _vector(x: float, y: float, z: float) -> Json:
    return {"x": _short(x), "y": _short(y), "z": _short(z)}


def _colour(colour: Colour) -> Json:
    return dict(zip("rgba", colour, strict=True))


def _short(value: float) -> float:
    """Metres to a tenth of a millimetre, never a negative zero."""
    return round(value, 4) + 0.0


def _fine(value: float) -> float:
    """A part of a quaternion to what turns by less than a thousandth of a degree."""
    return round(value, 6) + 0.0
