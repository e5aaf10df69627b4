"""Definitions of message types that rosbags does not contain; fields are in CDR order.

Definitions in a recording, and definitions of the user, take precedence.
"""

from fgtrack.core.types import MEASURABLE

# The layouts below are those of vision_msgs 4, radar_msgs 0.2, tier4's autoware_auto_msgs, and autoware_msgs 1.
_AVAILABILITY = "uint8 UNAVAILABLE=0, uint8 SIGN_UNKNOWN=1, uint8 AVAILABLE=2"
_POSE = "geometry_msgs/PoseWithCovariance pose_with_covariance"
_TWIST = "geometry_msgs/TwistWithCovariance twist_with_covariance"
_AUTOWARE = {
    "ObjectClassification": "uint8 label, float32 probability",
    "Shape": "uint8 type, geometry_msgs/Polygon footprint, geometry_msgs/Vector3 dimensions",
    "DetectedObjectKinematics": f"{_AVAILABILITY}, {_POSE}, bool has_position_covariance, "
    f"uint8 orientation_availability, {_TWIST}, bool has_twist, bool has_twist_covariance",
    "DetectedObject": "float32 existence_probability, ObjectClassification[] classification, "
    "DetectedObjectKinematics kinematics, Shape shape",
    "DetectedObjects": "std_msgs/Header header, DetectedObject[] objects",
    "TrackedObjectKinematics": f"{_AVAILABILITY}, {_POSE}, uint8 orientation_availability, {_TWIST}, "
    "geometry_msgs/AccelWithCovariance acceleration_with_covariance, bool is_stationary",
    "TrackedObject": "unique_identifier_msgs/UUID object_id, float32 existence_probability, "
    "ObjectClassification[] classification, TrackedObjectKinematics kinematics, Shape shape",
    "TrackedObjects": "std_msgs/Header header, TrackedObject[] objects",
    "PredictedPath": "geometry_msgs/Pose[] path, builtin_interfaces/Duration time_step, float32 confidence",
    "PredictedObjectKinematics": "geometry_msgs/PoseWithCovariance initial_pose_with_covariance, "
    "geometry_msgs/TwistWithCovariance initial_twist_with_covariance, "
    "geometry_msgs/AccelWithCovariance initial_acceleration_with_covariance, PredictedPath[] predicted_paths",
    "PredictedObject": "unique_identifier_msgs/UUID object_id, float32 existence_probability, "
    "ObjectClassification[] classification, PredictedObjectKinematics kinematics, Shape shape",
    "PredictedObjects": "std_msgs/Header header, PredictedObject[] objects",
}
_FOREIGN = {
    **{
        f"autoware_perception_msgs/msg/{name}": text for name, text in _AUTOWARE.items()
    },
    **{
        f"autoware_auto_perception_msgs/msg/{name}": text
        for name, text in _AUTOWARE.items()
    },
    "vision_msgs/msg/ObjectHypothesis": "string class_id, float64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": "ObjectHypothesis hypothesis, geometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center, geometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": "std_msgs/Header header, ObjectHypothesisWithPose[] results, BoundingBox3D bbox, "
    "string id",
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header, Detection3D[] detections",
    "radar_msgs/msg/RadarTrack": "unique_identifier_msgs/UUID uuid, geometry_msgs/Point position, "
    "geometry_msgs/Vector3 velocity, geometry_msgs/Vector3 acceleration, geometry_msgs/Vector3 size, "
    "uint16 classification, float32[6] position_covariance, float32[6] velocity_covariance, "
    "float32[6] acceleration_covariance, float32[6] size_covariance",
    "radar_msgs/msg/RadarTracks": "std_msgs/Header header, RadarTrack[] tracks",
    "delphi_esr_msgs/msg/EsrTrack": "std_msgs/Header header, string canmsg, uint8 id, float32 lat_rate, "
    "bool grouping_changed, bool oncoming, uint8 status, float32 angle, float32 range, bool bridge_object, "
    "bool rolling_count, float32 width, float32 range_accel, uint8 med_range_mode, float32 range_rate",
}
_COMPONENTS = "\n".join(f"float64 {name}" for name in MEASURABLE)
_OWN = {
    "fgtrack_msgs/msg/Ego": """\
std_msgs/Header header
float64 x_m
float64 y_m
float64 yaw_rad
float64 speed_mps
float64 yaw_rate_radps
float64 accel_mps2
bool has_in_pit
bool in_pit
# Of x, y, yaw, speed and yaw rate, row-major; empty where it was not given.
float64[] covariance
""",
    "fgtrack_msgs/msg/Detection": f"""\
# Bit i of `present` is set if the i-th field below was given.
uint32 present
{_COMPONENTS}
float64[] covariance
int64 stamp_ns
int64 object_id
float64 z_m
float64 length_m
float64 width_m
float64 height_m
float64 score
string class_name
string id
""",
    "fgtrack_msgs/msg/DetectionList": """\
# header.frame_id is map, ego or sensor.
std_msgs/Header header
string sensor
Detection[] objects
# Latitude and longitude of the origin of the map; empty where it is not known.
float64[] origin_deg
""",
    "fgtrack_msgs/msg/Truth": """\
# Bit i of `present` is set if the i-th field after it was given.
std_msgs/Header header
int64 object_id
float64 x_m
float64 y_m
bool ignored
uint16 present
float64 yaw_rad
float64 speed_mps
float64 yaw_rate_radps
float64 accel_mps2
# Corners x, y, x, y ... of a region that is ignored.
float64[] outline_m
""",
}
#: Text of each definition, by type name.
DEFINITIONS: dict[str, str] = _OWN | {
    name: text.replace(", ", "\n") for name, text in _FOREIGN.items()
}
