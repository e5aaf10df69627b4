"""ROS 2 node of fgtrack."""
