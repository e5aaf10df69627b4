"""Adapters: conversion of foreign messages and data sets to fgtrack's messages and conventions.

A plug-in adds an adapter as an entry point of the group `fgtrack.adapters`. An entry
point named `package/msg/Type` is a function that returns an `ObjectList` for a message.
Another name stands for a `FileFormat`, or for a function that returns a `FileFormat`.
"""

from fgtrack.core.plugins import Registry

STREAM = "stream"
"""Name of the format of fgtrack streams."""
_OBJECTS = "fgtrack.inputs.formats.objects"
ADAPTERS = Registry(
    "adapter",
    {
        "fgtrack.adapters": {
            "csv": "fgtrack.inputs.formats.tables:FORMAT",
            "recording": "fgtrack.inputs.ros.topics:FORMAT",
            STREAM: "fgtrack.inputs.stream:FORMAT",
            "autoferry": "fgtrack.inputs.formats.autoferry:FORMAT",
            "fusiontracking": "fgtrack.inputs.formats.fusiontracking:FORMAT",
            "nuscenes": "fgtrack.inputs.formats.nuscenes:FORMAT",
            "kitti": "fgtrack.inputs.formats.kitti:FORMAT",
            "asterix": "fgtrack.inputs.formats.asterix:FORMAT",
            "nmea": "fgtrack.inputs.formats.nmea:FORMAT",
            "autoware_auto_perception_msgs/msg/DetectedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_perception_msgs/msg/DetectedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_auto_perception_msgs/msg/TrackedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_auto_perception_msgs/msg/PredictedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_perception_msgs/msg/TrackedObjects": f"{_OBJECTS}:autoware_objects",
            "autoware_perception_msgs/msg/PredictedObjects": f"{_OBJECTS}:autoware_objects",
            "delphi_esr_msgs/msg/EsrTrack": f"{_OBJECTS}:delphi_esr",
            "geometry_msgs/msg/PoseArray": f"{_OBJECTS}:pose_array",
            "nav_msgs/msg/Odometry": f"{_OBJECTS}:odometry",
            "radar_msgs/msg/RadarTracks": f"{_OBJECTS}:radar_tracks",
            "vision_msgs/msg/Detection3DArray": f"{_OBJECTS}:detection3d_array",
        }
    },
)
