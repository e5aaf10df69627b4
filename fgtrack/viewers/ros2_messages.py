"""Standard ROS messages that show a run: markers, transforms, odometry, object lists."""

import numpy as np

from fgtrack.core.time import NS_PER_S, nanoseconds
from fgtrack.core.types import EgoState
from fgtrack.io.adapters.common import RosMessage
from fgtrack.io.ros.messages import MARKER_ARRAY, TRANSFORMS, MessageFactory
from fgtrack.viewers.shapes import Arrow, Box, Colour, Dot, Ellipse, Entity, Label, Line, Point, Scene, Shape

_MARKER = "visualization_msgs/msg/Marker"
_FRAME_IDS = {"map": "map", "ego": "base_link"}
_ARROW, _CUBE, _SPHERE, _CYLINDER, _LINE_STRIP, _TEXT = 0, 1, 2, 3, 4, 9  # as Marker.msg counts them
_ADD, _DELETE = 0, 2
_ELLIPSE_HEIGHT_M = 0.02
_LETTER_M = 1.2


class ViewerMessageFactory(MessageFactory):
    """Makes markers and transforms as well. It knows which markers are shown, so that it can remove them."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: dict[tuple[str, str], int] = {}
        nothing = np.zeros(0, dtype=np.uint8)
        self._no_texture = self._make(
            "sensor_msgs/msg/CompressedImage", header=self._header(0, ""), format="", data=nothing
        )
        self._no_mesh = self._make("visualization_msgs/msg/MeshFile", filename="", data=nothing)

    def marker_array(self, scene: Scene) -> RosMessage:
        """`visualization_msgs/MarkerArray`: an entity is a namespace, a shape of it a marker."""
        markers = []
        for entity in scene.entities:
            markers += [self._marker(scene, entity, k, shape) for k, shape in enumerate(entity.shapes)]
            markers += self._deleted(scene, entity.name, len(entity.shapes))
        for name in scene.removed:
            markers += self._deleted(scene, name, 0)
        return self._make(MARKER_ARRAY, markers=markers)

    def transforms(self, ego: EgoState) -> RosMessage:
        """`tf2_msgs/TFMessage` with the pose of the ego in the map."""
        pose = self._pose(ego.x_m, ego.y_m, ego.yaw_rad)
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(ego.x_m, ego.y_m),
            rotation=pose.orientation,
        )
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(ego.stamp_ns, "map"),
            child_frame_id=_FRAME_IDS["ego"],
            transform=transform,
        )
        return self._make(TRANSFORMS, transforms=[stamped])

    def _deleted(self, scene: Scene, name: str, kept: int) -> list[RosMessage]:
        """Markers that remove what an entity showed beyond its first `kept` shapes."""
        shown = self._shown.pop((scene.topic, name), 0)
        if kept:
            self._shown[scene.topic, name] = kept
        return [
            self._empty_marker(scene, Entity(name, ()), number, _SPHERE, action=_DELETE)
            for number in range(kept, shown)
        ]

    def _marker(self, scene: Scene, entity: Entity, number: int, shape: Shape) -> RosMessage:
        def marker(kind: int, point_m: Point, z_m: float, yaw_rad: float, scale: RosMessage) -> RosMessage:
            found = self._empty_marker(scene, entity, number, kind)
            found.pose, found.scale, found.color = self._pose(*point_m, yaw_rad), scale, self._colour(shape.colour)
            found.pose.position.z = z_m
            return found

        match shape:
            case Box():
                return marker(_CUBE, shape.centre_m, shape.size_m[2] / 2.0, shape.yaw_rad, self._vector(*shape.size_m))
            case Ellipse():
                size = self._vector(*shape.axes_m, _ELLIPSE_HEIGHT_M)
                return marker(_CYLINDER, shape.centre_m, shape.height_m, shape.yaw_rad, size)
            case Arrow():
                found = marker(_ARROW, (0.0, 0.0), shape.width_m, 0.0, self._vector(shape.width_m, 2.5 * shape.width_m))
                found.points = [self._point(shape.tail_m), self._point(shape.tip_m)]
                return found
            case Line():
                found = marker(_LINE_STRIP, (0.0, 0.0), 0.0, 0.0, self._vector(shape.width_m, 0.0))
                found.points = [self._point(point_m) for point_m in shape.points_m]
                return found
            case Dot():
                size = self._vector(shape.diameter_m, shape.diameter_m, shape.diameter_m)
                return marker(_SPHERE, shape.centre_m, shape.diameter_m / 2.0, 0.0, size)
            case Label():
                found = marker(_TEXT, shape.point_m, shape.height_m, 0.0, self._vector(0.0, 0.0, _LETTER_M))
                found.text = shape.text
                return found

    def _empty_marker(self, scene: Scene, entity: Entity, number: int, kind: int, action: int = _ADD) -> RosMessage:
        lifetime_ns = 0 if entity.lifetime_s is None else nanoseconds(entity.lifetime_s)
        sec, nanosec = divmod(lifetime_ns, NS_PER_S)
        return self._make(
            _MARKER,
            header=self._header(scene.stamp_ns, _FRAME_IDS[entity.frame]),
            ns=entity.name,
            id=number,
            type=kind,
            action=action,
            pose=self._pose(0.0, 0.0, 0.0),
            scale=self._vector(0.0, 0.0),
            color=self._colour((0.0, 0.0, 0.0, 0.0)),
            lifetime=self._make("builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec),
            frame_locked=entity.frame == "ego",
            points=[],
            colors=[],
            texture_resource="",
            texture=self._no_texture,
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=self._no_mesh,
            mesh_use_embedded_materials=False,
        )

    def _point(self, point_m: Point) -> RosMessage:
        return self._make("geometry_msgs/msg/Point", x=point_m[0], y=point_m[1], z=0.0)

    def _colour(self, colour: Colour) -> RosMessage:
        return self._make("std_msgs/msg/ColorRGBA", **dict(zip("rgba", colour, strict=True)))
