"""JSON schemas of the Foxglove messages that fgtrack writes (foxglove.dev, schemas 2.1), without their descriptions."""

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

JsonSchema = dict[str, Any]  # Any: JSON

_NUMBER: JsonSchema = {"type": "number"}
_STRING: JsonSchema = {"type": "string"}
_BOOLEAN: JsonSchema = {"type": "boolean"}
_NANOSECONDS: JsonSchema = {"type": "integer", "minimum": 0, "maximum": 999999999}
_TIME: JsonSchema = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer", "minimum": 0}, "nsec": _NANOSECONDS},
}
_DURATION: JsonSchema = {
    "type": "object",
    "title": "duration",
    "properties": {"sec": {"type": "integer"}, "nsec": _NANOSECONDS},
}


def _message(name: str, **fields: JsonSchema) -> JsonSchema:
    return {"title": f"foxglove.{name}", "type": "object", "properties": fields, "required": list(fields)}


def _choice(name: str, *options: str) -> JsonSchema:
    return {"title": f"foxglove.{name}", "oneOf": [{"title": one, "const": k} for k, one in enumerate(options)]}


def _list(item: JsonSchema) -> JsonSchema:
    return {"type": "array", "items": item}


_VECTOR = _message("Vector3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_POINT = _message("Point3", x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _message("Quaternion", x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _message("Pose", position=_VECTOR, orientation=_QUATERNION)
_COLOUR = _message("Color", r=_NUMBER, g=_NUMBER, b=_NUMBER, a=_NUMBER)
_INDICES = _list({"type": "integer", "minimum": 0})

_ARROW = _message(
    "ArrowPrimitive",
    pose=_POSE,
    shaft_length=_NUMBER,
    shaft_diameter=_NUMBER,
    head_length=_NUMBER,
    head_diameter=_NUMBER,
    color=_COLOUR,
)
_CUBE = _message("CubePrimitive", pose=_POSE, size=_VECTOR, color=_COLOUR)
_SPHERE = _message("SpherePrimitive", pose=_POSE, size=_VECTOR, color=_COLOUR)
_CYLINDER = _message(
    "CylinderPrimitive", pose=_POSE, size=_VECTOR, bottom_scale=_NUMBER, top_scale=_NUMBER, color=_COLOUR
)
_LINE = _message(
    "LinePrimitive",
    type=_choice("LineType", "LINE_STRIP", "LINE_LOOP", "LINE_LIST"),
    pose=_POSE,
    thickness=_NUMBER,
    scale_invariant=_BOOLEAN,
    points=_list(_POINT),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_INDICES,
)
_TRIANGLES = _message(
    "TriangleListPrimitive",
    pose=_POSE,
    points=_list(_POINT),
    color=_COLOUR,
    colors=_list(_COLOUR),
    indices=_INDICES,
)
_TEXT = _message(
    "TextPrimitive",
    pose=_POSE,
    billboard=_BOOLEAN,
    font_size=_NUMBER,
    scale_invariant=_BOOLEAN,
    color=_COLOUR,
    text=_STRING,
)
_MODEL = _message(
    "ModelPrimitive",
    pose=_POSE,
    scale=_VECTOR,
    color=_COLOUR,
    override_color=_BOOLEAN,
    url=_STRING,
    media_type=_STRING,
    data={**_STRING, "contentEncoding": "base64"},
)
_ENTITY = _message(
    "SceneEntity",
    timestamp=_TIME,
    frame_id=_STRING,
    id=_STRING,
    lifetime=_DURATION,
    frame_locked=_BOOLEAN,
    metadata=_list(_message("KeyValuePair", key=_STRING, value=_STRING)),
    arrows=_list(_ARROW),
    cubes=_list(_CUBE),
    spheres=_list(_SPHERE),
    cylinders=_list(_CYLINDER),
    lines=_list(_LINE),
    triangles=_list(_TRIANGLES),
    texts=_list(_TEXT),
    models=_list(_MODEL),
)
_DELETION = _message(
    "SceneEntityDeletion",
    timestamp=_TIME,
    type=_choice("SceneEntityDeletionType", "MATCHING_ID", "ALL"),
    id=_STRING,
)

SCENE_UPDATE = "foxglove.SceneUpdate"
POSES_IN_FRAME = "foxglove.PosesInFrame"
POSE_IN_FRAME = "foxglove.PoseInFrame"
FRAME_TRANSFORM = "foxglove.FrameTransform"
OUTCOME = "fgtrack.Outcome"


#: By name: what fgtrack writes. The last is its own, what became of a detection (a row of updates.csv); a value that is
#: not known is left out, as viewers know no type that may be null. It has a header, by which viewers plot over stamps.
SCHEMAS: Mapping[str, JsonSchema] = {
    schema["title"]: schema
    for schema in (
        _message("SceneUpdate", deletions=_list(_DELETION), entities=_list(_ENTITY)),
        _message("PosesInFrame", timestamp=_TIME, frame_id=_STRING, poses=_list(_POSE)),
        _message("PoseInFrame", timestamp=_TIME, frame_id=_STRING, pose=_POSE),
        _message(
            "FrameTransform",
            timestamp=_TIME,
            parent_frame_id=_STRING,
            child_frame_id=_STRING,
            translation=_VECTOR,
            rotation=_QUATERNION,
        ),
        {
            **_message(
                "Outcome",
                header={"type": "object", "properties": {"stamp": _TIME}, "required": ["stamp"]},
                sensor=_STRING,
                index={"type": "integer"},
                disposition=_STRING,
                delay_s=_NUMBER,
                track_id={"type": "integer"},
                nis=_NUMBER,
            ),
            "title": OUTCOME,
            "required": ["header", "sensor", "index", "disposition", "delay_s"],
        },
    )
}


@cache
def schema_text(name: str) -> bytes:
    """The schema `name` as a file holds it."""
    return json.dumps(SCHEMAS[name], separators=(",", ":")).encode()
