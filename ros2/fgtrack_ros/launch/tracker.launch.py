"""Starts the tracker, and RViz if it is asked for.

ros2 launch fgtrack_ros tracker.launch.py parameters:=MY.yaml rviz:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("fgtrack_ros")


def generate_launch_description() -> LaunchDescription:
    """Return the node, RViz and their arguments."""
    given = PathJoinSubstitution([SHARE, "config", "tracker.yaml"])
    view = PathJoinSubstitution([SHARE, "rviz", "tracker.rviz"])
    parameters, use_sim_time = LaunchConfiguration("parameters"), LaunchConfiguration("use_sim_time")
    return LaunchDescription(
        [
            DeclareLaunchArgument("parameters", default_value=given, description="file of the node's parameters"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="the clock of /clock"),
            DeclareLaunchArgument("rviz", default_value="false", description="also start RViz"),
            Node(
                package="fgtrack_ros",
                executable="tracker",
                name="fgtrack",
                parameters=[parameters, {"use_sim_time": use_sim_time}],
                respawn=True,
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", view],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
