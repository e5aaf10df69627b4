"""Converts messages and data sets of others to fgtrack's messages and conventions.

An entry point of the group `fgtrack.adapters` adds one: named `package/msg/Type`, a function from a message to an
`ObjectList`; by another name a `FileFormat`, or a function that gives one.
"""

from fgtrack.core.plugins import Registry

_OBJECTS = "fgtrack.inputs.formats.objects"
ADAPTERS = Registry(
    "adapter",
    {
        "fgtrack.adapters": {
            "csv": "fgtrack.inputs.formats.tables:FORMAT",
            "recording": "fgtrack.inputs.ros.topics:FORMAT",
            "stream": "fgtrack.inputs.stream:FORMAT",
            "autoferry": "fgtrack.inputs.formats.autoferry:FORMAT",
            "fusiontracking": "fgtrack.inputs.formats.fusiontracking:FORMAT",
            "nuscenes": "fgtrack.inputs.formats.nuscenes:FORMAT",
            "kitti": "fgtrack.inputs.formats.kitti:FORMAT",
            "asterix": "fgtrack.inputs.formats.asterix:FORMAT",
            "nmea": "fgtrack.inputs.formats.nmea:FORMAT",
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
