"""Converts messages and data sets of others to fgtrack's messages and conventions.

An entry point of the group `fgtrack.adapters` adds one: named `package/msg/Type`, a function from a message to an
`ObjectList`; by another name a `FileFormat`, or a function that gives one.
"""

from fgtrack.core.plugins import Registry

_OBJECTS = "fgtrack.io.adapters.objects"
ADAPTERS = Registry(
    "adapter",
    {
        "fgtrack.adapters": {
            "csv": "fgtrack.io.adapters.tables:FORMAT",
            "recording": "fgtrack.io.ros.topics:FORMAT",
            "stream": "fgtrack.io.stream:FORMAT",
            "autoferry": "fgtrack.io.adapters.autoferry:FORMAT",
            "fusiontracking": "fgtrack.io.adapters.fusiontracking:FORMAT",
            "nuscenes": "fgtrack.io.adapters.nuscenes:FORMAT",
            "kitti": "fgtrack.io.adapters.kitti:FORMAT",
            "asterix": "fgtrack.io.adapters.asterix:FORMAT",
            "nmea": "fgtrack.io.adapters.nmea:FORMAT",
            "autoware_auto_perception_msgs/msg/DetectedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_perception_msgs/msg/DetectedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_auto_perception_msgs/msg/TrackedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_perception_msgs/msg/TrackedObjects": f"{_OBJECTS}:autoware_objects",
            "delphi_esr_msgs/msg/EsrTrack": f"{_OBJECTS}:delphi_esr",
            "geometry_msgs/msg/PoseArray": f"{_OBJECTS}:pose_array",
            "nav_msgs/msg/Odometry": f"{_OBJECTS}:odometry",
            "radar_msgs/msg/RadarTracks": f"{_OBJECTS}:radar_tracks",
            "vision_msgs/msg/Detection3DArray": f"{_OBJECTS}:detection3d_array",
        }
    },
)
