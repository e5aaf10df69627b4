"""ROS recordings: the only importer of rosbags."""
