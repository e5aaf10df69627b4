"""The tracks of a running tracker in Foxglove: open the connection ws://127.0.0.1:8765 there.

python docs/live/foxglove_tracks.py
"""

import math

import foxglove
from foxglove.channels import SceneUpdateChannel
from foxglove.messages import (
    Color,
    CubePrimitive,
    Duration,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    TextPrimitive,
    Timestamp,
    Vector3,
)
from loop import drive, run

import fgtrack

TRACKS = SceneUpdateChannel("/tracks")
COLOURS = {
    fgtrack.TrackStatus.CONFIRMED: Color(r=0.1, g=0.6, b=0.9, a=0.8),
    fgtrack.TrackStatus.COASTING: Color(r=0.9, g=0.6, b=0.1, a=0.8),
    fgtrack.TrackStatus.TENTATIVE: Color(r=0.6, g=0.6, b=0.6, a=0.5),
}
USUAL_M = (4.5, 1.8, 1.4)  # length, width and height of a car
BLACK = Color(r=0.0, g=0.0, b=0.0, a=1.0)


def box(stamp_ns: int, track: fgtrack.TrackReport) -> SceneEntity:
    """Return a box with the number and the speed of a track; it disappears if it is not sent again."""
    turned = Quaternion(x=0.0, y=0.0, z=math.sin(track.yaw_rad / 2.0), w=math.cos(track.yaw_rad / 2.0))
    pose = Pose(position=Vector3(x=track.x_m, y=track.y_m, z=0.7), orientation=turned)
    sides_m = (track.object.length_m, track.object.width_m, track.object.height_m) if track.object else (None,) * 3
    length_m, width_m, height_m = (side or usual for side, usual in zip(sides_m, USUAL_M, strict=True))
    size = Vector3(x=length_m, y=width_m, z=height_m)
    label = f"{track.track_id}: {track.speed_mps:.0f} m/s"
    return SceneEntity(
        timestamp=Timestamp(*divmod(stamp_ns, fgtrack.NS_PER_S)),
        frame_id="map",
        id=str(track.track_id),
        lifetime=Duration(sec=0, nsec=200_000_000),
        cubes=[CubePrimitive(pose=pose, size=size, color=COLOURS[track.status])],
        texts=[TextPrimitive(pose=pose, font_size=14.0, scale_invariant=True, color=BLACK, text=label)],
    )


def publish(stamp_ns: int, tracks: tuple[fgtrack.TrackReport, ...]) -> None:
    """Send the boxes of all tracks."""
    TRACKS.log(SceneUpdate(entities=[box(stamp_ns, track) for track in tracks]), log_time=stamp_ns)


if __name__ == "__main__":
    server = foxglove.start_server(name="fgtrack")
    print("open the connection ws://127.0.0.1:8765 in Foxglove; the drive lasts a minute")
    tracker = fgtrack.Tracker.from_config("smoother", map="oval")
    run(tracker, drive(duration_s=60.0), publish)
    server.stop()
